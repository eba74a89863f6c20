"""How sharp a picture is, as a number to compare pictures of one thing by."""

from __future__ import annotations

import cv2
import numpy as np

from mitsplat.arrays import ByteImage

_JUDGED_EDGE = 800
"""Longer edge at which sharpness is measured [px], so that size and noise matter little."""


def sharpness(grey: ByteImage) -> float:
    """Variance of the Laplacian (Pech-Pacheco et al. 2000) of a grey picture, shape (H, W), at a fixed size."""
    scale = _JUDGED_EDGE / max(grey.shape)
    if scale < 1:
        grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())
