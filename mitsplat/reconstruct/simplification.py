"""Simplification of closed surfaces, which stay closed, and removal of their small parts."""

from __future__ import annotations

import numpy as np
import trimesh

from mitsplat.geometry.solids import join_meshes, solid_manifold

_SEPARATION = 0.02
"""Share of the way to its neighbours by which a vertex is moved away from a coincident one."""
_SEPARATION_ROUNDS = 8
"""Largest number of repetitions; a moved vertex can coincide with another one."""


def simplify_surface(surface: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """Simplify to at most ``faces`` faces by quadric error (Garland and Heckbert 1997).

    A watertight mesh stays watertight.

    If edge collapses pinch a closed surface, a manifold-preserving simplification replaces them. Its tolerance grows
    until the faces are few enough, or until a tenth of the size of the mesh. Coincident vertices of a closed surface
    are moved apart, so that it stays closed after vertices are welded.
    """
    if len(surface.faces) <= faces:
        return surface
    simple = surface.simplify_quadric_decimation(face_count=faces)
    if not surface.is_watertight:
        return simple
    if not simple.is_volume:
        solid = solid_manifold(surface)
        tolerance = 1e-4 * surface.scale
        while solid.num_tri() > faces and tolerance < 0.1 * surface.scale:
            solid = solid.simplify(tolerance)
            tolerance *= 1.1
        mesh = solid.to_mesh()
        simple = trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False)
    return separate_vertices(simple)


def separate_vertices(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a closed surface whose vertices differ in single precision, the precision of mesh files.

    Coincident vertices belong to sheets that touch; each moves slightly towards its own neighbours.
    """
    vertices = np.array(surface.vertices)
    one, other = surface.edges.T
    counts = np.bincount(one, minlength=len(vertices))
    for _ in range(_SEPARATION_ROUNDS):
        _, place, shared = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True, return_counts=True)
        touching = shared[place] > 1
        if not touching.any():
            break
        # A closed surface lists each edge once in either direction.
        sums = np.column_stack([np.bincount(one, vertices[other, k], len(vertices)) for k in range(3)])
        middle = sums[touching] / counts[touching, None]
        vertices[touching] += _SEPARATION * (middle - vertices[touching])
    return trimesh.Trimesh(vertices, surface.faces, process=False)


def large_shells(surface: trimesh.Trimesh, least: float) -> trimesh.Trimesh:
    """Return the closed parts with at least a share of the largest volume, without small parts and inner cavities."""
    parts = surface.split(only_watertight=True)
    largest = max((float(part.volume) for part in parts), default=0.0)
    kept = [part for part in parts if part.volume >= least * largest > 0]
    if not kept:
        return surface
    return kept[0] if len(kept) == 1 else join_meshes(kept)
