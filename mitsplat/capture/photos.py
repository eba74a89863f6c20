"""Preparation of photographs: selection of usable photos, and upright copies for all later stages."""

from __future__ import annotations

import struct
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image, ImageOps

from mitsplat.arrays import BoolArray, ByteImage
from mitsplat.capture.capture import Photo, stored_name
from mitsplat.capture.name_matching import composed
from mitsplat.capture.video.sharpness import sharpness
from mitsplat.errors import InputError
from mitsplat.images.colour import eight_bit, in_srgb
from mitsplat.images.masks import border_of
from mitsplat.progress import Progress
from mitsplat.runtime.cores import usable_cores
from mitsplat.storage.file_kinds import check_path_encoding
from mitsplat.storage.files import IMAGE_ERRORS, copy_file, files_below, write_file

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_RAW = (".3fr", ".arw", ".cr2", ".cr3", ".dng", ".iiq", ".nef", ".orf", ".pef", ".raf", ".rw2", ".srw", ".x3f")
_UNSUPPORTED = (*_RAW, ".avif", ".heic", ".heif", ".jp2", ".jxl")
_LOSSY = ("JPEG", "MPO", "WEBP")
_COPY_SUFFIXES = (".jpg", ".png")
"""Suffixes of copies that are not equal to their photo."""

_MIN_SHARPNESS = 0.12
"""Minimum sharpness as a fraction of the median of all photos.

A Gaussian blur of 3 px at 1600 px falls below this limit. Sharp views of one object differ by a factor of up to 2.5 in
both directions and stay above it.
"""

_MAX_CLIPPED = 0.9
"""Fraction of black or white pixels above which a photo is unusable; a white backdrop covers less."""

_MIN_BRIGHTEST = 20
"""Minimum grey value of the brightest pixel of a photo [of 255]. 12-bit values in a file of 16 bits are at most 15."""

_PLAIN = 3
"""Largest difference of a plain background from black or white [of 255]; JPEG changes it that much."""
_NEARLY_PLAIN = 24
_MAX_NOISE = 0.02
"""Maximum fraction of the border of a rendered photo that is nearly black or white."""
_PLAIN_BORDER = 0.5
"""Minimum fraction of the border of a photo that a plain background takes."""

_LENS_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
"""EXIF data that differ between cameras and zoom settings."""

_MAX_LABEL = 50
"""Largest value of a mask that stores labels in place of white."""


@dataclass(frozen=True)
class Prepared:
    """Upright copy of a photo.

    Attributes:
        name: Path of the photo relative to the input folder, as given by the user.
        file: File of the copy.
        size: Width and height [px].
        orientation: EXIF orientation that was applied, 1 to 8 (1: none).
        lens: Width and height, and the camera make, model and focal length that the EXIF data state.
        pending: EXIF orientation that was not applied, 1 to 8 (1: none).
        opaque: Fraction of opaque pixels; None without an alpha channel.
        full_size: Width and height of the photo before it was reduced [px]; None if it was not.
    """

    name: str
    file: Path
    size: tuple[int, int]
    orientation: int
    lens: tuple[str, ...]
    pending: int = 1
    opaque: float | None = None
    full_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class _MeasuredPhoto:
    prepared: Prepared
    sharpness: float
    is_cutout: bool
    clipped: tuple[float, float]
    brightest: int


def find_photos(folder: Path, *, masks: Path | None = None) -> list[Path]:
    """Return the photographs below a folder and its linked folders, sorted; hidden files are excluded.

    Args:
        folder: Folder of the photographs.
        masks: Folder of masks, which are no photographs.

    Raises:
        InputError: If the folder does not exist, the name of a photograph is not UTF-8, or two photographs would have
            copies of the same name.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: must be an existing folder of photographs, or a video")
    copies: dict[str, Path] = {}
    for path in files_below(folder, skip=masks):
        name = path.relative_to(folder).as_posix()
        if path.suffix.lower() not in SUFFIXES + _UNSUPPORTED or not path.is_file() or "/." in f"/{name}":
            continue
        check_path_encoding(path)
        for suffix in {path.suffix.lower(), *_COPY_SUFFIXES}:
            other = copies.setdefault(stored_name(name, suffix), path)
            if other != path:
                raise InputError(f"{path}: its copy would have the same name as that of {other}: rename one of them")
    return list(dict.fromkeys(copies.values()))


def prepare_photos(
    folder: Path,
    out: Path,
    *,
    excluded: Collection[str] = (),
    max_size: int,
    upright: bool = True,
    masks: Path | None = None,
    progress: Progress | None = None,
) -> tuple[list[Prepared], dict[str, str]]:
    """Make upright copies of the usable photographs below ``folder``.

    EXIF orientation is applied because COLMAP ignores it, and colours become those of sRGB. Photos larger than
    ``max_size`` are reduced. A photo that needs none of this is copied byte by byte.

    Args:
        folder: Folder of photographs, at any depth.
        out: Folder of the copies; existing copies are reused.
        excluded: Names of pictures without a copy.
        max_size: Longest edge of the copies [px].
        upright: Apply the EXIF orientation. Without it, cameras are known, and photos may be rendered: a plain
            background is not judged then.
        masks: Folder of masks of the object, see :func:`find_photos`. A photo is too dark or too bright only if the
            object is too.
        progress: Callback with the number of finished photos.

    Returns:
        The copies, and the reasons why other photos are unusable, by name.

    Raises:
        InputError: As :func:`find_photos`.
    """
    files = [path for path in find_photos(folder, masks=masks) if path.relative_to(folder).as_posix() not in excluded]
    out.mkdir(parents=True, exist_ok=True)
    measured: list[_MeasuredPhoto] = []
    rejected: dict[str, str] = {}
    files_of_masks = {} if masks is None else mask_files(masks)
    prepare = partial(_prepare, folder=folder, out=out, max_size=max_size, upright=upright, masks=files_of_masks)
    with ThreadPoolExecutor(usable_cores()) as pool:
        results = pool.map(prepare, files)
        for done, (file, result) in enumerate(zip(files, results, strict=True), start=1):
            if isinstance(result, str):
                rejected[file.relative_to(folder).as_posix()] = result
            else:
                measured.append(result)
            if progress is not None:
                progress(done, len(files), "reading photos")
    # The sharpness of an object alone is comparable only to that of other photos without background.
    kinds = {photo.is_cutout for photo in measured}
    medians = {kind: float(np.median([p.sharpness for p in measured if p.is_cutout == kind])) for kind in kinds}
    good = []
    for photo in measured:
        reason = _photo_fault(photo, medians[photo.is_cutout])
        if reason is None:
            good.append(photo.prepared)
        else:
            rejected[photo.prepared.name] = reason
    return good, rejected


def _prepare(
    path: Path, *, folder: Path, out: Path, max_size: int, upright: bool, masks: Mapping[str, Path]
) -> _MeasuredPhoto | str:
    """Make the upright copy of a photo, or return the reason why it cannot be read."""
    if path.suffix.lower() in _UNSUPPORTED:
        return f"{path.suffix[1:].upper()} files are not supported; export it as JPEG or PNG"
    name = path.relative_to(folder).as_posix()
    try:
        with Image.open(path) as image:
            image.load()
            exif = image.getexif()
            details = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
            stated = exif.get(ExifTags.Base.Orientation, 1)
            stated = int(stated) if stated in range(1, 9) else 1
            orientation, pending = (stated, 1) if upright else (1, stated)
            turned = in_srgb(ImageOps.exif_transpose(image) if upright else image)
            is_srgb = turned.info.get("icc_profile") == image.info.get("icc_profile")
            lossy, kept = image.format in _LOSSY, image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L")
    except IMAGE_ERRORS as error:
        return f"it cannot be read ({error})"
    kept &= is_srgb and max(turned.size) <= max_size and orientation == pending == 1
    suffix = path.suffix if kept else ".jpg" if lossy else ".png"
    file = out / stored_name(name, suffix)
    rgb, full_size = eight_bit(turned), None
    if max(rgb.size) > max_size:
        full_size = rgb.size
        rgb.thumbnail((max_size, max_size), Image.Resampling.LANCZOS)
    if kept and not file.exists():
        copy_file(path, file)
    elif not file.exists():
        options: dict[str, int | bytes] = {"quality": 95, "subsampling": 0} if lossy else {}
        options["exif"] = _upright_exif(turned)
        write_file(file, lambda part: rgb.save(part, "JPEG" if lossy else "PNG", **options))
    stated = [details[tag] for tag in _LENS_TAGS if details.get(tag)]
    lens = (*rgb.size, *stated)
    alpha, shown, opaque = alpha_channel(turned), np.ones(rgb.size[::-1], bool), None
    if alpha is not None:
        shown = np.asarray(alpha.resize(rgb.size, Image.Resampling.BOX)) >= 128
        opaque = float(shown.mean())
        if not opaque:
            return "it is transparent"
    prepared = Prepared(name, file, rgb.size, orientation, tuple(map(str, lens)), pending, opaque, full_size)
    plain = None if upright else plain_background(np.asarray(rgb))
    mask = read_mask(masks, prepared) if pending == 1 else None  # the model decides on the orientation of the mask
    return _measure(prepared, np.asarray(rgb.convert("L")), shown, plain, mask)


def _measure(
    prepared: Prepared, grey: ByteImage, shown: BoolArray, plain: BoolArray | None, mask: BoolArray | None
) -> _MeasuredPhoto:
    """Measure the quality of a photo by its opaque pixels (``shown``), plain background and mask of the object."""
    foreground = shown if plain is None else shown & ~plain
    is_cutout = not foreground.all()
    sharp = sharpness(grey, foreground if is_cutout else None)
    regions = [shown, foreground] if mask is None else [shown, foreground, shown & mask]
    clipped = [(float(np.mean(grey[r] <= 4)), float(np.mean(grey[r] >= 251))) for r in regions if r.any()]
    return _MeasuredPhoto(prepared, sharp, is_cutout, min(clipped, key=max), int(grey[shown].max()))


def _upright_exif(image: Image.Image) -> bytes:
    """Return the EXIF data of an image without its orientation, which some readers apply.

    COLMAP takes the initial focal length from these data.
    """
    exif = image.getexif()
    exif.pop(ExifTags.Base.Orientation, None)
    try:
        data = exif.tobytes()
    except (ValueError, TypeError, AttributeError, struct.error):  # value types that no file can store
        return b""
    return data if len(data) < 65_000 else b""  # limit of a JPEG segment


def alpha_channel(image: Image.Image) -> Image.Image | None:
    """Return the alpha channel of an image; None if it has none."""
    if "transparency" in image.info:  # a colour, or the alpha of the colours of a palette
        image = image.convert("RGBA")
    return image.getchannel("A") if "A" in image.getbands() else None


def plain_background(rgb: ByteImage, *, without_noise: bool = False) -> BoolArray | None:
    """Return the background of a rendered photo (H, W, 3): black or white pixels that are connected to its border.

    With ``without_noise``, there is no background that has the noise of a camera.

    Returns:
        Shape (H, W); None unless at least half of the border has one colour, black or white.
    """
    border = border_of(rgb).astype(np.int16)
    for colour in (0, 255):
        plain, near = (np.mean((np.abs(border - colour) <= limit).all(axis=1)) for limit in (_PLAIN, _NEARLY_PLAIN))
        if plain < _PLAIN_BORDER or (without_noise and near - plain > _MAX_NOISE):
            continue
        alike = np.asarray((np.abs(rgb.astype(np.int16) - colour) <= _PLAIN).all(axis=2), dtype=np.uint8)
        parts = cv2.connectedComponents(alike, connectivity=4)[1]
        outer = np.unique(border_of(parts))
        return np.asarray(np.isin(parts, outer[outer > 0]))
    return None


def mask_files(folder: Path) -> dict[str, Path]:
    """Return the files of a folder of masks by their path relative to it, with composed letters in lower case."""
    below = sorted(path for path in folder.rglob("*") if path.is_file())
    return {composed(path.relative_to(folder).as_posix()).lower(): path for path in below}


def read_mask(files: Mapping[str, Path], photo: Prepared) -> BoolArray | None:
    """Read the mask of a photo in the size (H, W) of its copy; None if there is none.

    A mask file is ``<photo>.png``, with or without the photo's own suffix, in any case. White marks the object; in a
    picture with transparency, opaque pixels do. A mask has the orientation of the copy: as viewers show the photo, or,
    with known cameras, as the model has it. A mask in the orientation of the sensor is rotated by the EXIF orientation.

    Raises:
        InputError: If it cannot be read or has another aspect ratio.
    """
    name = Path(photo.name)
    candidates = [f"{photo.name}.png", name.with_suffix(".png").as_posix(), photo.name]
    path = next((files[key] for file in candidates if (key := composed(file).lower()) in files), None)
    if path is None:
        return None
    try:
        with Image.open(path) as image:
            turned = ImageOps.exif_transpose(image)
            mask = alpha_channel(turned)
            if mask is None or mask.getextrema() == (255, 255):  # a fully opaque alpha channel has no information
                mask = turned.convert("L")
    except IMAGE_ERRORS as error:
        raise InputError(f"{path}: not a readable image ({error})") from error
    most = int(np.asarray(mask).max())
    if 0 < most <= _MAX_LABEL:
        raise InputError(f"{path}: white, 255, must mark the object (got at most {most}): multiply labels by 255")
    size = photo.size
    if shapes_differ(mask.size, size) and not shapes_differ(mask.size[::-1], size):
        mask = ImageOps.exif_transpose(with_orientation(mask, photo.orientation))
    if shapes_differ(mask.size, size):
        raise InputError(
            f"{path}: must have the aspect ratio of its photo, {size[0]}x{size[1]} px (got {mask.width}x{mask.height})"
        )
    return np.asarray(mask.resize(size, Image.Resampling.BOX)) >= 128


def shapes_differ(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return True if two image sizes have different aspect ratios, beyond the rounding of a reduced copy."""
    return abs(one[0] * other[1] - one[1] * other[0]) > max(*one, *other)


def with_orientation(image: Image.Image, orientation: int) -> Image.Image:
    """Return a copy of an image with an EXIF orientation, which is not applied."""
    copy = image.copy()
    copy.getexif()[ExifTags.Base.Orientation] = orientation
    return copy


def turn_upright(photo: Prepared) -> Prepared:
    """Return the photo with its pending EXIF orientation applied, in a new copy; an existing copy is reused."""
    if photo.pending == 1:
        return photo
    file = photo.file.with_name(f"{photo.file.name}.upright.png")
    try:
        with Image.open(photo.file) as image:
            turned = ImageOps.exif_transpose(with_orientation(eight_bit(image), photo.pending))
    except IMAGE_ERRORS as error:
        raise InputError(f"{photo.file}: not a readable image ({error})") from error
    if not file.exists():
        write_file(file, lambda part: turned.save(part, "PNG", exif=b""))
    return replace(photo, file=file, size=turned.size, orientation=photo.pending, pending=1)


def _photo_fault(photo: _MeasuredPhoto, median_sharpness: float) -> str | None:
    black, white = photo.clipped
    if black > _MAX_CLIPPED:
        return f"it is too dark ({black:.0%} of it is black)"
    if photo.brightest < _MIN_BRIGHTEST:
        return (
            f"it is too dark (its brightest pixel has {photo.brightest} of 255): multiply 12-bit values in files of 16 "
            "bits by 16"
        )
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
