"""Files of images, which must be whole before a detector learns from them or is judged by them."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from mitsplat.arrays import ByteImage
from mitsplat.errors import InputError
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.files import IMAGE_ERRORS, files_below

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
"""Images that Ultralytics reads as well."""
_WHOLE, _DECODED = ("JPEG", "MPO", "PNG", "WEBP"), ("BMP", "TIFF")
"""Formats of which Pillow tells whether a file is torn, and those of which only decoding it does."""
SMALLEST = 10
"""Sides of images that Ultralytics takes [px]."""
_JPEG_ENDS = b"\xff\xd9"
_ORIENTATION, _TURNED = 274, (5, 6, 7, 8)
"""The EXIF tag by which OpenCV turns images as it reads them, and its values that swap width and height."""


def images_below(folder: Path) -> list[Path]:
    """Images anywhere in a folder, and in folders that it links to, by name."""
    return [path for path in files_below(folder) if path.suffix.lower() in SUFFIXES]


def read_picture(path: Path) -> ByteImage:
    """An image as it is shown, turned by its EXIF orientation: shape (H, W, 3), BGR.

    Raises:
        InputError: If it cannot be read.
    """
    return _decoded(_content(path), path)  # not by OpenCV, which takes names in UTF-8 alone


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _decoded(data: bytes, path: Path) -> ByteImage:
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:  # of no bytes
        picture = None
    if picture is None:
        raise InputError(f"{path}: cannot be read as an image")
    return np.asarray(picture, dtype=np.uint8)


def look_at_image(path: Path) -> tuple[int, int, ContentHash]:
    """Width and height of an image as it is shown [px], and the hash of its content, which must be whole.

    Raises:
        InputError: If it cannot be read, is torn or of another format, or is too small.
    """
    data = _content(path)
    try:
        with Image.open(io.BytesIO(data)) as image:
            image.verify()
        with Image.open(io.BytesIO(data)) as image:
            width, height = image.size
            turned = image.getexif().get(_ORIENTATION) in _TURNED
            form = image.format
    except IMAGE_ERRORS as error:
        cause = "of no format that is known" if isinstance(error, UnidentifiedImageError) else error
        raise InputError(f"{path}: cannot be read as an image ({cause})") from error
    if form in ("JPEG", "MPO") and not data.endswith(_JPEG_ENDS):
        raise InputError(f"{path}: {_ends(data)}")
    if form not in _WHOLE + _DECODED:
        raise InputError(f"{path}: must be a JPEG, PNG, BMP, TIFF or WebP file (got {form})")
    if turned:
        width, height = height, width
    if form in _DECODED and _decoded(data, path).shape[:2] != (height, width):
        raise InputError(f"{path}: must be read by OpenCV as by others, {width} x {height} px: save it as PNG")
    if min(width, height) < SMALLEST:
        raise InputError(f"{path}: an image must have sides of {SMALLEST} px or more (got {width} x {height})")
    return width, height, ContentHash(data)


def _ends(jpeg: bytes) -> str:
    """What is wrong with a JPEG file that does not end with its end marker, which Ultralytics would write anew."""
    ends = jpeg.rfind(_JPEG_ENDS)
    try:
        with Image.open(io.BytesIO(jpeg[:ends] + _JPEG_ENDS)) as image:
            image.load()
    except IMAGE_ERRORS:
        ends = -1
    if ends < 0:
        return "is torn: a JPEG file must end with its end marker"
    return f"has {len(jpeg) - ends - len(_JPEG_ENDS)} bytes after its end marker: cut them off, or save it anew"
