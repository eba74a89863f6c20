"""Groups of points that are close together."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from mitsplat.arrays import FloatingArray, Int32Array


def cluster_points(points: FloatingArray, gap: float) -> Int32Array:
    """Return the index of the group of each point (N, 3). Points whose distance is at most ``gap`` are in one group."""
    pairs = KDTree(points).query_pairs(gap, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(points), len(points)))
    return np.asarray(connected_components(graph, directed=False)[1])


def gap_between(points: FloatingArray, low: float, high: float) -> float:
    """Return the gap that separates groups of points (N, 3): four times their spacing, within bounds.

    The spacing is the median distance to the fifth nearest other point.
    """
    return float(np.clip(4 * np.median(KDTree(points).query(points, k=6)[0][:, -1]), low, high))
