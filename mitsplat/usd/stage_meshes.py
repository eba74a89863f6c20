"""Triangles of the geometric prims of a USD stage."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.mesh_files.face_polygons import split_polygons

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

Triangles = tuple[Float64Array, Int64Array]
"""Vertices (N, 3) and triangles (F, 3)."""

_ROUND_SEGMENTS = 64


def triangles_of(prim: Usd.Prim, time: Usd.TimeCode) -> Triangles | None:
    """Return vertices and triangles of a prim in its own coordinates; None for an unsupported type."""
    import trimesh  # the child alone needs it
    from pxr import UsdGeom  # optional

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get(time)

    solids = trimesh.creation
    if prim.IsA(UsdGeom.Mesh):
        return _mesh_triangles(UsdGeom.Mesh(prim), time)
    if prim.IsA(UsdGeom.Cube):
        mesh = solids.box([value("size")] * 3)
    elif prim.IsA(UsdGeom.Sphere):
        mesh = solids.icosphere(3, value("radius"))
    elif prim.IsA(UsdGeom.Cylinder) or prim.IsA(UsdGeom.Capsule) or prim.IsA(UsdGeom.Cone):
        height, radius = value("height"), value("radius")
        if prim.IsA(UsdGeom.Cylinder):
            mesh = solids.cylinder(radius, height, sections=_ROUND_SEGMENTS)
        elif prim.IsA(UsdGeom.Capsule):
            mesh = solids.capsule(height, radius)
        else:
            mesh = solids.cone(radius, height, sections=_ROUND_SEGMENTS)
        mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
        mesh.vertices = np.roll(mesh.vertices, {"X": 1, "Y": 2, "Z": 0}[value("axis")], axis=1)
    else:
        return None
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _mesh_triangles(mesh: UsdGeom.Mesh, time: Usd.TimeCode) -> Triangles | None:
    """Return vertices and triangles of a polygon mesh."""
    points, counts, corners = (
        np.array(attribute.Get(time) if attribute.Get(time) is not None else ())
        for attribute in (mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
    )
    path = mesh.GetPrim().GetPath()
    if not len(counts):
        return None
    if counts.min() < 3 or counts.sum() != len(corners):
        raise InputError(
            f"{path}: faceVertexCounts must be at least 3 and have the sum {len(corners)}, the number of "
            f"faceVertexIndices (got a least count of {counts.min()} and the sum {counts.sum()})"
        )
    if corners.min() < 0 or corners.max() >= len(points):
        raise InputError(
            f"{path}: faceVertexIndices must be 0 to {len(points) - 1} (got {corners.min()} to {corners.max()})"
        )
    points = points.astype(np.float64)
    if (counts == 3).all():
        faces = corners.reshape(-1, 3)
    else:
        polygons = np.split(corners, np.cumsum(counts)[:-1])
        triangles = split_polygons(points, polygons)
        faces = np.concatenate([one[rows] for one, rows in zip(polygons, triangles, strict=True)])
    if mesh.GetOrientationAttr().Get() == "leftHanded":
        faces = faces[:, ::-1]
    return points, np.ascontiguousarray(faces, dtype=np.int64)
