"""Pictures no larger than what is measured in them needs."""

from __future__ import annotations

import cv2
import numpy as np

from mitsplat.arrays import ByteImage


def shrink(grey: ByteImage, edge: int) -> ByteImage:
    """A grey picture, shape (H, W), whose longer edge is at most ``edge`` px."""
    scale = edge / max(grey.shape)
    if scale >= 1:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
