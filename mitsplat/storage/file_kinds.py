"""File kinds by name, and checks of names and kinds."""

from __future__ import annotations

import difflib
import os
from itertools import chain, islice
from pathlib import Path

from mitsplat.errors import InputError

_SPLATS = "a splat file; import it first: `mitsplat import FILE -o FOLDER`"
_MESH = "a mesh; bake it first: `mitsplat bake FILE -o FOLDER`"
_STEP = "a STEP file; bake it first: `mitsplat bake FILE -o FOLDER`"
_PICTURE = "an image"
_DRAWING = "a CAD file; export it as .step, or as a mesh: .glb with colours or .stl"
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
_PROGRAM = "a file of a 3D program; export it as .glb"
_ARCHIVE = "an archive; unpack it"
_BY_SUFFIX = {
    **dict.fromkeys((".fbx", ".blend", ".max", ".c4d", ".ma", ".mb", ".3ds", ".x3d", ".wrl", ".lwo", ".abc"), _PROGRAM),
    **dict.fromkeys((".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".bz2", ".xz"), _ARCHIVE),
    **dict.fromkeys(
        (".usd", ".usda", ".usdc", ".usdz"), "a USD stage; `mitsplat import` reads its splats, export meshes as .glb"
    ),
    **dict.fromkeys((".pt", ".pth", ".ckpt"), "a checkpoint of a training; export its splats as .ply"),
    **dict.fromkeys(VIDEO_SUFFIXES, "a video; `mitsplat capture` reads it"),
    **dict.fromkeys((".splat", ".ksplat", ".spz", ".sog"), _SPLATS),
    **dict.fromkeys((".stl", ".obj", ".glb", ".gltf", ".off", ".3mf", ".dae"), _MESH),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff"), _PICTURE),
    **dict.fromkeys((".step", ".stp"), _STEP),
    **dict.fromkeys((".iges", ".igs", ".brep", ".sldprt", ".ipt", ".fcstd"), _DRAWING),
    ".ply": "splats or a mesh; import or bake it first: `mitsplat import FILE -o FOLDER`, or `mitsplat bake`",
    ".xml": "a Mitsuba scene: `mitsplat render` renders it",
    ".yaml": "a scene or an asset.yaml",
    ".yml": "a scene or an asset.yaml",
}
_MAX_NEIGHBOURS = 1000
"""Maximum number of folders that are compared with a misspelt name."""
_BY_CONTENT = {
    "asset.yaml": "the folder of an asset: enter it in a scene under `objects:`; `mitsplat check` checks it",
    "dataset.json": "the folder of a dataset: `mitsplat report` describes it",
    "capture.json": "the folder of a capture: `mitsplat fit` fits splats to it",
}


def refuse_other_kinds(path: Path, wanted: str, *suffixes: str) -> None:
    """Refuse a folder, or an existing file whose suffix belongs to another kind of file.

    A missing file is not refused here, but by its reader.

    Args:
        path: Given path.
        wanted: Description of the expected kind.
        suffixes: Accepted suffixes.

    Raises:
        InputError: If the path is of another kind; the message names the kind.
    """
    if path.is_dir():
        found = next((text for name, text in _BY_CONTENT.items() if (path / name).is_file()), "a folder")
        raise InputError(f"{path}: must be {wanted} (got {found})")
    suffix = path.suffix.lower()
    if path.is_file() and suffix in _BY_SUFFIX and suffix not in suffixes:
        raise InputError(f"{path}: must be {wanted} (got {kind_of_file(path)})")


def refuse_placeholder(path: Path, start: bytes) -> None:
    """Refuse an empty file, and one with the content of another: a Git LFS pointer, or a web page of a failed download.

    Args:
        path: The file.
        start: Its first bytes.

    Raises:
        InputError: If it is one.
    """
    if not start:
        raise InputError(f"{path}: the file is empty")
    text = start.lstrip()[:40].lower()
    if text.startswith(b"version https://git-lfs"):
        raise InputError(f"{path}: is a Git LFS pointer in place of the file: get the file by `git lfs pull`")
    if text.startswith((b"<!doctype html", b"<html")):
        raise InputError(f"{path}: is a web page in place of the file: the download failed")


def kind_of_file(path: Path) -> str | None:
    """Return the kind of a file by its suffix, with the command to use for it; None if it is unknown."""
    kind = _BY_SUFFIX.get(path.suffix.lower())
    if kind is None:
        return None
    return kind.replace("FILE", str(path)).replace("FOLDER", str(path.with_suffix("")))


def no_folder_with(folder: Path, file: str, wanted: str) -> InputError:
    """Return the error for a folder without a file: its kind, or the folder that was probably meant.

    Args:
        folder: Given folder, which does not contain the file.
        file: Name of the file that such folders have.
        wanted: Description of such folders.
    """
    if folder.is_file():
        if folder.name == file:
            return InputError(f"{folder}: must be {wanted} (got its {file}: give {folder.parent})")
        return InputError(f"{folder}: must be {wanted} (got {kind_of_file(folder) or 'another file'})")
    if folder.is_dir():
        if found := next((text for name, text in _BY_CONTENT.items() if (folder / name).is_file()), None):
            return InputError(f"{folder}: must be {wanted} (got {found})")
        inside = sorted(path for path in folder.iterdir() if path.suffix.lower() in _BY_SUFFIX)
        kinds = [
            kind for path in inside if (kind := kind_of_file(path)) and kind.startswith(("a mesh", "a splat", "a STEP"))
        ]
        has = f"; {inside[0].name} is {kinds[0]}" if kinds else ""
        return InputError(f"{folder}: must be {wanted} (got a folder without {file}{has})")
    if any(letter in str(folder) for letter in "*?["):
        return InputError(f"{folder}: no such folder; is it a pattern, for the key pool?")
    close = _similar_folder(folder, file)
    return InputError(f"{folder}: no such folder{f'; did you mean {close}?' if close else ''}")


def _similar_folder(folder: Path, file: str) -> Path | None:
    """Return the folder with a file whose path is most similar to that of a missing folder, if there is one."""
    base = next((parent for parent in folder.parents if parent.is_dir()), None)
    if base is None:
        return None
    try:
        found = islice(chain(base.glob(f"*/{file}"), base.glob(f"*/*/{file}")), _MAX_NEIGHBOURS)
        near = {path.parent.relative_to(base).as_posix().lower(): path.parent for path in found}
    except OSError:
        return None
    name = folder.relative_to(base).as_posix().lower()
    same = [place for place in near.values() if place.name.lower() == folder.name.lower()]
    close = difflib.get_close_matches(name, near, n=1)
    return same[0] if len(same) == 1 else near[close[0]] if close else None


def check_path_encoding(path: str | Path) -> None:
    """Refuse a path that is not valid UTF-8. Native libraries reject such paths or abort the process.

    Raises:
        InputError: If it is not UTF-8.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"names of files and folders must be UTF-8 (got {os.fsencode(path)!r})") from None
