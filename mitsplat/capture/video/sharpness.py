"""Sharpness measure for comparing pictures of the same scene."""

from __future__ import annotations

import cv2
import numpy as np

from mitsplat.arrays import BoolArray, ByteImage

_JUDGED_EDGE = 800
"""Longer edge at which sharpness is measured [px], so that picture size and noise have little effect."""


def sharpness(grey: ByteImage, region: BoolArray | None = None) -> float:
    """Return the variance of the Laplacian (Pech-Pacheco et al. 2000) of a reduced grey picture.

    Args:
        grey: Picture, shape (H, W).
        region: Pixels to judge without those at the border of the region, shape (H, W); all pixels if None.
    """
    edges = cv2.Laplacian(shrink(grey, _JUDGED_EDGE), cv2.CV_32F)
    if region is not None:
        whole = shrink(np.uint8(255) * region.astype(np.uint8), _JUDGED_EDGE)
        inside = cv2.erode(whole, np.ones((5, 5), np.uint8)) == 255
        edges = edges[inside] if np.any(inside) else edges
    return float(edges.var())


def shrink(grey: ByteImage, edge: int) -> ByteImage:
    """Reduce a grey picture, shape (H, W), so that its longer edge is at most ``edge`` px."""
    scale = edge / max(grey.shape)
    if scale >= 1:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
