"""Base colours of surface points that explain their radiance in photographs, for a given material."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.reconstruct.materials.observations import Observations
from mitsplat.reconstruct.materials.surface_light import Reflectance

_ROUNDS = 4
"""Rounds of a robust fit."""
_NOISE = 0.1, 0.01
"""Standard error of radiance: relative, and absolute."""


class ColourFit(NamedTuple):
    """Base colours (P, 3), robust mean errors (P,), and the weights (P,) of the base colours in the data."""

    colours: Float64Array
    errors: Float64Array
    weights: Float64Array


def mix_materials(traced: Reflectance, metallic: float, place: float) -> tuple[Float64Array, Float64Array]:
    """Return tint and white part (R, 3) of a material; ``place`` is that of its roughness in the grid."""
    low = min(int(place), traced.tint.shape[1] - 1)
    high, share = min(low + 1, traced.tint.shape[1] - 1), place - low

    def at(values: Float32Array) -> Float64Array:
        return np.asarray((1 - share) * values[:, low].astype(np.float64) + share * values[:, high])

    tint = (1 - metallic) * at(traced.diffuse) + metallic * at(traced.tint)
    return tint, metallic * at(traced.metal) + (1 - metallic) * at(traced.dielectric)


def fit_colours(
    seen: Observations, material: tuple[Float64Array, Float64Array], colour: Float64Array | None = None
) -> ColourFit:
    """Fit the base colour of every point by iteratively reweighted least squares with Cauchy's loss.

    If ``colour`` (3,) is given, it is the base colour of all points.
    """
    tint, white = material
    starts = np.flatnonzero(np.diff(seen.point, prepend=-1))
    counts = np.diff(starts, append=len(seen.point))
    scale = _NOISE[0] * seen.radiance + _NOISE[1]
    weight = ~seen.clipped / scale**2
    for _ in range(_ROUNDS if colour is None else 1):
        sums = np.add.reduceat(weight * tint**2, starts)
        colours = np.clip(np.add.reduceat(weight * tint * (seen.radiance - white), starts) / (sums + 1e-9), 0, 1)
        if colour is not None:
            colours = np.broadcast_to(colour, colours.shape)
        predicted = np.repeat(colours, counts, axis=0) * tint + white
        excess = predicted - seen.radiance
        # The product of both scales makes the error depend on the ratio of both radiances only. With the scale of the
        # observation, dark ones would have more weight, and colours would be too dark.
        predicted_scale = _NOISE[0] * predicted + _NOISE[1]
        # A clipped pixel limits the radiance from below only.
        free = seen.clipped & (excess > 0)
        square = np.where(free, 0, excess**2 / (scale * predicted_scale))
        weight = ~free * (scale + predicted_scale) / (2 * scale * predicted_scale**2 * (1 + square))
    errors = np.add.reduceat(np.log1p(square).mean(axis=1), starts) / counts
    return ColourFit(colours, errors, sums)
