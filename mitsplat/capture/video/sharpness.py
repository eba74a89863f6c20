"""Sharpness measure for comparing pictures of the same scene."""

from __future__ import annotations

import cv2

from mitsplat.arrays import ByteImage
from mitsplat.capture.video.shrink import shrink

_JUDGED_EDGE = 800
"""Longer edge at which sharpness is measured [px], so that picture size and noise have little effect."""


def sharpness(grey: ByteImage) -> float:
    """Return the variance of the Laplacian (Pech-Pacheco et al. 2000) of a reduced grey picture, shape (H, W)."""
    return float(cv2.Laplacian(shrink(grey, _JUDGED_EDGE), cv2.CV_32F).var())
