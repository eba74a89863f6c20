"""Queries on points and triangle meshes without a simulator."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array

_PAIRS = 1_000_000  # point-triangle pairs per chunk


def points_inside(mesh: trimesh.Trimesh, points: Float64Array) -> BoolArray:
    """Return a mask of the points (N, 3) inside a mesh, by the generalised winding number (Jacobson et al. 2013).

    :class:`mitsplat.geometry.mesh_distance.DistanceSurface` is faster but needs Warp, whose start would delay preflight
    checks.
    """
    low, high = mesh.bounds
    inside = np.asarray(((points > low) & (points < high)).all(axis=1))
    if inside.any():  # usually, a camera is outside of the bounds of an object
        inside[inside] = np.abs(winding_numbers(mesh, points[inside])) > 0.5
    return inside


def winding_numbers(mesh: trimesh.Trimesh, points: Float64Array) -> Float64Array:
    """Return the generalised winding number of a mesh about points (N, 3), 1 inside a closed mesh; shape (N,).

    The solid angles of the triangles follow Van Oosterom and Strackee (1983).
    """
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    numbers = []
    for chunk in np.array_split(points, math.ceil(len(points) * len(triangles) / _PAIRS)):
        corners = triangles[None] - chunk[:, None, None]
        a, b, c = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
        la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
        volume = np.einsum("pti,pti->pt", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("pti,pti->pt", *sides) for sides in ((a, b), (b, c), (c, a)))
        angles = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
        numbers.append(angles.sum(axis=1) / (4 * np.pi))
    return np.concatenate(numbers)
