"""Points and triangle meshes, without a simulator: what is inside, what is near, what a surface is made of."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array

_PAIRS = 1_000_000  # of a point and a triangle that are looked at together


def points_inside(mesh: trimesh.Trimesh, points: Float64Array) -> BoolArray:
    """Which of some points (N, 3) are inside a mesh: around which it winds, as often as not (Jacobson et al. 2013).

    The solid angles of its triangles are those of Van Oosterom and Strackee (1983).
    :class:`mitsplat.geometry.mesh_distance.DistanceSurface` finds the same faster, once physics has been started, for
    which no check should wait.
    """
    low, high = mesh.bounds
    inside = ((points > low) & (points < high)).all(axis=1)
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    nearby = np.flatnonzero(inside)
    for chunk in np.array_split(nearby, math.ceil(len(nearby) * len(triangles) / _PAIRS) or 1):
        corners = triangles[None] - points[chunk][:, None, None]
        a, b, c = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
        la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
        volume = np.einsum("pti,pti->pt", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("pti,pti->pt", *sides) for sides in ((a, b), (b, c), (c, a)))
        angles = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
        inside[chunk] = np.abs(angles.sum(axis=1)) > 2 * np.pi
    return np.asarray(inside)
