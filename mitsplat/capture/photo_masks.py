"""Object masks of photographs: given by the user, by transparency, by a plain background, or from a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.capture.capture import Capture, Photo, mask_name
from mitsplat.capture.photos import Prepared, alpha_channel, mask_files, plain_background, read_mask, with_orientation
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import border_of, largest_part
from mitsplat.progress import Progress
from mitsplat.runtime.onnx_networks import load_library
from mitsplat.storage.files import write_file

MaskMaker = Callable[[Photo], BoolArray]
"""Function that computes the mask of a photo, shape (H, W)."""

Hidden = Mapping[str, BoolArray]
"""Pixels (H, W) in which another object may occlude the object, by the name of the photo; photos without them are
absent.
"""
NO_OCCLUSION: Hidden = {}

MIN_SHARE = 0.02
"""Minimum fraction of a photo that a mask must cover; networks that find nothing mark less."""

MIN_AGREEMENT = 0.7
"""Minimum fraction of the object's points in a photo that its mask must cover."""

_MAX_BORDER = 0.9
"""Maximum fraction of the border of a photo that a mask may cover."""


def add_masks(
    capture: Capture,
    make: MaskMaker,
    folder: Path,
    *,
    progress: Progress | None = None,
    points: Float64Array | None = None,
    hidden: Hidden = NO_OCCLUSION,
    threads: int = 1,
) -> Capture:
    """Return the capture with a mask for each photo; photos with an unusable mask are rejected.

    Args:
        capture: Capture whose image files exist.
        make: Function that computes one mask.
        folder: Folder for the masks.
        progress: Callback with the number of finished photos.
        points: Points of the object that masks must cover, shape (N, 3).
        hidden: Pixels in which other objects may occlude the object.
        threads: Number of masks that are computed at the same time.
    """
    photos, rejected = [], dict(capture.rejected)

    def cut(photo: Photo) -> str | None:
        """Write the mask of a photo, or return the reason why it is unusable."""
        mask, unknown = make(photo), hidden.get(photo.name)
        mask = mask if unknown is None else mask & ~unknown
        reason = _mask_fault(mask, photo.camera, points, unknown)
        if reason is None:
            write_file(folder / mask_name(photo.name), partial(_save_mask, mask, unknown))
        return reason

    with ThreadPoolExecutor(threads) as pool:
        for done, (photo, reason) in enumerate(
            zip(capture.photos, pool.map(cut, capture.photos), strict=True), start=1
        ):
            if reason is None:
                photos.append(replace(photo, mask=folder / mask_name(photo.name)))
            else:
                rejected[photo.name] = reason
            if progress is not None:
                progress(done, len(capture.photos), "cutting out")
    return replace(capture, photos=tuple(photos), rejected=rejected)


def check_borders(capture: Capture, source: Path) -> Capture:
    """Return a capture with masks from the folder ``source``.

    Raises:
        InputError: If most masks are white along the border of the photo, as inverted masks are.
    """
    masks = [photo.read_mask()[0] for photo in capture.photos]
    around = sum(bool(border_of(mask).mean() > _MAX_BORDER) for mask in masks if mask is not None)
    if around > len(capture.photos) / 2:
        raise InputError(
            f"{source}: masks must be white, or photos opaque, only on the object (got {around} of "
            f"{len(capture.photos)} with a white or opaque border): invert them"
        )
    return capture


def given_masks(folder: Path, prepared: Mapping[str, Prepared], lenses: Mapping[str, Camera]) -> MaskMaker:
    """Return a function that reads masks of the user, see :func:`read_mask`.

    Args:
        folder: Folder of the masks.
        prepared: Photo copies by the name of the photo.
        lenses: Cameras of the copies, before distortion was removed.

    Raises:
        InputError: Raised by the returned function if a mask is missing or has another aspect ratio.
    """
    files = mask_files(folder)

    def make(photo: Photo) -> BoolArray:
        mask = read_mask(files, prepared[photo.name])
        if mask is None:
            raise InputError(
                f"{folder}: every photo must have a mask (missing: {Path(photo.name).with_suffix('.png').as_posix()})"
            )
        return _seen_by(photo.camera, mask, lenses[photo.name])

    return make


def cutout_masks(folder: Path, prepared: Mapping[str, Prepared], lenses: Mapping[str, Camera]) -> MaskMaker | None:
    """Return a function that takes the masks of photos whose background was removed from their transparency.

    Args:
        folder: Folder of the photos.
        prepared: Photo copies by the name of the photo.
        lenses: Cameras of the copies, before distortion was removed.

    Returns:
        None if a photo has no alpha channel, or if no photo has a transparent pixel.
    """
    opaque = [prepared[name].opaque for name in lenses]
    if None in opaque or min(share for share in opaque if share is not None) == 1:
        return None

    def make(photo: Photo) -> BoolArray:
        copy = prepared[photo.name]
        with Image.open(folder / photo.name) as image:
            alpha = alpha_channel(image)
        if alpha is None:  # replaced since it was prepared
            raise InputError(f"{folder / photo.name}: must have transparent pixels, as when it was read")
        alpha = ImageOps.exif_transpose(with_orientation(alpha, copy.orientation))
        mask = np.asarray(alpha.resize(copy.size, Image.Resampling.BOX)) >= 128
        return _seen_by(photo.camera, mask, lenses[photo.name])

    return make


def plain_masks(photos: Sequence[Photo]) -> MaskMaker | None:
    """Return a function that masks what is not the plain background of rendered photos; None if a photo has none."""

    def background(photo: Photo) -> BoolArray | None:
        rgb = np.rint(255 * replace(photo, gain=None).read().rgb).astype(np.uint8)
        return plain_background(rgb, without_noise=True)

    if any(background(photo) is None for photo in photos):
        return None

    def make(photo: Photo) -> BoolArray:
        plain = background(photo)
        return np.zeros((photo.camera.height, photo.camera.width), bool) if plain is None else ~plain

    return make


def _seen_by(camera: Camera, mask: BoolArray, lens: Camera) -> BoolArray:
    """Return a mask of a photo as its camera without distortion sees it; the mask itself if the lens is unchanged."""
    if not lens.distortion or camera.distortion:
        return mask
    pixels, _ = lens.undistorted(np.uint8(255) * mask.astype(np.uint8)[..., None])
    return np.asarray(pixels.reshape(camera.height, camera.width) >= 128)


def model_masks(model: Path) -> MaskMaker:
    """Return a function that computes masks by a segmentation network through rembg.

    The network is an ONNX file for dichotomous segmentation, like IS-Net.

    Raises:
        InputError: If the file does not exist or is no such network.
        MissingResourceError: If rembg is not installed, or ONNX Runtime is too old.
    """
    if not model.is_file():
        raise InputError(f"{model}: no such file")
    rembg = load_library("masks", "rembg")
    try:
        session: Any = rembg.new_session("dis_custom", model_path=str(model.resolve()))
    except Exception as error:  # exceptions of onnxruntime have no other base
        raise InputError(f"{model}: not a segmentation network in ONNX ({' '.join(str(error).split())})") from error

    def make(photo: Photo) -> BoolArray:
        with Image.open(photo.file) as image:
            cut = rembg.remove(image.convert("RGB"), session=session, only_mask=True, post_process_mask=False)
        return largest_part(np.asarray(cut.convert("L")) >= 128)

    return make


def _mask_fault(mask: BoolArray, camera: Camera, points: Float64Array | None, hidden: BoolArray | None) -> str | None:
    share = float(mask.mean())
    if share < MIN_SHARE:
        return f"its mask covers only {share:.1%} of it"
    if share > 0.98:
        return f"its mask covers {share:.1%} of it"
    if points is not None:
        _, x, y = camera.visible_pixels(points)
        if hidden is not None:
            x, y = x[~hidden[y, x]], y[~hidden[y, x]]
        agreement = float(mask[y, x].mean()) if len(x) else 0.0
        if agreement < MIN_AGREEMENT:
            return f"its mask covers only {agreement:.0%} of the object's points"
    return None


def _save_mask(mask: BoolArray, hidden: BoolArray | None, part: Path) -> None:
    picture = Image.fromarray(np.uint8(255) * mask.astype(np.uint8))
    if hidden is not None:
        picture.putalpha(Image.fromarray(np.uint8(255) * (~hidden).astype(np.uint8)))
    picture.save(part, "PNG")
