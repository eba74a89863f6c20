"""Import of known cameras from COLMAP models and NeRF's ``transforms.json``, matched to photographs."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image, ImageOps

from mitsplat.capture.name_matching import match_names
from mitsplat.capture.nerf_transforms import (
    POSES_RULE,
    Transforms,
    parse_transforms,
    read_transforms,
    transforms_remarks,
)
from mitsplat.capture.photos import Prepared, shapes_differ, turn_upright, with_orientation
from mitsplat.capture.structure_from_motion import SparseModel, find_points, read_colmap_model
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import LUMINANCE, eight_bit
from mitsplat.progress import Progress
from mitsplat.storage.calibration_files import refuse_calibration

_logger = logging.getLogger(__name__)

MIN_REGISTERED = 0.75
"""Minimum fraction of photos with a camera for a successful capture."""

_MAX_COORDINATE = 1e9
"""Largest accepted coordinate of cameras and points [units of the model]; geocentric ones in metres reach 6e6."""
_MAX_OBLONG = 1.2
"""Ratio of the focal lengths along x and y above which they are named."""
_MAX_OFFSET = 0.2
"""Distance of a principal point from the middle of the image above which it is named, in image sizes."""
_FIRST_TURNED = 5
"""First EXIF orientation that exchanges width and height."""
_MIN_COLOURS = 20
"""Minimum number of observed points for a decision by their colours."""
_MIN_CORRELATION = 0.5
"""Minimum correlation of the luminances of points and photo."""
_MAX_UNEXPLAINED = 0.6
"""Maximum ratio of the unexplained variances of the luminances, right orientation against wrong."""


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
    model, matched, sized = _read_model(source, photos, folder, base, unusable)
    _check_coordinates(source, model)
    for remark in _lens_remarks(model, matched):
        _logger.warning("%s: %s", source, remark)
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


def _read_model(
    source: Path, photos: Sequence[Prepared], folder: Path, base: Path, unusable: Sequence[str]
) -> tuple[SparseModel, dict[str, Prepared], set[str]]:
    """Return the model of a file, its photos by the names in the file, and the names whose image size is stated."""
    by_name = {photo.name: photo for photo in photos}
    everything = [*by_name, *unusable]
    refuse_calibration(source, POSES_RULE)
    if source.is_dir():
        model = read_colmap_model(source, folder / "given")
        paths = {name: PurePosixPath(name.replace("\\", "/")) for name in model.cameras}
        names = match_names(source, paths, base, everything)
        sized = set(model.cameras)
    elif source.suffix == ".json":
        content = parse_transforms(source)
        for remark in transforms_remarks(content):
            _logger.warning("%s: %s", source, remark)
        paths = _frame_paths(source, content)
        names = match_names(source, paths, base, everything)
        own = {name: by_name[photo] for name, photo in names.items() if photo in by_name}
        sizes = {name: photo.full_size or photo.size for name, photo in own.items()}
        model, sized = read_transforms(source, content, sizes)
    else:
        raise InputError(f"{source}: {POSES_RULE}")
    matched = {name: by_name[photo] for name, photo in names.items() if photo in by_name and name in model.cameras}
    if len(matched) < 2:
        first = next(iter(paths))
        named = f"it names {first}, and a photo is {next(iter(everything), 'missing')}"
        raise InputError(f"{source}: must name at least two of the photos (got {len(matched)}; {named})")
    return model, matched, sized


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
    paths = _frame_paths(source, parse_transforms(source))
    named = set(match_names(source, paths, base, photos).values())
    if len(named) < MIN_REGISTERED * min(len(paths), len(photos)):
        return []
    return [photo for photo in photos if photo not in named]


def _frame_paths(source: Path, content: Transforms) -> dict[str, PurePosixPath]:
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
        fits = [name in sized and not shapes_differ(model.cameras[name].size, size) for size in (stored, shown)]
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


def _lens_remarks(model: SparseModel, names: Collection[str]) -> Iterator[str]:
    """Yield a sentence for the first camera of each kind of implausible intrinsics."""
    cameras = [(name, camera) for name, camera in model.cameras.items() if name in names]
    for name, camera in cameras:
        if (ratio := max(camera.fx / camera.fy, camera.fy / camera.fx)) > _MAX_OBLONG:
            yield (
                f"{name}: fx = {camera.fx:g} and fy = {camera.fy:g} differ by a factor of {ratio:.3g}: is one of them "
                "of another image size? Most cameras have square pixels"
            )
            break
    for name, camera in cameras:
        if max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)) > _MAX_OFFSET:
            yield (
                f"{name}: the principal point cx, cy = {camera.cx:g}, {camera.cy:g} is far from the middle of the "
                f"image of {camera.width}x{camera.height} px: are they of another image size, or is the photo cropped?"
            )
            break


def _check_coordinates(source: Path, model: SparseModel) -> None:
    """Raise InputError if a camera or a point of the model is not finite or lies beyond ``_MAX_COORDINATE``."""
    places = [(f"camera {name}", camera.world_from_camera[:3, 3]) for name, camera in model.cameras.items()]
    places += [("a point", model.points)] if len(model.points) else []
    for name, place in places:
        if not (farthest := float(np.abs(place).max())) <= _MAX_COORDINATE:
            raise InputError(f"{source}: {name} must lie within {_MAX_COORDINATE:g} of the origin (got {farthest:g})")


def _resized_camera(source: Path, name: str, camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera resized to the pixels of a reduced copy."""
    if shapes_differ(camera.size, size):
        raise InputError(
            f"{source}: {name} must have the aspect ratio of its photo, {size[0]}x{size[1]} px (got {camera.width}x"
            f"{camera.height})"
        )
    return camera.resized(*size)
