"""Pictures read by OpenCV from any path: given a path that is not UTF-8, OpenCV itself ends the process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt


def read_picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> npt.NDArray[Any] | None:
    """Pixels of a file as ``cv2.imread`` gives them, or None if it cannot be read or is no picture."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except (OSError, ValueError):
        return None
    return cv2.imdecode(data, flags) if len(data) else None
