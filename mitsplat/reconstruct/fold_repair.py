"""Limits on vertex motion that prevent folded faces and self-intersections."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.renderer.rays.device_arrays import plain_mesh
from mitsplat.runtime.variant import ensure_variant

_MIN_AREA_RATIO = 1e-3
"""Least signed area of a moved face, projected onto its original plane, as a share of its original area."""
_MAX_ROUNDS = 12
"""Largest number of times that the motion of invalid vertices is halved."""


def limit_motion(mesh: trimesh.Trimesh, vertices: Float64Array) -> Float64Array | None:
    """Return moved vertices whose motion is reduced where faces fold or vanish, or edges newly pass through faces.

    Args:
        mesh: Mesh with the original vertices.
        vertices: Target positions, (V, 3).

    Returns:
        Valid positions, (V, 3), or None if none were found.
    """
    share = np.ones((len(vertices), 1))
    across = trimesh.triangles.cross(mesh.triangles)
    area = (across**2).sum(axis=1)
    crossed = edges_through_faces(mesh, mesh.vertices)
    for _ in range(_MAX_ROUNDS):
        found: Float64Array = mesh.vertices + share * (vertices - mesh.vertices)
        broken = ~((trimesh.triangles.cross(found[mesh.faces]) * across).sum(axis=1) >= _MIN_AREA_RATIO * area)
        crossing = np.setdiff1d(edges_through_faces(mesh, found), crossed)
        wrong = np.union1d(mesh.faces[broken], mesh.edges_unique[crossing])
        if not len(wrong):
            return found
        share[wrong] /= 2
    return None


def edges_through_faces(mesh: trimesh.Trimesh, vertices: Float64Array) -> npt.NDArray[np.intp]:
    """Return rows of ``edges_unique`` that pass through a face they do not share a vertex with, for vertices (V, 3).

    Each edge is traced as a ray; only its first hit is tested.
    """
    ensure_variant()
    edges, faces = mesh.edges_unique, np.asarray(mesh.faces)
    scene = mi.load_dict({"type": "scene", "mesh": plain_mesh(trimesh.Trimesh(vertices, faces, process=False))})
    start, end = (np.asarray(vertices, dtype=np.float32)[column].T for column in edges.T)
    origin, along = (np.ascontiguousarray(v) for v in (start + 1e-3 * (end - start), 0.998 * (end - start)))
    hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(along), 1.0, 0.0, []))
    met = np.flatnonzero(np.array(hit.is_valid()))
    corners = faces[np.array(hit.prim_index)[met]]
    return np.asarray(met[~(corners[:, :, None] == edges[met][:, None, :]).any(axis=(1, 2))])
