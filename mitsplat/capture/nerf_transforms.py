"""Cameras in ``transforms.json`` files of NeRF programs: Blender's data sets, instant-ngp and Nerfstudio."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsplat.arrays import Float64Array
from mitsplat.capture.structure_from_motion import SparseModel
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL
from mitsplat.storage.calibration_files import refuse_calibration
from mitsplat.storage.field_types import Positive

_Row = tuple[float, float, float, float]
POSES_RULE = "poses must be the folder of a COLMAP model or a transforms.json"
_MAX_RATIO = 1.03
"""Maximum ratio of the focal lengths that two keys state."""
_UNUSED = {
    *("aabb_scale", "scale", "offset", "up", "from_na", "render_aabb", "sharpen", "white_transparent", "mask_color"),
    *("black_transparent", "enable_depth_loading", "integer_depth_scale", "n_extra_learnable_dims", "applied_scale"),
    *("applied_transform", "ply_file_path", "orientation_override", "auto_scale_poses_factor", "fps"),
    *("train_filenames", "val_filenames", "test_filenames", "rotation", "sharpness", "time", "timestamp"),
    *("depth_file_path", "depth_path", "mask_path", "colmap_im_id", "transform_matrix_start", "transform_matrix_end"),
}
"""Known keys without influence on cameras."""


class _Lens(BaseModel):
    """Intrinsics of all frames or of one frame; pixel centres are at +0.5, by the convention of COLMAP."""

    model_config = ConfigDict(allow_inf_nan=False, extra="allow")

    camera_angle_x: Positive | None = None
    camera_angle_y: Positive | None = None
    fl_x: Positive | None = None
    fl_y: Positive | None = None
    cx: float | None = None
    cy: float | None = None
    w: Positive | None = None
    h: Positive | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    distortion_params: list[float] = []
    camera_model: str = "OPENCV"
    is_fisheye: bool = False


_MIN_CENTRE, _MIN_FOCAL = (0.25, 0.1), 0.1
"""Minimum distance of a principal point from the border without and with a stated size, and focal length [sizes]."""


class _Frame(_Lens):
    file_path: str
    transform_matrix: tuple[_Row, _Row, _Row, _Row]


class Transforms(_Lens):
    """Content of a file; keys of a frame replace those of all frames."""

    frames: list[_Frame] = Field(min_length=1)


def parse_transforms(path: Path) -> Transforms:
    """Read a ``transforms.json``.

    Raises:
        InputError: If it cannot be read, repeats a key, or lacks a key or has an invalid value.
    """
    refuse_calibration(path, POSES_RULE)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        return Transforms.model_validate(json.loads(data, object_pairs_hook=_unique))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "content"
        rule = "must be a mapping of keys to values" if first["type"] == "model_type" else first["msg"]
        raise InputError(f"{path}: {place}: {rule} (got {json.dumps(first['input'], default=str):.60})") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({str(error) or 'nested too deeply'})") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the mapping of pairs.

    Raises:
        InputError: If a key occurs twice, of which programs read the first or the last.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise InputError(f"keys must be unique (got {key!r:.60} twice)")
        found[key] = value
    return found


def transforms_remarks(content: Transforms) -> Iterator[str]:
    """Yield a sentence for each statement of a file that is not used."""
    if odd := sorted({*(content.model_extra or ())} - _UNUSED):
        yield f"the keys {', '.join(odd)} are not used"
    if odd := sorted({key for frame in content.frames for key in frame.model_extra or ()} - _UNUSED):
        yield f"the keys {', '.join(odd)} of its frames are not used"
    if any("mask_path" in (frame.model_extra or {}) for frame in content.frames):
        yield "its masks (mask_path) are not used: give their folder with --masks"
    for number, frame in enumerate(content.frames):
        width = frame.w or content.w
        if width is not None and (contradiction := _contradiction(content, frame, round(width))):
            yield f"frames[{number}]: {contradiction}; fl_x is used"
            return


def check_metric(path: Path) -> None:
    """Refuse poses that the file states to be scaled, in place of poses in metres."""
    scale = (parse_transforms(path).model_extra or {}).get("applied_scale", 1.0)
    if not isinstance(scale, int | float) or scale != 1:
        raise InputError(
            f"{path}: poses in metres must have no applied_scale (got {scale!s:.60}): divide the positions by it and "
            "remove the key, or omit --metric"
        )


def _contradiction(content: Transforms, frame: _Frame, width: int) -> str:
    """Return a sentence if the focal length and the field of view of a frame differ for images of ``width`` pixels."""
    level = content if frame.fl_x is None and frame.camera_angle_x is None else frame
    focal, angle = level.fl_x, level.camera_angle_x
    if focal is None or angle is None:
        return ""
    stated = _focal(width, angle, "camera_angle_x") if angle < np.pi else 0.0
    if stated and max(focal / stated, stated / focal) <= _MAX_RATIO:
        return ""
    meaning = f"a focal length of {stated:.4g} px" if stated else "no angle in radians"
    return f"camera_angle_x = {angle:.4g} is {meaning} in images of {width} px, which contradicts fl_x = {focal:.4g}"


def read_transforms(
    path: Path, content: Transforms, sizes: Mapping[str, tuple[int, int]]
) -> tuple[SparseModel, set[str]]:
    """Return the cameras of a ``transforms.json`` by its file paths, and the paths for which it states the size.

    Frames without a size have that of their photo in ``sizes`` [px], and are left out if they have none.
    """
    cameras: dict[str, Camera] = {}
    sized = set()
    for number, frame in enumerate(content.frames):
        lens = _lens_of(content, frame)
        width, height = lens.w, lens.h
        if width is None or height is None:
            if frame.file_path not in sizes:
                continue  # not among the photos; its size is unknown and not needed
            width, height = sizes[frame.file_path]
            if contradiction := _contradiction(content, frame, width):
                raise InputError(f"{path}: frames[{number}]: {contradiction}: state w and h, the size for fl_x")
        else:
            sized.add(frame.file_path)
        try:
            camera = _camera(lens, round(width), round(height), np.array(frame.transform_matrix))
        except ValueError as error:
            raise InputError(f"{path}: frames[{number}]: {error}") from error
        across, least = (camera.cx / width, camera.cy / height), _MIN_CENTRE[frame.file_path in sized]
        if camera.fx / width < _MIN_FOCAL or not all(least < share < 1 - least for share in across):
            raise InputError(
                f"{path}: frames[{number}]: fl_x, cx, cy = {camera.fx:g}, {camera.cx:g}, {camera.cy:g} must be in "
                f"pixels of a photo of {width:g} x {height:g}: state w and h, the size for which they hold"
            )
        other = cameras.setdefault(frame.file_path, camera)
        if other.to_json() != camera.to_json():
            what = "lens" if np.array_equal(other.world_from_camera, camera.world_from_camera) else "pose"
            raise InputError(f"{path}: frames[{number}]: an image must have one {what} (got two of {frame.file_path})")
    empty = np.zeros((0, 3))
    nothing = {name: np.zeros(0, dtype=np.int32) for name in cameras}
    return SparseModel(cameras, empty, empty.astype(np.uint8), nothing), sized


def _lens_of(content: Transforms, frame: _Frame) -> _Lens:
    """Return the lens of a frame: its own keys, and else those of all frames. A field of view is a focal length."""
    common, own = content.model_dump(exclude_unset=True), frame.model_dump(exclude_unset=True)
    if "camera_angle_x" in own and "fl_x" not in own:
        common = {key: value for key, value in common.items() if key not in ("fl_x", "fl_y", "camera_angle_y")}
    return _Lens.model_validate(common | own)


def _camera(lens: _Lens, width: int, height: int, pose: Float64Array) -> Camera:
    """Return the OpenCV camera of a frame, with the y and z axes of OpenGL negated."""
    if lens.camera_model not in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise ValueError(
            f"camera_model must be OPENCV, OPENCV_FISHEYE or PINHOLE (got {lens.camera_model}): undistort the photos"
        )
    if lens.k5 or lens.k6 or any(lens.distortion_params):
        raise ValueError("has distortion in k5, k6 or distortion_params, which are not read: state k1, k2, k3, p1, p2")
    focal, focal_y = lens.fl_x, lens.fl_y
    if focal is None:
        if lens.camera_angle_x is None:
            raise ValueError("needs fl_x or camera_angle_x")
        focal = _focal(width, lens.camera_angle_x, "camera_angle_x")
        if focal_y is None and lens.camera_angle_y is not None:
            focal_y = _focal(height, lens.camera_angle_y, "camera_angle_y")
    fisheye = lens.camera_model == "OPENCV_FISHEYE" or lens.is_fisheye  # as instant-ngp states it
    if lens.k4 and not fisheye:
        raise ValueError(f"k4 belongs to camera_model OPENCV_FISHEYE (got {lens.camera_model})")
    distortion = (lens.k1, lens.k2, lens.p1, lens.p2) + ((lens.k3,) if lens.k3 else ())
    if fisheye:
        distortion = (lens.k1, lens.k2, lens.k3, lens.k4)
    return Camera(
        width=width,
        height=height,
        fx=float(focal),
        fy=float(focal_y or focal),
        cx=0.5 * width if lens.cx is None else lens.cx,
        cy=0.5 * height if lens.cy is None else lens.cy,
        world_from_camera=pose @ OPENCV_FROM_OPENGL,
        distortion=distortion if fisheye or any(distortion) else (),
        lens="fisheye" if fisheye else "opencv",
    )


def _focal(size: float, angle: float, key: str) -> float:
    """Return the focal length [px] of a field of view [rad] of ``size`` pixels."""
    if not 0 < angle < np.pi:
        raise ValueError(f"{key} must be 0 to pi radians (got {angle:g}: is it in degrees?)")
    return float(0.5 * size / np.tan(0.5 * angle))
