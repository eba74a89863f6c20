"""Poisson-disk subsets of points on surfaces, whose points have minimum distances that may vary."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.runtime.cores import usable_cores

PACKING = 0.62
"""Points per area r^2 in the sets of :func:`poisson_subset`, measured on a plane (0.70 at saturation)."""
_NORMAL_WEIGHT = 0.6
"""Additional distance of points with opposite normals, in units of r. It separates the two sides of thin sheets."""
_ROW_SPACING = 0.75
"""Distance of the points that are selected first, in units of their radius."""


def poisson_subset(
    points: Float64Array,
    normals: Float64Array,
    radius: Float64Array,
    rng: np.random.Generator,
    first: Int64Array | None = None,
) -> Int64Array:
    """Return indices of a Poisson-disk subset of ``points`` (N, 3), at least their ``radius`` (N,) apart.

    This is the parallel form of dart throwing (maximal independent set by random priorities, Luby 1986), from small
    radii to large ones. Opposite ``normals`` (N, 3) count as distance. Points ``first`` (M,) are selected before all
    others and may be slightly closer together.
    """
    if first is not None and len(first):
        seeds = first[poisson_subset(points[first], normals[first], _ROW_SPACING * radius[first], rng)]
        chosen = np.zeros(len(points), dtype=bool)
        chosen[seeds] = True
        rest = np.flatnonzero(~chosen)
        gap, nearest = query_neighbours(KDTree(points[seeds]), points[rest], distance_upper_bound=float(radius.max()))
        nearest = seeds[np.minimum(nearest, len(seeds) - 1)]
        facing = np.einsum("nd,nd->n", normals[rest], normals[nearest]) > 0.7
        rest = rest[(gap > 0.8 * np.minimum(radius[rest], radius[nearest])) | ~facing]
        return np.sort(np.concatenate([seeds, rest[poisson_subset(points[rest], normals[rest], radius[rest], rng)]]))
    level = np.ceil(2.0 * np.log2(radius / radius.min()) - 1e-9).astype(int)
    kept: list[Int64Array] = []
    for current in np.unique(level):
        index = np.flatnonzero(level == current)
        reach = float(radius[index].max())
        lifted = np.concatenate([points, _NORMAL_WEIGHT * reach * normals], axis=1)
        if kept:
            finer = KDTree(lifted[np.concatenate(kept)])
            gap, _ = query_neighbours(finer, lifted[index], distance_upper_bound=0.85 * reach)
            index = index[np.isinf(gap)]
        pairs = KDTree(lifted[index]).query_pairs(reach, output_type="ndarray")
        kept.append(index[_independent_set(len(index), pairs, rng)])
    return np.sort(np.concatenate(kept))


def _independent_set(count: int, pairs: Int64Array, rng: np.random.Generator) -> BoolArray:
    """Return a maximal independent set of a graph with ``count`` nodes and edges ``pairs`` (P, 2), as a mask."""
    priority = rng.permutation(count)
    alive, chosen = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    while alive.any():
        dominated = np.zeros(count, dtype=bool)
        dominated[np.where(priority[pairs[:, 0]] > priority[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
        winners = alive & ~dominated
        chosen |= winners
        alive &= ~winners
        alive[pairs[winners[pairs[:, 0]], 1]] = False
        alive[pairs[winners[pairs[:, 1]], 0]] = False
        pairs = pairs[alive[pairs].all(axis=1)]
    return chosen


def query_neighbours(tree: KDTree, points: npt.ArrayLike, **options: Any) -> tuple[Float64Array, Int64Array]:
    """Return distances and indices of nearest neighbours.

    All cores of the process are used; the result does not depend on their number.
    """
    found: tuple[Float64Array, Int64Array] = tree.query(points, workers=usable_cores(), **options)
    return found
