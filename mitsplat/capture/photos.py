"""Preparation of photographs: selection of usable photos, and upright copies for all later stages."""

from __future__ import annotations

import shutil
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, ImageOps

from mitsplat.capture.capture import Photo, stored_name
from mitsplat.capture.video.sharpness import sharpness
from mitsplat.errors import InputError
from mitsplat.images.colour import eight_bit
from mitsplat.progress import Progress
from mitsplat.runtime.cores import usable_cores
from mitsplat.storage.file_kinds import check_name
from mitsplat.storage.files import IMAGE_ERRORS, files_below, write_file

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_UNSUPPORTED = (".arw", ".avif", ".cr2", ".cr3", ".dng", ".heic", ".heif", ".nef")
_LOSSY = ("JPEG", "MPO", "WEBP")

_MIN_SHARPNESS = 0.12
"""Minimum sharpness as a fraction of the median of all photos.

A Gaussian blur of 3 px at 1600 px falls below this limit. Sharp views of one object differ by a factor of up to 2.5 in
both directions and stay above it.
"""

_MAX_CLIPPED = 0.9
"""Fraction of black or white pixels above which a photo is unusable; a white backdrop covers less."""


@dataclass(frozen=True)
class Prepared:
    """Upright copy of a photo.

    Attributes:
        name: Path of the photo relative to the input folder, as given by the user.
        file: File of the copy.
        size: Width and height [px].
        orientation: EXIF orientation that was applied, 1 to 8 (1: none).
        lens: Camera make and model, focal length and size; photos with equal values can share intrinsics.
    """

    name: str
    file: Path
    size: tuple[int, int]
    orientation: int
    lens: tuple[str, ...]


@dataclass(frozen=True)
class _MeasuredPhoto:
    prepared: Prepared
    sharpness: float
    clipped: tuple[float, float]


def find_photos(folder: Path, *, but: Path | None = None) -> list[Path]:
    """Return the photographs below a folder and its linked folders, sorted; hidden files are excluded.

    Args:
        folder: Folder of the photographs.
        but: Folder whose pictures are excluded.

    Raises:
        InputError: If the folder does not exist, the name of a photograph is not UTF-8, or two photographs would have
            copies of the same name.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: must be an existing folder of photographs, or a video")
    found: dict[str, Path] = {}
    for path in files_below(folder, skip=but):
        name = path.relative_to(folder).as_posix()
        if path.suffix.lower() not in SUFFIXES + _UNSUPPORTED or not path.is_file() or "/." in f"/{name}":
            continue
        check_name(path)
        other = found.setdefault(stored_name(name, path.suffix.lower()), path)
        if other != path:
            raise InputError(f"{path}: its copy would have the same name as that of {other}: rename one of them")
    return list(found.values())


def prepare_photos(
    folder: Path,
    out: Path,
    *,
    but: Path | None = None,
    max_size: int,
    upright: bool = True,
    progress: Progress | None = None,
) -> tuple[list[Prepared], dict[str, str]]:
    """Make upright copies of the usable photographs below ``folder``.

    EXIF orientation is applied because COLMAP ignores it. Photos larger than ``max_size`` are reduced. A photo that
    needs neither is copied byte by byte.

    Args:
        folder: Folder of photographs, at any depth.
        but: Folder whose pictures are excluded.
        out: Folder of the copies; existing copies are reused.
        max_size: Longest edge of the copies [px].
        upright: Apply the EXIF orientation. Known cameras ignore it.
        progress: Callback with the number of finished photos.

    Returns:
        The copies, and the reasons why other photos are unusable, by name.

    Raises:
        InputError: As :func:`find_photos`.
    """
    files = find_photos(folder, but=but)
    out.mkdir(parents=True, exist_ok=True)
    measured: list[_MeasuredPhoto] = []
    rejected: dict[str, str] = {}
    with ThreadPoolExecutor(usable_cores()) as pool:
        results = pool.map(partial(_prepare, folder=folder, out=out, max_size=max_size, upright=upright), files)
        for done, (file, result) in enumerate(zip(files, results, strict=True), start=1):
            if isinstance(result, str):
                rejected[file.relative_to(folder).as_posix()] = result
            else:
                measured.append(result)
            if progress is not None:
                progress(done, len(files), "reading photos")
    median = float(np.median([photo.sharpness for photo in measured])) if measured else 0.0
    good = []
    for photo in measured:
        reason = _photo_fault(photo, median)
        if reason is None:
            good.append(photo.prepared)
        else:
            rejected[photo.prepared.name] = reason
    return good, rejected


def _prepare(path: Path, *, folder: Path, out: Path, max_size: int, upright: bool) -> _MeasuredPhoto | str:
    """Make the upright copy of a photo, or return the reason why it cannot be read."""
    if path.suffix.lower() in _UNSUPPORTED:
        return f"{path.suffix[1:].upper()} files are not supported; export it as JPEG or PNG"
    name = path.relative_to(folder).as_posix()
    try:
        with Image.open(path) as image:
            image.load()
            exif = image.getexif()
            details = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
            orientation = int(exif.get(ExifTags.Base.Orientation, 1)) if upright else 1
            turned = ImageOps.exif_transpose(image) if upright else image
            lossy, kept = image.format in _LOSSY, image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L")
    except IMAGE_ERRORS as error:
        return f"it cannot be read ({error})"
    kept &= max(turned.size) <= max_size and orientation == 1
    suffix = path.suffix if kept else ".jpg" if lossy else ".png"
    file = out / stored_name(name, suffix)
    rgb = eight_bit(turned)
    if max(rgb.size) > max_size:
        rgb.thumbnail((max_size, max_size), Image.Resampling.LANCZOS)
    if not file.exists():
        if kept:
            write_file(file, partial(shutil.copyfile, path))
        else:
            # EXIF is copied for the focal length, the initial value of COLMAP; the orientation is removed.
            exif = turned.getexif()
            exif.pop(ExifTags.Base.Orientation, None)
            try:
                kept_exif = exif.tobytes()
            except (ValueError, TypeError, AttributeError, struct.error):  # value types that no file can store
                kept_exif = b""
            options: dict[str, Any] = {"quality": 95, "subsampling": 0} if lossy else {}
            options["exif"] = kept_exif if len(kept_exif) < 65_000 else b""  # limit of a JPEG segment
            write_file(file, lambda part: rgb.save(part, "JPEG" if lossy else "PNG", **options))
    focal = details.get(ExifTags.Base.FocalLength), details.get(ExifTags.Base.FocalLengthIn35mmFilm)
    lens = (details.get(ExifTags.Base.Make), details.get(ExifTags.Base.Model), *focal, *rgb.size)
    grey = np.asarray(rgb.convert("L"))
    clipped = (float(np.mean(grey <= 4)), float(np.mean(grey >= 251)))
    return _MeasuredPhoto(Prepared(name, file, rgb.size, orientation, tuple(map(str, lens))), sharpness(grey), clipped)


def _photo_fault(photo: _MeasuredPhoto, median_sharpness: float) -> str | None:
    black, white = photo.clipped
    if black > _MAX_CLIPPED:
        return f"it is too dark ({black:.0%} of it is black)"
    if white > _MAX_CLIPPED:
        return f"it is too bright ({white:.0%} of it is white)"
    if photo.sharpness < _MIN_SHARPNESS * median_sharpness:
        return f"it is blurred (sharpness {photo.sharpness / median_sharpness:.0%} of the median photo's)"
    return None


def undistort(photo: Photo) -> Photo:
    """Resample the photo, as a PNG file, to a pinhole camera that shows no pixels beyond the photo's border."""
    camera = photo.camera
    if not camera.distortion:
        return photo
    pixels, pinhole = camera.undistorted(np.rint(255 * photo.read().rgb).astype(np.uint8))
    file = photo.file.with_name(f"{photo.file.name}.undistorted.png")
    write_file(file, lambda part: Image.fromarray(pixels).save(part, "PNG"))
    return replace(photo, file=file, camera=pinhole)
