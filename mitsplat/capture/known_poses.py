"""Import of known cameras from COLMAP models and NeRF's ``transforms.json``, matched to photographs."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
from PIL import Image, ImageOps
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsplat.capture.name_matching import match_names
from mitsplat.capture.photos import Prepared, shapes_differ, turn_upright, with_orientation
from mitsplat.capture.structure_from_motion import SparseModel, find_points, read_colmap_model
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL
from mitsplat.images.colour import LUMINANCE, eight_bit
from mitsplat.progress import Progress

_Row = tuple[float, float, float, float]
_Positive = Annotated[float, Field(gt=0)]


MIN_REGISTERED = 0.75
"""Minimum fraction of photos with a camera for a successful capture."""

_MAX_COORDINATE = 1e9
"""Largest accepted coordinate of a camera or a point, in units of the model; geocentric coordinates in metres reach
6e6.
"""
_FIRST_TURNED = 5
"""First EXIF orientation that exchanges width and height."""
_MIN_COLOURS = 20
"""Minimum number of observed points for a decision by their colours."""
_MIN_CORRELATION = 0.5
"""Minimum correlation of the luminances of points and photo."""
_MAX_UNEXPLAINED = 0.6
"""Maximum ratio of the unexplained variances of the luminances, right orientation against wrong."""


class _Lens(BaseModel):
    """Intrinsics of all frames or of one frame; pixel centres are at +0.5, by the convention of COLMAP."""

    model_config = ConfigDict(allow_inf_nan=False)

    camera_angle_x: _Positive | None = None
    camera_angle_y: _Positive | None = None
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


class _Transforms(_Lens):
    frames: list[_Frame] = Field(min_length=1)


def read_poses(
    source: Path,
    photos: Sequence[Prepared],
    folder: Path,
    progress: Progress | None = None,
    *,
    base: Path,
    unusable: Sequence[str] = (),
) -> tuple[SparseModel, list[Prepared]]:
    """Read the cameras of photographs from a file, keyed by the file names of the copies.

    If the model has no points, points are triangulated from the photographs with fixed cameras.

    Args:
        source: Folder of a COLMAP model (``.bin`` or ``.txt``), or a ``transforms.json`` (OpenGL axes).
        photos: Copies of the photographs without EXIF rotation, because COLMAP ignores it.
        folder: Folder for intermediate files.
        progress: Callback with the present activity.
        base: Folder of the photographs.
        unusable: Names of photographs without copies, which the model may name too.

    Returns:
        The model, and the photos. Photos whose cameras hold for the upright image have upright copies.

    Raises:
        InputError: If the file is damaged or contains none of the photos, if names are ambiguous, or if it is unknown
            whether a camera holds for a photo before or after its EXIF rotation.
        MissingResourceError: If COLMAP aborts its process.
    """
    by_name = {photo.name: photo for photo in photos}
    everything = [*by_name, *unusable]
    if source.is_dir():
        model = read_colmap_model(source, folder / "given")
        paths = {name: PurePosixPath(name.replace("\\", "/")) for name in model.cameras}
        names = match_names(source, paths, base, everything)
        sized = set(model.cameras)
    elif source.suffix == ".json":
        content = _parse_transforms(source)
        paths = _frame_paths(source, content)
        names = match_names(source, paths, base, everything)
        sizes = {name: by_name[photo].size for name, photo in names.items() if photo in by_name}
        model, sized = _read_transforms(source, content, sizes)
    else:
        raise InputError(f"{source}: poses must be the folder of a COLMAP model or a transforms.json")
    matched = {name: by_name[photo] for name, photo in names.items() if photo in by_name and name in model.cameras}
    if len(matched) < 2:
        first = next(iter(paths))
        named = f"it names {first}, and a photo is {next(iter(everything), 'missing')}"
        raise InputError(f"{source}: must name at least two of the photos (got {len(matched)}; {named})")
    _check_coordinates(source, model)
    upright = _upright_photos(source, model, matched, sized)
    matched |= {name: turn_upright(photo) for name, photo in matched.items() if photo.name in upright}
    cameras = {
        photo.file.name: _resized_camera(source, name, model.cameras[name], photo.size)
        for name, photo in matched.items()
    }
    turned = {photo.name: photo for photo in matched.values()}
    photos = [turned.get(photo.name, photo) for photo in photos]
    if not len(model.points):
        return find_points([p for p in photos if p.file.name in cameras], cameras, folder, progress), photos
    seen = {photo.file.name: model.seen[name] for name, photo in matched.items()}
    return replace(model, cameras=cameras, seen=seen), photos


def unnamed_photos(source: Path, photos: Sequence[str], base: Path) -> list[str]:
    """Return the pictures that a ``transforms.json`` does not name, such as the depth maps in NeRF's synthetic data.

    Args:
        source: Source of the cameras. The folder of a COLMAP model names only the photos that COLMAP registered, so it
            leaves out none.
        photos: Pictures relative to their folder.
        base: Folder of the pictures.

    Returns:
        None of them if pictures of many frames are missing, because names may be wrong then.
    """
    if source.is_dir() or source.suffix != ".json":
        return []
    paths = _frame_paths(source, _parse_transforms(source))
    named = set(match_names(source, paths, base, photos).values())
    if len(named) < MIN_REGISTERED * min(len(paths), len(photos)):
        return []
    return [photo for photo in photos if photo not in named]


def _frame_paths(source: Path, content: _Transforms) -> dict[str, PurePosixPath]:
    """Return the path of each image of a ``transforms.json``; its paths are relative to the file."""
    return {frame.file_path: _below(source.resolve().parent, frame.file_path) for frame in content.frames}


def _below(folder: Path, name: str) -> PurePosixPath:
    """Return the path of a file relative to a folder, which may have backslashes and parts ``..``."""
    return PurePosixPath(os.path.normpath(folder / name.replace("\\", "/")))


def _upright_photos(
    source: Path, model: SparseModel, matched: Mapping[str, Prepared], sized: Collection[str]
) -> set[str]:
    """Return the names of the photos with EXIF rotation whose cameras hold for the upright image.

    The size of the model's image decides. Half turns, mirror images and square images have the same size: there, the
    colours of the model's points decide, and else the other photos.

    Args:
        source: Model, for messages.
        model: Cameras and points, by names of the model.
        matched: Photos by names of the model.
        sized: Names for which the model states the size of the image.

    Raises:
        InputError: If nothing decides.
    """
    upright, undecided = {}, []
    for name, photo in matched.items():
        if photo.pending == 1:
            continue
        stored = photo.size
        shown = stored[::-1] if photo.pending >= _FIRST_TURNED else stored
        fits = [name in sized and not shapes_differ(_size(model.cameras[name]), size) for size in (stored, shown)]
        decision = fits[1] if any(fits) and not all(fits) else None
        if decision is None and name in sized:
            decision = _coloured_upright(model, name, photo)
        if decision is None:
            undecided.append(photo)
        else:
            upright[photo.name] = decision
    decisions = set(upright.values())
    if undecided and len(decisions) != 1:
        raise InputError(
            f"{source}: does not state whether its camera of {undecided[0].name} refers to the photo before or after "
            f"the rotation in its EXIF data (orientation {undecided[0].pending}): rotate the pixels or remove the entry"
        )
    return {name for name, decision in upright.items() if decision} | {
        photo.name for photo in undecided if True in decisions
    }


def _coloured_upright(model: SparseModel, name: str, photo: Prepared) -> bool | None:
    """Return True if the upright photo shows the colours of the model's points, False if the stored one does.

    Returns:
        None if the photo observes few points, or if the colours fit none or both.
    """
    seen = model.seen[name]
    camera, colours = model.cameras[name], model.colours[seen] @ LUMINANCE.astype(np.float64)
    with Image.open(photo.file) as image:
        stored = eight_bit(image)
    fits = []
    for turned in (stored, ImageOps.exif_transpose(with_orientation(stored, photo.pending))):
        grey = np.asarray(turned.convert("L"), dtype=np.float64)
        sight = camera.resized(turned.width, turned.height)
        inside, x, y = sight.visible_pixels(model.points[seen])
        if len(inside) < _MIN_COLOURS or not (np.ptp(colours[inside]) and np.ptp(grey[y, x])):
            return None
        fits.append(float(np.corrcoef(colours[inside], grey[y, x])[0, 1]))
    right, wrong = max(fits), min(fits)
    if right < _MIN_CORRELATION or 1 - right**2 > _MAX_UNEXPLAINED * (1 - max(wrong, 0) ** 2):
        return None
    return fits[1] == right


def _check_coordinates(source: Path, model: SparseModel) -> None:
    """Raise InputError if a camera or a point of the model is not finite or lies beyond ``_MAX_COORDINATE``."""
    places = [(f"camera {name}", camera.world_from_camera[:3, 3]) for name, camera in model.cameras.items()]
    places += [("a point", model.points)] if len(model.points) else []
    for name, place in places:
        if not (farthest := float(np.abs(place).max())) <= _MAX_COORDINATE:
            raise InputError(f"{source}: {name} must lie within {_MAX_COORDINATE:g} of the origin (got {farthest:g})")


def _parse_transforms(path: Path) -> _Transforms:
    """Read a ``transforms.json``."""
    try:
        return _Transforms.model_validate_json(path.read_bytes())
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


def _read_transforms(
    path: Path, content: _Transforms, sizes: Mapping[str, tuple[int, int]]
) -> tuple[SparseModel, set[str]]:
    """Return the cameras of a ``transforms.json`` by its file paths, and the paths for which it states the size.

    Frames without a size have that of their photo in ``sizes``, and are left out if they have none.
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
        if not np.array_equal(other.world_from_camera, camera.world_from_camera):
            raise InputError(f"{path}: frames[{number}]: an image must have one pose (got two of {frame.file_path})")
    empty = np.zeros((0, 3))
    nothing = {name: np.zeros(0, dtype=np.int32) for name in cameras}
    return SparseModel(cameras, empty, empty.astype(np.uint8), nothing), sized


def _lens_of(content: _Transforms, frame: _Frame) -> _Lens:
    """Return the lens of a frame: its own keys, and else those of all frames. A field of view is a focal length."""
    common, own = content.model_dump(exclude_unset=True), frame.model_dump(exclude_unset=True)
    if "camera_angle_x" in own and "fl_x" not in own:
        common = {key: value for key, value in common.items() if key not in ("fl_x", "fl_y", "camera_angle_y")}
    return _Lens.model_validate(common | own)


def _camera(lens: _Lens, width: int, height: int, pose: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Camera:
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
    pose = pose @ OPENCV_FROM_OPENGL
    return Camera(
        width=width,
        height=height,
        fx=float(focal),
        fy=float(focal_y or focal),
        cx=0.5 * width if lens.cx is None else lens.cx,
        cy=0.5 * height if lens.cy is None else lens.cy,
        world_from_camera=pose,
        distortion=distortion if fisheye or any(distortion) else (),
        lens="fisheye" if fisheye else "opencv",
    )


def _focal(size: float, angle: float, key: str) -> float:
    """Return the focal length [px] of a field of view [rad] of ``size`` pixels."""
    if not 0 < angle < np.pi:
        raise ValueError(f"{key} must be 0 to pi radians (got {angle:g}: is it in degrees?)")
    return float(0.5 * size / np.tan(0.5 * angle))


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _resized_camera(source: Path, name: str, camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera resized to the pixels of a reduced copy."""
    if shapes_differ(_size(camera), size):
        raise InputError(
            f"{source}: {name} must have the aspect ratio of its photo, {size[0]}x{size[1]} px (got {camera.width}x"
            f"{camera.height})"
        )
    return camera.resized(*size)
