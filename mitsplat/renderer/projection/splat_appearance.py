"""Appearance changes of captured Gaussians: colours and dirt.

The colour of a Gaussian comes from all its SH bands, evaluated towards the camera. It is linearised, multiplied by a
3x3 matrix, attenuated by dirt, and encoded again. No channel exceeds white unless the colour did before. Dirt is a
function of the Gaussian's centre in its own frame, independent of the view. It is value noise of three octaves on a
lattice with :data:`CELLS` cells along the object in the first octave (Ebert et al. 2003, "Texturing and Modeling",
chapter 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float32Array
from mitsplat.renderer.projection.gaussian import linear_to_srgb, srgb_to_linear
from mitsplat.renderer.projection.records import AppearanceRow
from mitsplat.renderer.rays.device_arrays import unit_float, wrapped

CELLS = 3.0
"""Cells of the coarsest noise along the longest side of an object."""

OCTAVES = 3
"""Octaves of noise, each with twice the frequency and half the amplitude of the previous one."""

CLEAN, COVERED = 0.4, 0.7
"""Noise value up to which there is no dirt, and value from which dirt has its full thickness."""

DIRT = (0.12, 0.09, 0.06)
"""Factor of opaque dirt on linear red, green and blue."""

_PRIMES = (0x8DA6B343, 0xD8163841, 0xCB1AB31F, 0x9E3779B1)


@dataclass(frozen=True)
class SplatAppearance:
    """Change of a placement's colours.

    Attributes:
        matrix: Matrix on linear colours, row by row.
        wear: Coverage of dirt at its full thickness, in [0, 1]; opaque dirt has the factors :data:`DIRT`.
        seed: Seed of the noise, below 2^23.
        size: Longest extent of the object in its own frame.
    """

    matrix: tuple[float, ...]
    wear: float
    seed: int
    size: float

    @property
    def row(self) -> list[float]:
        """The columns of :class:`AppearanceRow`."""
        return [1.0, *self.matrix, self.wear, float(self.seed), CELLS / self.size]


def appearance_rows(appearances: list[SplatAppearance | None]) -> Float32Array:
    """Return one :class:`AppearanceRow` per appearance; zeros where it is None."""
    nothing = [0.0] * AppearanceRow.WIDTH
    return np.array([nothing if one is None else one.row for one in appearances], np.float32).reshape(
        -1, AppearanceRow.WIDTH
    )


def apply_appearance(colour: list[mi.Float], row: list[mi.Float], point: mi.Vector3f) -> list[mi.Float]:
    """Apply the appearance rows of placements to display-encoded colours of Gaussians.

    ``point`` are the centres of the Gaussians in their own frames.
    """

    def change(colour: list[mi.Float], row: list[mi.Float], point: mi.Vector3f) -> list[mi.Float]:
        linear = [srgb_to_linear(c) for c in colour]
        thickness = dirt_thickness(point * row[AppearanceRow.CELLS], mi.UInt32(row[AppearanceRow.SEED]))
        cover, matrix = row[AppearanceRow.WEAR] * thickness, row[AppearanceRow.MATRIX]
        white = dr.maximum(dr.maximum(colour[0], colour[1]), dr.maximum(colour[2], 1.0))
        result = []
        for i in range(3):
            mixed = sum(matrix[3 * i + j] * linear[j] for j in range(3))
            result.append(dr.minimum(linear_to_srgb(mixed * (1 - cover * (1 - DIRT[i]))), white))
        return result

    present = row[AppearanceRow.PRESENT] > 0
    return list(dr.if_stmt((colour, row, point), present, change, lambda colour, *_: list(colour), label="appearance"))


def changed_colours(colours: Float32Array, appearance: SplatAppearance | None, points: Float32Array) -> Float32Array:
    """Apply an appearance to display-encoded colours (N, 3) of Gaussians with centres ``points`` (N, 3)."""
    if appearance is None:
        return colours
    columns, centres = (wrapped(mi.Float, np.asarray(values, np.float32)) for values in (colours, points))
    row = [dr.opaque(mi.Float, value, len(colours)) for value in appearance.row]
    changed = apply_appearance([*dr.unravel(mi.Color3f, columns)], row, dr.unravel(mi.Vector3f, centres))
    return np.stack([np.array(channel) for channel in changed], axis=1)


def dirt_thickness(point: mi.Vector3f, seed: mi.UInt32) -> mi.Float:
    """Return the thickness of dirt in [0, 1] at points, given in cells of the coarsest noise."""
    total, weight = mi.Float(0), 0.0
    for octave in range(OCTAVES):
        total += 0.5**octave * _value_noise(point * 2.0**octave, seed + octave)
        weight += 0.5**octave
    t = dr.clip((total / weight - CLEAN) / (COVERED - CLEAN), 0, 1)
    return t * t * (3 - 2 * t)


def _value_noise(point: mi.Vector3f, seed: mi.UInt32) -> mi.Float:
    """Return random values in [0, 1) at integer coordinates, with cubic interpolation between them."""
    low = [mi.Int32(dr.floor(c)) for c in point]
    share = [c - mi.Float(i) for c, i in zip(point, low, strict=True)]
    share = [t * t * (3 - 2 * t) for t in share]
    total = mi.Float(0)
    for corner in range(8):
        ahead = [corner >> axis & 1 for axis in range(3)]
        weight = mi.Float(1)
        key = seed * _PRIMES[3]
        for i, step, t, prime in zip(low, ahead, share, _PRIMES, strict=False):
            weight *= t if step else 1 - t
            key += mi.UInt32(i + step) * prime
        total += weight * unit_float(_hashed(key))
    return total


def _hashed(key: mi.UInt32) -> mi.UInt32:
    """Return a 32-bit hash (Wellons 2018, "Hash Function Prospector", lowbias32)."""
    key = (key ^ (key >> 16)) * 0x7FEB352D
    key = (key ^ (key >> 15)) * 0x846CA68B
    return key ^ (key >> 16)
