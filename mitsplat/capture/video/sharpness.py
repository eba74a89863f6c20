"""How sharp a picture is, as a number to compare pictures of one thing by."""

from __future__ import annotations

import cv2

from mitsplat.arrays import ByteImage
from mitsplat.capture.video.shrink import shrink

_JUDGED_EDGE = 800
"""Longer edge at which sharpness is measured [px], so that size and noise matter little."""


def sharpness(grey: ByteImage) -> float:
    """Variance of the Laplacian (Pech-Pacheco et al. 2000) of a grey picture, shape (H, W), at a fixed size."""
    return float(cv2.Laplacian(shrink(grey, _JUDGED_EDGE), cv2.CV_32F).var())
