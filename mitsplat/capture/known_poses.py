"""Import of known cameras from COLMAP models and NeRF's ``transforms.json``, matched to photographs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsplat.capture.photos import Prepared
from mitsplat.capture.structure_from_motion import SparseModel, find_points, read_model
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.progress import Progress

_Row = tuple[float, float, float, float]
_Positive = Annotated[float, Field(gt=0)]


_MAX_COORDINATE = 1e9
"""Largest accepted coordinate of a camera or a point, in units of the model; geocentric coordinates in metres reach
6e6.
"""


class _Lens(BaseModel):
    """Intrinsics of all frames or of one frame; pixel centres are at +0.5, by the convention of COLMAP."""

    model_config = ConfigDict(allow_inf_nan=False)

    camera_angle_x: _Positive | None = None
    fl_x: _Positive | None = None
    fl_y: _Positive | None = None
    cx: float | None = None
    cy: float | None = None
    w: _Positive | None = None
    h: _Positive | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    camera_model: str = "OPENCV"


class _Frame(_Lens):
    file_path: str
    transform_matrix: tuple[_Row, _Row, _Row, _Row]


class _Transforms(_Lens):
    frames: list[_Frame] = Field(min_length=1)


def read_poses(source: Path, photos: Sequence[Prepared], folder: Path, progress: Progress | None = None) -> SparseModel:
    """Read the cameras of photographs from a file, keyed by the file names of the copies.

    If the model has no points, points are triangulated from the photographs with fixed cameras.

    Args:
        source: Folder of a COLMAP model (``.bin`` or ``.txt``), or a ``transforms.json`` (OpenGL axes).
        photos: Copies of the photographs without EXIF rotation, because such files ignore it.
        folder: Folder for intermediate files.
        progress: Callback with the present activity.

    Raises:
        InputError: If the file is damaged or contains none of the photos.
        MissingResourceError: If COLMAP aborts its process.
    """
    if source.is_dir():
        model = read_model(source, folder / "given")
    elif source.suffix == ".json":
        model = _read_transforms(source, {photo.name: photo for photo in photos})
    else:
        raise InputError(f"{source}: poses must be the folder of a COLMAP model or a transforms.json")
    names = _match(model.cameras, photos)
    if len(names) < 2:
        raise InputError(f"{source}: must name the photos (got {next(iter(model.cameras))} which matches no photo)")
    _check_coordinates(source, model)
    sizes = {photo.file.name: photo.size for photo in photos}
    cameras = {file: _resized_camera(source, name, model.cameras[name], sizes[file]) for name, file in names.items()}
    if not len(model.points):
        return find_points([photo for photo in photos if photo.file.name in cameras], cameras, folder, progress)
    return replace(model, cameras=cameras, seen={file: model.seen[name] for name, file in names.items()})


def _check_coordinates(source: Path, model: SparseModel) -> None:
    """Raise InputError if a camera or a point of the model is not finite or lies beyond ``_MAX_COORDINATE``."""
    places = [(f"camera {name}", camera.world_from_camera[:3, 3]) for name, camera in model.cameras.items()]
    places += [("a point", model.points)] if len(model.points) else []
    for name, place in places:
        if not (farthest := float(np.abs(place).max())) <= _MAX_COORDINATE:
            raise InputError(f"{source}: {name} must lie within {_MAX_COORDINATE:g} of the origin (got {farthest:g})")


def _read_transforms(path: Path, photos: Mapping[str, Prepared]) -> SparseModel:
    """Read the cameras of a ``transforms.json``, keyed by its file paths."""
    try:
        content = _Transforms.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "content"
        raise InputError(
            f"{path}: {place}: {first['msg']} (got {json.dumps(first['input'], default=str):.60})"
        ) from None
    sizes = {name: photos[file].size for name, file in _match_names(content, photos).items()}
    cameras = {}
    for number, frame in enumerate(content.frames):
        lens = _Lens.model_validate(content.model_dump(exclude_unset=True) | frame.model_dump(exclude_unset=True))
        width, height = lens.w, lens.h
        if width is None or height is None:
            if frame.file_path not in sizes:
                continue  # not among the photos; its size is unknown and not needed
            width, height = sizes[frame.file_path]
        try:
            cameras[frame.file_path] = _camera(lens, round(width), round(height), np.array(frame.transform_matrix))
        except ValueError as error:
            raise InputError(f"{path}: frames[{number}]: {error}") from error
    empty = np.zeros((0, 3))
    nothing = {name: np.zeros(0, dtype=np.int32) for name in cameras}
    return SparseModel(cameras, empty, empty.astype(np.uint8), nothing)


def _match_names(content: _Transforms, photos: Mapping[str, Prepared]) -> dict[str, str]:
    files = _match([frame.file_path for frame in content.frames], list(photos.values()))
    names = {photo.file.name: name for name, photo in photos.items()}
    return {path: names[file] for path, file in files.items()}


def _camera(lens: _Lens, width: int, height: int, pose: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Camera:
    """Return the OpenCV camera of a frame, with the y and z axes of OpenGL negated."""
    if lens.camera_model not in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise ValueError(
            f"camera_model must be OPENCV, OPENCV_FISHEYE or PINHOLE (got {lens.camera_model}): undistort the photos"
        )
    focal = lens.fl_x
    if focal is None:
        if lens.camera_angle_x is None:
            raise ValueError("needs fl_x or camera_angle_x")
        focal = 0.5 * width / np.tan(0.5 * lens.camera_angle_x)
    fisheye = lens.camera_model == "OPENCV_FISHEYE"
    if lens.k4 and not fisheye:
        raise ValueError(f"k4 belongs to camera_model OPENCV_FISHEYE (got {lens.camera_model})")
    distortion = (lens.k1, lens.k2, lens.p1, lens.p2) + ((lens.k3,) if lens.k3 else ())
    if fisheye:
        distortion = (lens.k1, lens.k2, lens.k3, lens.k4)
    pose = pose.copy()
    pose[:3, :3] @= np.diag([1.0, -1.0, -1.0])
    return Camera(
        width=width,
        height=height,
        fx=float(focal),
        fy=float(lens.fl_y or focal),
        cx=0.5 * width if lens.cx is None else lens.cx,
        cy=0.5 * height if lens.cy is None else lens.cy,
        world_from_camera=pose,
        distortion=distortion if fisheye or any(distortion) else (),
        lens="fisheye" if fisheye else "opencv",
    )


def _match(names: Iterable[str], photos: Sequence[Prepared]) -> dict[str, str]:
    """Match names of a model to file names of the photo copies.

    A name matches by its path, or by its last part if only one photo has it.
    """
    keys: dict[str, set[str]] = {}
    for photo in photos:
        path = PurePosixPath(photo.name)
        for key in {str(path), str(path.with_suffix("")), path.name, path.stem}:
            keys.setdefault(key, set()).add(photo.file.name)
    matched: dict[str, str] = {}
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        for key in (str(path), path.name, path.stem):
            if len(keys.get(key, ())) == 1:
                matched[name] = next(iter(keys[key]))
                break
    return matched


def _resized_camera(source: Path, name: str, camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera resized to the pixels of a reduced copy."""
    if abs(camera.width * size[1] - camera.height * size[0]) > max(camera.width, camera.height, *size):
        raise InputError(
            f"{source}: {name} must have the aspect ratio of its photo, {size[0]}x{size[1]} px (got {camera.width}x"
            f"{camera.height})"
        )
    return camera.resized(*size)
