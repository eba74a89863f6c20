"""Image files, which must be complete before training or evaluation."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from mitsplat.arrays import ByteImage
from mitsplat.errors import InputError
from mitsplat.images.picture_files import MAX_FILE_BYTES
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.file_kinds import check_path_encoding
from mitsplat.storage.files import IMAGE_ERRORS, files_below, read_regular

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
"""Suffixes of images that Ultralytics also reads."""
_VERIFIED_FORMATS, _DECODED_FORMATS = ("JPEG", "MPO", "PNG", "WEBP"), ("BMP", "TIFF")
"""Formats that Pillow checks for truncation, and formats that must be decoded for this check."""
MIN_SIDE = 10
"""Least side of an image that Ultralytics accepts [px]."""
_JPEG_ENDS = b"\xff\xd9"
_MIN_BRIGHTEST = 20
"""Least value of the brightest pixel of a 16-bit image [of 255]; 12-bit values in a file of 16 bits are at most 15."""
_PNG_DEPTH, _TIFF_DEPTH = 24, 258
"""Position of the number of bits in a PNG file, and TIFF tag of the numbers of bits."""
_ORIENTATION, _TRANSPOSED = 274, (5, 6, 7, 8)
"""EXIF orientation tag, which OpenCV applies when it reads an image, and its values that swap width and height."""


def images_below(folder: Path) -> list[Path]:
    """Return all images in a folder and its subfolders, including linked folders, sorted by name.

    Raises:
        InputError: If the name of an image is not UTF-8.
    """
    images = [path for path in files_below(folder) if path.suffix.lower() in SUFFIXES]
    for path in images:
        check_path_encoding(path)
    return images


def read_upright(path: Path) -> ByteImage:
    """Read an image with its EXIF orientation applied: shape (H, W, 3), BGR.

    Raises:
        InputError: If the image cannot be read.
    """
    return _decode(_read_bytes(path), path)  # cv2.imread only accepts file names in UTF-8


def _read_bytes(path: Path) -> bytes:
    try:
        return read_regular(path, MAX_FILE_BYTES)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read ({reason})") from error


def _decode(data: bytes, path: Path) -> ByteImage:
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:  # empty data
        picture = None
    if picture is None:
        raise InputError(f"{path}: cannot be read as an image")
    return np.asarray(picture, dtype=np.uint8)


def check_complete(path: Path) -> tuple[int, int, ContentHash]:
    """Check that an image is complete; return its width and height after EXIF orientation [px] and its content hash.

    Raises:
        InputError: If the image cannot be read, is truncated, has an unknown format or is too small.
    """
    data = _read_bytes(path)
    try:
        with Image.open(io.BytesIO(data)) as image:
            image.verify()
        with Image.open(io.BytesIO(data)) as image:
            width, height = image.size
            turned = image.getexif().get(_ORIENTATION) in _TRANSPOSED
            form = image.format
            bits = _bits(image, data)
    except IMAGE_ERRORS as error:
        cause = "unknown format" if isinstance(error, UnidentifiedImageError) else error
        raise InputError(f"{path}: cannot be read as an image ({cause})") from error
    if form in ("JPEG", "MPO") and not data.endswith(_JPEG_ENDS):
        raise InputError(f"{path}: {_jpeg_end_error(data)}")
    if form not in _VERIFIED_FORMATS + _DECODED_FORMATS:
        raise InputError(f"{path}: must be a JPEG, PNG, BMP, TIFF or WebP file (got {form})")
    if turned:
        width, height = height, width
    if form in _DECODED_FORMATS and _decode(data, path).shape[:2] != (height, width):
        raise InputError(f"{path}: OpenCV must decode it to {width} x {height} px, as Pillow does: save it as PNG")
    if bits > 8 and 0 < (brightest := int(_decode(data, path).max())) < _MIN_BRIGHTEST:
        raise InputError(
            f"{path}: is too dark (its brightest pixel has {brightest} of 255): multiply 12-bit values in files of 16 "
            "bits by 16"
        )
    if min(width, height) < MIN_SIDE:
        raise InputError(f"{path}: an image must have sides of {MIN_SIDE} px or more (got {width} x {height})")
    return width, height, ContentHash(data)


def _bits(image: Image.Image, data: bytes) -> int:
    """Return the number of bits of each channel of a PNG or TIFF file, and 8 for other formats."""
    if image.format == "PNG":
        return data[_PNG_DEPTH]
    stated = image.getexif().get(_TIFF_DEPTH, 8) if image.format == "TIFF" else 8
    return int(max(stated, default=8) if isinstance(stated, tuple) else stated)


def _jpeg_end_error(jpeg: bytes) -> str:
    """Return an error text for a JPEG file without its end marker at the end; Ultralytics would rewrite such a file."""
    ends = jpeg.rfind(_JPEG_ENDS)
    try:
        with Image.open(io.BytesIO(jpeg[:ends] + _JPEG_ENDS)) as image:
            image.load()
    except IMAGE_ERRORS:
        ends = -1
    if ends < 0:
        return "is truncated: a JPEG file must end with its end marker"
    return f"has {len(jpeg) - ends - len(_JPEG_ENDS)} bytes after its end marker: remove them, or save the image again"
