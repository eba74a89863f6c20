"""Reading of untrusted images by OpenCV from any path, and the faults of images that Pillow reads.

OpenCV itself crashes on paths that are not UTF-8.
"""

from __future__ import annotations

import io
import re
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from mitsplat.arrays import AnyArray
from mitsplat.storage.files import IMAGE_ERRORS, is_inside, read_regular

MAX_FILE_BYTES = 1 << 29
"""Maximum size of an image file [bytes]."""


def read_picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> AnyArray | None:
    """Return the pixels (H, W) or (H, W, C) of an image file as ``cv2.imread`` does.

    Returns:
        None if the file cannot be read, is no image, or has more bytes than :data:`MAX_FILE_BYTES` or more pixels than
        Pillow accepts.
    """
    try:
        data = read_regular(path, MAX_FILE_BYTES)
        Image.open(io.BytesIO(data)).close()  # reads the header
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (*IMAGE_ERRORS, cv2.error):
        return None


def read_picture_inside(folder: Path, name: str, flags: int = cv2.IMREAD_COLOR) -> AnyArray | None:
    """Return the pixels of an image file as :func:`read_picture`; None also if a link leads out of the folder."""
    return read_picture(folder / name, flags) if is_inside(folder, name) else None


def describe_fault(error: Exception) -> str:
    """Return the reason why Pillow cannot read an image, such as too many pixels."""
    if isinstance(error, Image.DecompressionBombError):
        pixels, limit = re.findall(r"\d+", str(error))
        return f"it must have at most {limit} pixels, got {pixels}"
    return str(error)
