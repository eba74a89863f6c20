"""Support surface of a photographed place: the smooth, possibly uneven surface below the objects, such as cloth.

The surface is a height over a grid, fitted from below, as ground filters do for laser scans (review: Zhang et al.
2016). The weight of points above it falls with their height; points on it or below have full weight. Where an object
occludes the surface, it continues with minimal bending (thin plate). The first iterations allow little more than a
plane; stiffness and tolerance decrease with each iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import spsolve

from mitsplat.arrays import Float64Array

CELLS = 32
"""Cells of the grid along an edge."""
_ROUNDS = 12
_STIFFNESS = (1e3, 3e-2)
"""Weight of bending relative to the mean weight of points in a cell, in the first and the last iteration."""
_TOLERANCE = (0.08, 0.01)
"""Height tolerance of points on the surface in the first and the last iteration, as a fraction of the radius."""
_OUTLIER_DEPTH = 4.0
"""Depth below the surface beyond which a point is an outlier, in tolerances."""


@dataclass(frozen=True, eq=False)
class SupportSurface:
    """Surface z = h(x, y) over a square.

    Attributes:
        low: Minimum x and y of the grid, shape (2,).
        cell: Edge of a cell.
        heights: Heights at the nodes of the grid, shape (N, N), first axis x.
        roughness: Standard deviation of points on the surface from it.
    """

    low: Float64Array
    cell: float
    heights: Float64Array
    roughness: float

    def under(self, points: Float64Array) -> Float64Array:
        """Return the height z of the surface at the x and y of points (N, 3), shape (N,).

        Outside the grid, the height at its border is returned.
        """
        return np.asarray(_interpolation(points, self.low, self.cell, len(self.heights)) @ self.heights.ravel())


def find_support(points: Float64Array, middle: Float64Array, radius: float) -> SupportSurface:
    """Fit the support surface within ``radius`` of ``middle``; z is up.

    Args:
        points: Points on all surfaces, shape (N, 3).
        middle: Point at which the cameras are directed, shape (3,).
        radius: Half the edge of the square.
    """
    near = (np.abs(points[:, :2] - middle[:2]) < radius).all(axis=1) & (np.abs(points[:, 2] - middle[2]) < radius)
    points = points[near]
    low, cell = middle[:2] - radius, 2 * radius / CELLS
    nodes = CELLS + 1
    sample = _interpolation(points, low, cell, nodes)
    bending = _bending(nodes)
    share = len(points) / nodes**2
    heights = np.full(nodes**2, float(np.quantile(points[:, 2], 0.1)) if len(points) else 0.0)
    gap = points[:, 2] - sample @ heights
    for turn in np.linspace(0, 1, _ROUNDS):
        stiff = share * _STIFFNESS[0] ** (1 - turn) * _STIFFNESS[1] ** turn
        tolerance = radius * _TOLERANCE[0] ** (1 - turn) * _TOLERANCE[1] ** turn
        counts = np.where(gap > 0, 1 / (1 + (gap / tolerance) ** 2) ** 2, gap > -_OUTLIER_DEPTH * tolerance)
        normal = sample.T @ diags_array(counts) @ sample + stiff * bending + 1e-9 * share * eye_array(nodes**2)
        heights = spsolve(csr_array(normal).tocsc(), sample.T @ (counts * points[:, 2]))
        gap = points[:, 2] - sample @ heights
    inside = np.abs(gap) < tolerance
    roughness = float(np.sqrt((gap[inside] ** 2).mean())) if inside.any() else tolerance
    return SupportSurface(low, cell, heights.reshape(nodes, nodes), roughness)


def _interpolation(points: Float64Array, low: Float64Array, cell: float, nodes: int) -> csr_array:
    """Return the bilinear weights (N, nodes^2) of the grid nodes at points (N, 3 or more)."""
    place = ((points[:, :2] - low) / cell).clip(0, nodes - 1 - 1e-9)
    corner = np.floor(place).astype(np.int64)
    x, y = (place - corner).T
    rows = np.arange(len(points))
    parts = [(corner[:, 0] + i) * nodes + corner[:, 1] + j for i in (0, 1) for j in (0, 1)]
    values = [(x if i else 1 - x) * (y if j else 1 - y) for i in (0, 1) for j in (0, 1)]
    where = np.tile(rows, 4), np.concatenate(parts)
    return csr_array(coo_array((np.concatenate(values), where), shape=(len(points), nodes**2)))


def _bending(nodes: int) -> csr_array:
    """Return the quadratic form of the thin-plate bending energy on a grid of nodes x nodes."""
    one = eye_array(nodes)
    second = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(nodes - 2, nodes))
    first = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(nodes - 1, nodes))
    forms = vstack([kron(second, one), kron(one, second), np.sqrt(2) * kron(first, first)])
    return csr_array(forms.T @ forms)
