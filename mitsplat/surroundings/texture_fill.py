"""Completion of a hole in a texture with patches of the texture itself.

Patches are shifted to the position with the most similar surroundings (Efros and Leung 1999, by patches as Criminisi,
Pérez and Toyama 2004). Their colours are adapted to the border of the hole (Pérez, Gangnet and Blake 2003).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt
from scipy.signal import fftconvolve
from scipy.sparse import csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import spsolve

from mitsplat.arrays import BoolArray, Float64Array

_RING = 10
"""Width of the surroundings of a hole in the comparison of patches [cells]."""
_MIN_KNOWN = 0.5
"""Least share of these surroundings that must be known around a patch."""
_PATCHES = 8

Value = TypeVar("Value", bound=np.generic)


def fill_texture(texture: Float64Array, known: BoolArray, hole: BoolArray) -> tuple[Float64Array, float]:
    """Fill the hole of a texture (X, Y, 3) with shifted known parts; return the texture and the filled share.

    The remaining part of the hole is a smooth interpolation from the border.
    """
    given, source, left = texture, known, hole
    texture = np.where(known[..., None], texture, 0.0)
    for _ in range(_PATCHES):
        if not left.any() or not source.any():
            break
        shift = _best_shift(texture, known, source, left)
        if shift is None:
            break
        moved, there = _shifted(texture, shift), _shifted(source, shift)
        patch = left & there
        border = known & there & dilated(patch, 3)
        gap = np.where(border[..., None], texture - moved, 0.0)
        texture = np.where(patch[..., None], moved + _membrane(gap, border, patch), texture)
        known, left = known | patch, left & ~patch
    copied = 1 - float(left.sum()) / max(int(hole.sum()), 1)
    if left.any() and known.any():
        border = known & dilated(left, 3)
        texture = np.where(left[..., None], _membrane(texture, border, left), texture)
    return np.where(hole[..., None], texture.clip(0, 1), given), copied


def _best_shift(texture: Float64Array, known: BoolArray, source: BoolArray, hole: BoolArray) -> tuple[int, int] | None:
    """Return the shift with the most similar surroundings among those that cover most of the hole, or None.

    Similarity ignores a constant colour offset.
    """
    ring = (known & dilated(hole, _RING)).astype(np.float64)
    valid, target = source.astype(np.float64), texture * ring[..., None]
    there = texture * valid[..., None]

    def correlated(one: Float64Array, other: Float64Array) -> Float64Array:
        """Return the sum over positions p of one(p) other(p + shift); the middle of the result is no shift."""
        return np.asarray(fftconvolve(other, one[::-1, ::-1], mode="full"))

    covers = correlated(hole.astype(np.float64), valid)
    count = np.maximum(correlated(ring, valid), 1e-9)
    error = np.zeros_like(count)
    for k in range(3):
        difference = correlated(target[..., k], valid) - correlated(ring, there[..., k])
        squares = correlated(target[..., k] ** 2, valid) + correlated(ring, there[..., k] ** 2)
        error += (squares - 2 * correlated(target[..., k], there[..., k])) / count - (difference / count) ** 2
    usable = (count > _MIN_KNOWN * ring.sum()) & (covers > 0.5)
    if not usable.any():
        return None
    most = covers[usable].max()
    usable &= covers >= 0.95 * most
    place = np.unravel_index(int(np.where(usable, error, np.inf).argmin()), error.shape)
    return int(place[0]) - texture.shape[0] + 1, int(place[1]) - texture.shape[1] + 1


def _shifted(image: npt.NDArray[Value], shift: tuple[int, int]) -> npt.NDArray[Value]:
    """Return image(p + shift), zero outside the image."""
    result = np.zeros_like(image)
    to, of = [], []
    for size, step in zip(image.shape, shift, strict=False):
        to.append(slice(max(0, -step), min(size, size - step)))
        of.append(slice(max(0, step), min(size, size + step)))
    result[tuple(to)] = image[tuple(of)]
    return result


def _membrane(values: Float64Array, border: BoolArray, inside: BoolArray) -> Float64Array:
    """Return a smooth continuation of border values (X, Y, 3) inside, by Laplace's equation.

    The border values are only data terms, because single cells are noisy. The derivative across all other edges is
    zero.
    """
    cells = border | inside
    x, y = (slice(int(rows.min()), int(rows.max()) + 1) for rows in np.nonzero(cells))
    cells, fixed, given = cells[x, y], border[x, y], values[x, y]
    differ = [diags_array([-1.0, 1.0], offsets=[0, 1], shape=(max(n - 1, 0), n)) for n in cells.shape]
    across, down = kron(differ[0], eye_array(cells.shape[1])), kron(eye_array(cells.shape[0]), differ[1])
    own = cells.ravel().astype(np.float64)
    rows = [csr_array(step) for step in (across, down)]
    kept = [row[np.asarray(abs(row) @ own) > 1.5] for row in rows]
    laplace = sum((row.T @ row for row in kept), start=csr_array((own.size, own.size)))
    weight = np.where(fixed, 1.0, 0.0).ravel()
    system = laplace + diags_array(weight + np.where(own > 0, 1e-9, 1.0))
    solved = spsolve(csr_array(system).tocsc(), weight[:, None] * given.reshape(-1, 3))
    result = np.zeros_like(values)
    result[x, y] = np.where(inside[x, y][..., None], solved.reshape(given.shape), 0.0)
    return result


def dilated(cells: BoolArray, steps: int) -> BoolArray:
    """Return all cells (X, Y) within ``steps`` of the given cells."""
    return np.asarray(distance_transform_edt(~cells) <= steps) if cells.any() else cells
