"""Search for surfaces of two meshes that lie in one plane and overlap."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import cKDTree

from mitsplat.arrays import Float64Array

DISTANCE = 1e-5
"""Maximum distance between coincident planes [m]. Rays do not separate nearer surfaces at a metre from the camera."""

_ANGLE = 1e-4
"""Maximum difference of their unit normals."""
_CELLS = 128
"""Cells along each side of the raster in which the overlap is searched."""
_MIN_EXTENT = 1e-3
"""Minimum extent of an overlap [m]."""


def coplanar_place(
    one: trimesh.Trimesh, other: trimesh.Trimesh, eyes: npt.ArrayLike, *, one_sided: bool = False
) -> Float64Array | None:
    """Return a point [m] at which a face of each of two meshes lies in the same plane and faces the same side, or None.

    Planes that face none of the viewpoints ``eyes`` (N, 3) [m] are ignored. Open meshes show both sides, unless
    ``one_sided`` is set.
    """
    low = np.maximum(one.bounds[0], other.bounds[0]) - DISTANCE
    high = np.minimum(one.bounds[1], other.bounds[1]) + DISTANCE
    if (low > high).any():
        return None
    middle = (low + high) / 2
    triangles, planes = zip(*(_planes(mesh, low, high, middle, one_sided) for mesh in (one, other)), strict=True)
    if not all(map(len, planes)):
        return None
    tolerance = np.array([_ANGLE, _ANGLE, _ANGLE, DISTANCE])
    scaled = [found / tolerance for found in planes]
    distances, _ = cKDTree(scaled[1]).query(scaled[0], p=np.inf, distance_upper_bound=1.0)
    shared = np.unique(planes[0][np.isfinite(distances)].round(6), axis=0)
    for plane in shared:
        normal, offset = plane[:3], plane[3]
        if not ((np.asarray(eyes, dtype=np.float64) - middle) @ normal > offset + DISTANCE).any():
            continue
        near = [np.abs(found - plane / tolerance).max(axis=1) < 1.1 for found in scaled]  # planes are rounded
        place = _overlap(triangles[0][near[0]], triangles[1][near[1]], normal)
        if place is not None:
            return np.asarray(middle + place, dtype=np.float64)
    return None


def _planes(
    mesh: trimesh.Trimesh, low: Float64Array, high: Float64Array, middle: Float64Array, one_sided: bool
) -> tuple[Float64Array, Float64Array]:
    """Return the triangles of a mesh that reach a box, (T, 3, 3) relative to ``middle``, and their planes (T, 4)."""
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    reaches = ((triangles.min(axis=1) <= high) & (triangles.max(axis=1) >= low)).all(axis=1)
    triangles = triangles[reaches] - middle
    normals = trimesh.triangles.cross(triangles)
    lengths = np.linalg.norm(normals, axis=1)
    triangles, normals = triangles[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
    planes = np.column_stack([normals, (normals * triangles[:, 0]).sum(axis=1)])
    if one_sided or mesh.is_watertight:
        return triangles, planes
    return np.concatenate([triangles, triangles]), np.concatenate([planes, -planes])  # open meshes show both sides


def _overlap(one: Float64Array, other: Float64Array, normal: Float64Array) -> Float64Array | None:
    """Return a point at which coplanar triangles (T, 3, 3) of two sets overlap, or None.

    Sets that only touch share a line of cells, which erosion removes.
    """
    across = np.linalg.svd(normal[None])[2][1:]
    flat = [triangles @ across.T for triangles in (one, other)]
    low = np.max([points.min(axis=(0, 1)) for points in flat], axis=0)
    high = np.min([points.max(axis=(0, 1)) for points in flat], axis=0)
    if (high - low < _MIN_EXTENT).any():
        return None
    cell = (high - low) / _CELLS
    covered = np.ones((_CELLS, _CELLS), dtype=np.uint8)
    for points in flat:
        canvas = np.zeros_like(covered)
        for triangle in ((points - low) / cell * 16).clip(-(2**20), 2**20).astype(np.int32):
            cv2.fillConvexPoly(canvas, triangle, 1, shift=4)
        covered &= canvas
    shared = np.argwhere(cv2.erode(covered, np.ones((3, 3), np.uint8), borderValue=0))[:, ::-1]
    if not len(shared):
        return None
    middle = shared[np.linalg.norm(shared - shared.mean(axis=0), axis=1).argmin()]
    place = low + (middle + 0.5) * cell
    return np.asarray(place @ across + normal * (normal @ one[0, 0]), dtype=np.float64)
