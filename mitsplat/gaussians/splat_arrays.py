"""Arrays of Gaussians as files have them, and their activations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import expit

from mitsplat.arrays import Float32Array


class SplatArrays(NamedTuple):
    """Activated, unchecked arrays of N Gaussians, in the shapes of :class:`~mitsplat.gaussians.splat_cloud.Splats`."""

    means: Float32Array
    quats: Float32Array
    scales: Float32Array
    opacities: Float32Array
    sh: Float32Array


def exponential(logarithms: npt.ArrayLike) -> Float32Array:
    """Return scales from their logarithms, element by element."""
    with np.errstate(over="ignore"):  # overflow becomes inf, which Splats refuses
        return np.exp(np.asarray(logarithms, dtype=np.float64)).astype(np.float32)


def sigmoid(logits: npt.ArrayLike) -> Float32Array:
    """Return opacities from their logits, element by element."""
    return np.asarray(expit(np.asarray(logits, dtype=np.float64)), dtype=np.float32)
