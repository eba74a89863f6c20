"""Reduction of pictures to the resolution of a measurement."""

from __future__ import annotations

import cv2
import numpy as np

from mitsplat.arrays import ByteImage


def shrink(grey: ByteImage, edge: int) -> ByteImage:
    """Reduce a grey picture, shape (H, W), so that its longer edge is at most ``edge`` px."""
    scale = edge / max(grey.shape)
    if scale >= 1:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
