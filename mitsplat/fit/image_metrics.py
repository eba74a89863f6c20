"""Image similarity metrics."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from skimage.metrics import structural_similarity


def psnr(seen: npt.NDArray[np.floating], truth: npt.NDArray[np.floating]) -> float:
    """Return the peak signal-to-noise ratio [dB] of pictures of one shape with values in [0, 1]."""
    return psnr_of(float(np.mean((seen - truth) ** 2)))


def psnr_of(error: float) -> float:
    """Return the peak signal-to-noise ratio [dB] of a mean squared error."""
    return float(-10.0 * np.log10(max(error, 1e-12)))


def ssim(seen: npt.NDArray[np.floating], truth: npt.NDArray[np.floating]) -> float:
    """Return the mean SSIM of pictures (H, W, 3) with values in [0, 1] and sides of at least 11 px.

    The window is that of Wang et al. 2004.
    """
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(seen, truth, data_range=1.0, channel_axis=2, **window))  # type: ignore[no-untyped-call]
