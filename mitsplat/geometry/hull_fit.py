"""Convex pieces with the convex hull of their mesh, so that the mesh itself touches a table at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.geometry.mesh_distance import DistanceSurface

HULL_TOLERANCE = 5e-5
"""Default of the largest deviation of the hulls [m]."""
_SAME_DISTANCE = 1e-6
"""Difference of distances below which pieces are equally near to a vertex [m]."""


def fit_to_hull(
    pieces: Sequence[trimesh.Trimesh],
    mesh: trimesh.Trimesh,
    *,
    reach: float = np.inf,
    tolerance: float = HULL_TOLERANCE,
) -> tuple[trimesh.Trimesh, ...]:
    """Return convex pieces whose joint convex hull is that of a mesh, within a tolerance.

    Bodies of equal convex hulls rest equally on a plane. Vertices of pieces outside of the hull of the mesh move to its
    nearest point. Vertices of that hull outside of the joint hull of the pieces are added to the nearest piece, until
    none is farther outside than the tolerance. If several pieces are equally near, because they meet there, each of
    them gets the vertex. Otherwise, one of them would have a skewed facet. A piece grows by no more than the distance
    of its new vertices. Pieces that need no change are returned as they are.

    Args:
        pieces: Convex pieces of the mesh [m].
        mesh: Surface of the object [m].
        reach: Maximum distance of a vertex from the piece to which it is added [m]. Debris of a scan is farther away.
        tolerance: Largest deviation of the hulls that remains [m].
    """
    hull = mesh.convex_hull
    fitted = _move_inside([np.asarray(piece.vertices, dtype=np.float64) for piece in pieces], hull, tolerance)
    joint = ConvexHull(np.concatenate(fitted), incremental=True)
    corners = np.asarray(hull.vertices, dtype=np.float64)
    corners = corners[_outside_distances(joint, corners) > tolerance]
    if len(corners):
        distances = np.stack([DistanceSurface(piece).nearest(corners)[2] for piece in pieces])
        near = distances.min(axis=0) <= reach
        corners, distances = corners[near], distances[:, near]
        nearest = distances <= distances.min(axis=0) + _SAME_DISTANCE
        added = _add_farthest_first(joint, corners, tolerance)
        fitted = [np.concatenate([own, corners[added[nearest[i, added]]]]) for i, own in enumerate(fitted)]
    joint.close()
    return tuple(
        piece if np.array_equal(new, piece.vertices) else trimesh.convex.convex_hull(new)
        for piece, new in zip(pieces, fitted, strict=True)
    )


def _move_inside(points: Sequence[Float64Array], hull: trimesh.Trimesh, tolerance: float) -> list[Float64Array]:
    """Move points (N, 3) of several sets to the surface of a hull if they are farther outside than a tolerance."""
    outline, surface = ConvexHull(hull.vertices), DistanceSurface(hull)
    moved = []
    for own in points:
        outside = _outside_distances(outline, own) > tolerance
        inside = own.copy()
        if outside.any():
            inside[outside] = surface.nearest(own[outside])[0]
        moved.append(inside)
    return moved


def _outside_distances(hull: ConvexHull, points: Float64Array) -> Float64Array:
    """Return the largest distance of each point (N, 3) above a face of a hull [m], shape (N,); negative inside."""
    # Without the threads of BLAS, which cost more than these products.
    heights = np.einsum("nd,fd->nf", points, hull.equations[:, :3]) + hull.equations[:, 3]
    return np.asarray(heights.max(axis=1, initial=-np.inf))


def _add_farthest_first(hull: ConvexHull, points: Float64Array, tolerance: float) -> Int64Array:
    """Add points (N, 3) to a hull until none is farther outside than a tolerance, and return their numbers."""
    added: list[int] = []
    while len(points) and (heights := _outside_distances(hull, points)).max() > tolerance:
        # Points come closer when the hull grows, so that only the distance of the farthest one is computed again.
        while heights.max() > tolerance:
            farthest = int(heights.argmax())
            heights[farthest] = _outside_distances(hull, points[farthest : farthest + 1])[0]
            if heights[farthest] > tolerance and heights.argmax() == farthest:
                hull.add_points(points[farthest : farthest + 1])
                heights[farthest] = -np.inf
                added.append(farthest)
    return np.array(added, dtype=np.int64)
