"""Recognition of files of cameras that mitsplat does not read, with the way to use their content."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

from mitsplat.errors import InputError

_SCENE = "enter its values in a scene, under camera.intrinsics: fx, fy, cx and cy, size, and distortion"
_HALF = "cx and cy plus 0.5, as OpenCV counts from the centre of the first pixel"
_EXPORT = "export its cameras as a COLMAP model"
_CONVERT = "convert it to a COLMAP model"
_KINDS: dict[str, tuple[str, str]] = {
    r"\s*cam\d+:.*\bintrinsics:": (
        "a camera chain of Kalibr",
        f"{_SCENE} ({_HALF}; for distortion_model equidistant also lens: fisheye)",
    ),
    r".*!!opencv-matrix|.*<opencv_storage>": ("a calibration of OpenCV", f"{_SCENE} ({_HALF})"),
    r".*\bdistortion_model:.*\bcamera_matrix:|.*\bcamera_matrix:.*\bdistortion_model:": (
        "a camera_info of ROS",
        f"{_SCENE} ({_HALF}; for distortion_model equidistant also lens: fisheye)",
    ),
    r'.*"cam_K"': ("a camera file of BOP", f"{_SCENE} (cam_K is [fx, 0, cx, 0, fy, cy, 0, 0, 1]; {_HALF})"),
    r".*<document\b.*<chunk\b": ("cameras of Metashape", _EXPORT),
    r"\s*#?\s*(?:name|label)\s*,\s*x\s*,\s*y\s*,": ("a table of cameras of RealityScan", _EXPORT),
    r".*<x:xmpmeta\b": ("XMP data of a photo", f"if they are of RealityScan, {_EXPORT}"),
    r'\s*\[\s*\{.*"rotation"\s*:.*"position"\s*:|\s*\[\s*\{.*"position"\s*:.*"rotation"\s*:': (
        "the cameras.json of 3DGS",
        "use the COLMAP model of the training (sparse/0)",
    ),
    r'\s*\{.*"sfm_data_version"': ("cameras of OpenMVG", _CONVERT),
    r'\s*\{.*"version"\s*:.*"(?:views|featuresFolders)"\s*:': ("cameras of Meshroom", _CONVERT),
    r"\s*# Bundle file": ("cameras of Bundler", _CONVERT),
    r"\s*NVM_V3": ("cameras of VisualSFM", _CONVERT),
    r"\x93NUMPY": ("an array of NumPy", f"if it is a poses_bounds.npy of LLFF, {_CONVERT}"),
}
"""Kind and remedy by a pattern of the first bytes of a file."""
_SUFFIXES = (".yaml", ".yml", ".xml", ".csv", ".xmp", ".json", ".sfm", ".out", ".nvm", ".npy", ".txt")
_START = 1 << 13
_MAX_FILES = 20
"""Maximum number of files of a folder that are examined."""


def calibration_kind(path: Path) -> tuple[str, str] | None:
    """Return the kind of a file of cameras of another program, and a remedy; None for all other files."""
    if path.suffix.lower() not in _SUFFIXES:
        return None
    try:
        with path.open("rb") as file:
            text = file.read(_START).decode("latin-1")
    except OSError:
        return None
    return next((kind for pattern, kind in _KINDS.items() if re.match(pattern, text, re.S | re.I)), None)


def refuse_calibration(path: Path, wanted: str) -> None:
    """Refuse a file, or a folder with a file, of cameras of another program.

    Args:
        path: Given path.
        wanted: Rule that it breaks.

    Raises:
        InputError: If it is of such a kind; the message names the kind and how to use its content.
    """
    if path.is_dir():
        if _is_colmap_model(path):
            return
        for folder in (path / "sparse/0", path / "0", path / "sparse"):
            if _is_colmap_model(folder):
                raise InputError(f"{path}: {wanted} (got a folder without cameras.bin): did you mean {folder}?")
        files = sorted(islice((file for file in path.iterdir() if file.is_file()), _MAX_FILES))
        inside = next(((file, kind) for file in files if (kind := calibration_kind(file))), None)
        if inside is not None:
            file, (name, remedy) = inside
            raise InputError(f"{path}: {wanted} (got a folder with {file.name}, {name}): {remedy}")
    elif path.is_file() and (kind := calibration_kind(path)):
        raise InputError(f"{path}: {wanted} (got {kind[0]}): {kind[1]}")


def _is_colmap_model(folder: Path) -> bool:
    """Return True for a folder with the cameras of a COLMAP model."""
    return any((folder / f"cameras{suffix}").exists() for suffix in (".bin", ".txt"))
