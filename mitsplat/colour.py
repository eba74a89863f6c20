"""The transfer function between linear light and display-encoded colours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def encode_srgb(linear: npt.ArrayLike) -> FloatArray:
    """Display-encoded values of linear ones (IEC 61966-2-1), continued above 1 and clipped below 0."""
    linear = np.maximum(np.asarray(linear, dtype=np.float64), 0.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: npt.ArrayLike) -> FloatArray:
    """Linear values of display-encoded ones (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, dtype=np.float64)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4)
