"""Queries on points and triangle meshes without a simulator."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array

_PAIRS = 1_000_000  # point-triangle pairs per chunk


def points_inside(mesh: trimesh.Trimesh, points: Float64Array) -> BoolArray:
    """Return a mask of the points (N, 3) inside a mesh, by the generalised winding number (Jacobson et al. 2013).

    The solid angles of the triangles follow Van Oosterom and Strackee (1983).
    :class:`mitsplat.geometry.mesh_distance.DistanceSurface` is faster but needs Warp, whose start would delay preflight
    checks.
    """
    low, high = mesh.bounds
    inside = ((points > low) & (points < high)).all(axis=1)
    nearby = np.flatnonzero(inside)
    if not len(nearby):  # the usual case of a camera and an object
        return np.asarray(inside)
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    for chunk in np.array_split(nearby, math.ceil(len(nearby) * len(triangles) / _PAIRS)):
        corners = triangles[None] - points[chunk][:, None, None]
        a, b, c = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
        la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
        volume = np.einsum("pti,pti->pt", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("pti,pti->pt", *sides) for sides in ((a, b), (b, c), (c, a)))
        angles = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
        inside[chunk] = np.abs(angles.sum(axis=1)) > 2 * np.pi
    return np.asarray(inside)
