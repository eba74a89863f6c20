"""Normals at the corners of a mesh's faces, smooth except across creases."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh

from mitsplat.arrays import Float64Array

CREASE_ANGLE = np.radians(28.0)
"""Dihedral angle above which an edge is a crease [rad]. Gaussians must not cross creases; normals are not smoothed
there.
"""
_MAX_SAGITTA = 1 / 200
"""Distance between two facets and a curved surface that both approximate, relative to the longest extent of the mesh,
above which the facets are plane faces: ten times the default tolerance of the facets of STEP files.
"""

_PLANE = 1e-3
"""Maximum angle between the faces of a plane facet [rad]."""

NOISE_CREASE = 10.0
"""Dihedral angle of a crease over the lower quartile of a mesh's dihedral angles. The quartile is zero for CAD meshes,
whose flat faces have interior edges, and 2 to 8 degrees for reconstructed smooth surfaces.
"""

SHARPEST = np.radians(80.0)
"""Dihedral angle that is a crease in every mesh [rad]."""


def corner_normals(mesh: trimesh.Trimesh, *, crease_angle: float = CREASE_ANGLE) -> Float64Array:
    """Return unit normals (F, 3, 3) at the corners of faces, smooth except across creases.

    Normals are weighted by the areas of plane facets. Large plane faces therefore keep their own normal, and the result
    does not depend on the diagonals that divide a facet into triangles.

    Two large faces at a small angle, such as a roof and a wide chamfer, are plane: a curved surface with facets that
    wide would be too coarse. Facets of width w at an angle a are w a / 8 away from the arc through their edges.

    Args:
        mesh: The mesh.
        crease_angle: Dihedral angle above which an edge is a crease [rad]. Above the default, which is for rough
            surfaces, large faces are smooth too.
    """
    corner = np.repeat(np.arange(len(mesh.faces)), 3)
    incidence = mesh.faces_sparse.astype(np.float64)
    pairs = (incidence.T @ incidence).tocoo()
    cosine = np.einsum("pd,pd->p", mesh.face_normals[pairs.row], mesh.face_normals[pairs.col])
    alike = cosine > np.cos(crease_angle)
    if crease_angle <= CREASE_ANGLE and len(mesh.faces):
        width, angle = _widths(mesh), np.arccos(cosine.clip(-1, 1))
        sagitta = np.minimum(width[pairs.row], width[pairs.col]) * angle / 8
        alike &= sagitta <= _MAX_SAGITTA * mesh.extents.max()
    row, col = pairs.row[alike], pairs.col[alike]
    normals = np.zeros((len(mesh.faces), 3, 3))
    weights = _facet_weights(mesh)
    for k in range(3):
        shared = mesh.faces[col] == mesh.faces[row, k][:, None]
        share = np.einsum("pk,pk->p", shared, weights[col])
        np.add.at(normals[:, k], row, share[:, None] * mesh.face_normals[col])
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    flat = _flat_normals(mesh)[corner].reshape(-1, 3, 3)
    return np.asarray(np.where(length > 0, normals / np.maximum(length, 1e-30), flat))


@lru_cache(maxsize=64)
def smooth_normals(mesh: trimesh.Trimesh) -> Float64Array:
    """Return unit normals (F, 3, 3) at the corners of faces, smooth except across creases of this mesh; cached.

    Reconstructed surfaces are rough everywhere, so that an angle that is a crease in a CAD mesh is noise in them. An
    edge is therefore a crease only if it is much sharper than the flattest quarter of all edges, by length.
    """
    angles, ends = mesh.face_adjacency_angles, mesh.vertices[mesh.face_adjacency_edges]
    order = np.argsort(angles)
    lengths = np.cumsum(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[order])
    usual = angles[order[np.searchsorted(lengths, 0.25 * lengths[-1])]] if len(order) else 0.0
    return corner_normals(mesh, crease_angle=float(np.clip(NOISE_CREASE * usual, CREASE_ANGLE, SHARPEST)))


def _facet_weights(mesh: trimesh.Trimesh) -> Float64Array:
    """Return weights (F, 3) of faces at their corners, whose sums over the faces of a plane facet are its area."""
    plane = mesh.face_adjacency[mesh.face_adjacency_angles < _PLANE]
    facet = trimesh.graph.connected_component_labels(plane, node_count=len(mesh.faces))
    area = np.bincount(facet, mesh.area_faces)
    _, corner, count = np.unique(mesh.faces * len(area) + facet[:, None], return_inverse=True, return_counts=True)
    return np.asarray(area[facet][:, None] / count[corner].reshape(-1, 3))


def _widths(mesh: trimesh.Trimesh) -> Float64Array:
    """Return the smallest heights (F,) of faces."""
    edges = mesh.triangles - np.roll(mesh.triangles, 1, axis=1)
    return np.asarray(2 * mesh.area_faces / np.maximum(np.linalg.norm(edges, axis=2).max(axis=1), 1e-300))


def _flat_normals(mesh: trimesh.Trimesh) -> Float64Array:
    """Return unit normals (F, 3) of faces, including slivers.

    trimesh returns zero normals for slivers, whose reflections would be NaN.
    """
    normals = np.array(mesh.face_normals, dtype=np.float64)
    none = ~normals.any(axis=1)
    if none.any():
        corners = mesh.triangles[none]
        # The edges are scaled first, so that the product of two tiny edges does not underflow.
        edges = (corners[:, 1:] - corners[:, :1]) / np.maximum(np.ptp(corners, axis=(1, 2), keepdims=True), 1e-300)
        across = np.cross(edges[:, 0], edges[:, 1])
        length = np.linalg.norm(across, axis=1, keepdims=True)
        normals[none] = np.where(length > 0, across / np.maximum(length, 1e-300), (0.0, 0.0, 1.0))
    return normals
