"""Normals at the corners of a mesh's faces, smooth except across creases."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse
import trimesh

from mitsplat.arrays import BoolArray, Float64Array, Int64Array, IntegerArray

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

_PARALLEL = 0.9
"""Minimum cosine between two edges of a facet that are opposite edges of a curved surface."""

_STATED = "corner_normals"
"""Face attribute with stated normals, shape (F, 9). Those of a corner are in the frame of its face: the first edge, the
in-plane axis and the face normal. Similarities of the mesh therefore do not change them.
"""

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
    wide would be too coarse. Facets of width w at an angle a are w a / 8 away from the arc through their edges. Facets
    of a coarse cylinder are known by the bends at their opposite edges.

    A mesh with stated normals (:func:`state_normals`) has those.

    Args:
        mesh: The mesh.
        crease_angle: Dihedral angle above which an edge is a crease [rad]. Above the default, which is for rough
            surfaces, large faces are smooth too.
    """
    if (stated := stated_normals(mesh)) is not None:
        return stated
    corner = np.repeat(np.arange(len(mesh.faces)), 3)
    facet = _facets(mesh)
    incidence = mesh.faces_sparse.astype(np.float64)
    pairs = (incidence.T @ incidence).tocoo()
    cosine = np.einsum("pd,pd->p", mesh.face_normals[pairs.row], mesh.face_normals[pairs.col])
    alike = cosine > np.cos(crease_angle)
    if crease_angle <= CREASE_ANGLE and len(mesh.faces):
        faces = np.column_stack([pairs.row, pairs.col])
        coarse = np.flatnonzero(alike & _is_coarse(mesh, faces, np.arccos(cosine.clip(-1, 1))))
        alike[coarse] = _bend_on(mesh, facet, facet[faces[coarse]], crease_angle)
    row, col = pairs.row[alike], pairs.col[alike]
    normals = np.zeros((len(mesh.faces), 3, 3))
    weights = _facet_weights(mesh, facet)
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


def state_normals(mesh: trimesh.Trimesh, normals: Float64Array) -> None:
    """Give a mesh, whose normals have not been used yet, unit ``normals`` (F, 3, 3) at the corners of its faces."""
    local = np.einsum("fad,fkd->fka", _face_frames(mesh), normals)
    mesh.face_attributes[_STATED] = local.reshape(-1, 9).astype(np.float32)


def stated_normals(mesh: trimesh.Trimesh) -> Float64Array | None:
    """Return the unit normals (F, 3, 3) that a mesh states at the corners of its faces, or None."""
    local = mesh.face_attributes.get(_STATED)
    if local is None:
        return None
    normals = np.einsum("fad,fka->fkd", _face_frames(mesh), np.asarray(local, dtype=np.float64).reshape(-1, 3, 3))
    return np.asarray(normals / np.linalg.norm(normals, axis=2, keepdims=True))


def ply_faces(mesh: trimesh.Trimesh) -> dict[str, Any]:
    """Return the face properties of the PLY file from which trimesh read a mesh, by their names."""
    face = mesh.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    if isinstance(face, dict):  # of text files
        return face
    columns = {name: face[name] for name in getattr(getattr(face, "dtype", None), "names", None) or ()}
    return {name: stored["f1"] if stored.dtype.names else stored for name, stored in columns.items()}


def read_stated_normals(mesh: trimesh.Trimesh) -> None:
    """Give a mesh the stated normals of the PLY file from which trimesh read it, if it has any.

    Raises:
        ValueError: If they are not finite vectors of length 1 for all corners.
    """
    stored = ply_faces(mesh).get(_STATED)
    if stored is None:
        return
    local = np.asarray(stored, dtype=np.float32)
    if local.shape != (len(mesh.faces), 9) or not np.allclose((local.reshape(-1, 3) ** 2).sum(axis=1), 1, atol=1e-2):
        raise ValueError(f"{_STATED} must be three vectors of length 1 for each face")
    mesh.face_attributes[_STATED] = local


def normal_matrix(matrix: Float64Array) -> Float64Array:
    """Return the matrices (..., 3, 3) that transform normals where ``matrix`` transforms points, up to a scale > 0.

    They are the cofactors with the sign of the determinant: the inverse transpose, which singular matrices lack.
    """
    a, b, c = np.moveaxis(matrix, -2, 0)
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
    mirrored = np.linalg.det(matrix)[..., None, None] < 0
    return np.asarray(np.where(mirrored, -cofactors, cofactors))


def _face_frames(mesh: trimesh.Trimesh) -> Float64Array:
    """Return the rows first edge, in-plane axis and normal of faces, shape (F, 3, 3)."""
    normal, edge = _flat_normals(mesh), mesh.triangles[:, 1] - mesh.triangles[:, 0]
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]  # for faces without a first edge
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    across = np.cross(normal, np.where(length > 0, edge / np.maximum(length, 1e-300), least))
    size = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(size > 1e-3, across / np.maximum(size, 1e-30), trimesh.unitize(np.cross(normal, least)))
    return np.stack([np.cross(across, normal), across, normal], axis=1)


def _facets(mesh: trimesh.Trimesh) -> Int64Array:
    """Return the number of the plane facet of each face, (F,)."""
    plane = mesh.face_adjacency[mesh.face_adjacency_angles < _PLANE]
    return np.asarray(trimesh.graph.connected_component_labels(plane, node_count=len(mesh.faces)), dtype=np.int64)


def _facet_weights(mesh: trimesh.Trimesh, facet: Int64Array) -> Float64Array:
    """Return weights (F, 3) of faces at their corners, whose sums over the faces of a plane facet are its area."""
    area = np.bincount(facet, mesh.area_faces)
    _, corner, count = np.unique(mesh.faces * len(area) + facet[:, None], return_inverse=True, return_counts=True)
    return np.asarray(area[facet][:, None] / count[corner].reshape(-1, 3))


def _is_coarse(mesh: trimesh.Trimesh, faces: IntegerArray, angle: Float64Array) -> BoolArray:
    """Return True for pairs of ``faces`` (P, 2) at an ``angle`` [rad] that are large for facets of a curved surface."""
    edges = mesh.triangles - np.roll(mesh.triangles, 1, axis=1)
    width = 2 * mesh.area_faces / np.maximum(np.linalg.norm(edges, axis=2).max(axis=1), 1e-300)
    return np.asarray(width[faces].min(axis=1) * angle / 8 > _MAX_SAGITTA * mesh.extents.max())


def _bend_on(mesh: trimesh.Trimesh, facet: Int64Array, pairs: Int64Array, crease_angle: float) -> BoolArray:
    """Return True for ``pairs`` (P, 2) of coarse facets that both bend to a third one at an edge parallel to theirs."""
    angles, sides = mesh.face_adjacency_angles, mesh.face_adjacency
    bend = (angles < crease_angle) & _is_coarse(mesh, sides, angles)
    sides, ends = facet[sides[bend]], mesh.vertices[mesh.face_adjacency_edges[bend]]
    along = np.tile(trimesh.unitize(ends[:, 1] - ends[:, 0]), (2, 1))
    own, other = sides.T.ravel(), sides[:, ::-1].T.ravel()
    count, size = len(own), int(facet.max()) + 1
    at = scipy.sparse.csr_array((np.ones(count), (np.arange(count), own)), (count, size))
    near = (at @ at.T).tocoo()
    parallel = np.abs(np.einsum("pd,pd->p", along[near.row], along[near.col])) > _PARALLEL
    continued = np.zeros(count, dtype=bool)
    continued[near.row[parallel & (other[near.row] != other[near.col])]] = True
    both = continued & np.roll(continued, count // 2)
    return np.isin(pairs @ (size, 1), np.column_stack([own, other])[both] @ (size, 1))


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
