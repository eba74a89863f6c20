"""Reading of images by OpenCV from any path. OpenCV itself crashes on paths that are not UTF-8."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt


def read_picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> npt.NDArray[Any] | None:
    """Return the pixels of an image file as ``cv2.imread`` does; None if the file cannot be read or is no image."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except (OSError, ValueError):
        return None
    return cv2.imdecode(data, flags) if len(data) else None
