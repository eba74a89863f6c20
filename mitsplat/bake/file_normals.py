"""Normals that mesh files state at the corners of faces, for the parts of a mesh and for its proxy mesh."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.mesh_distance import nearest_faces
from mitsplat.geometry.mesh_normals import (
    corner_normals,
    normal_matrix,
    smooth_normals,
    state_normals,
    stated_normals,
)

_SLIVER = 1e-3
"""Height of a face, relative to its longest edge, below which its own normal is not compared with stated ones."""
_GRAZING = 0.01
"""Minimum cosine between a stated normal and its face."""
_FAR = np.cos(np.radians(40.0))
"""Cosine between a stated normal and its face below which it rounds an edge that is sharp in most parts."""
_MAX_ROUNDED = 0.2
"""Share of the area with such normals above which a warning names them."""
_INSET = 2e-3
"""Distance of sampled points from the corners of a proxy's faces, as a share of the way to the centre of the face."""
_ALIKE = 0.5
"""Minimum cosine between a face of a proxy and the face of the mesh that gives it normals."""
_LIFT = 1e-5
"""Distance by which faces are raised to tell the two faces of a sheet at one place apart, relative to the size."""
_EQUAL = np.cos(np.radians(1.0))
"""Cosine between stated and computed normals above which a proxy states none."""


class NormalCount(NamedTuple):
    """Normals that a file states at face corners of a part.

    Attributes:
        stated: Their number.
        unusable: Number of those that cannot be used.
        area: Area of their faces [m^2].
        rounded: Area of the faces with a normal far from that of the face [m^2].
    """

    stated: int = 0
    unusable: int = 0
    area: float = 0.0
    rounded: float = 0.0


def place_normals(mesh: trimesh.Trimesh, given: Float64Array, linear: Float64Array) -> NormalCount:
    """Give a mesh the normals of its file, which the mesh must not have used yet.

    Normals must be finite, not zero, and on the front of their face. Others are computed from the faces.

    Args:
        mesh: The mesh in its place.
        given: Normals of any length at the corners of its faces, shape (F, 3, 3).
        linear: Linear part (3, 3) of the transform that placed the mesh, for the normals.
    """
    given = np.where(np.isfinite(given).all(axis=2, keepdims=True), given, 0.0)
    largest = np.abs(given).max(axis=2, keepdims=True)
    matrix = normal_matrix(linear / max(float(np.abs(linear).max()), 1e-300))
    normals = given / np.where(largest > 0, largest, 1.0) @ matrix.T
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals /= np.maximum(length, 1e-30)
    edges = np.linalg.norm(mesh.triangles - np.roll(mesh.triangles, 1, axis=1), axis=2).max(axis=1)
    sliver = 2 * mesh.area_faces < _SLIVER * edges**2
    cosine = np.einsum("fkd,fd->fk", normals, mesh.face_normals)
    usable: BoolArray = (length[..., 0] > 0) & (sliver[:, None] | (cosine > _GRAZING))
    far = (usable & (cosine < _FAR)).any(axis=1)
    areas = float(mesh.area), float(mesh.area_faces[far].sum())
    count = NormalCount(usable.size, int((~usable).sum()), *areas)
    if count.unusable < count.stated:
        state_normals(mesh, normals if usable.all() else np.where(usable[..., None], normals, corner_normals(mesh)))
    return count


def normal_warnings(counts: Sequence[NormalCount]) -> Iterator[str]:
    """Yield a warning about unusable normals of the parts of a file, and one about normals that round its edges."""
    stated, unusable, area, rounded = (sum(numbers) for numbers in zip(*counts, strict=True))
    if unusable:
        yield (
            f"{unusable} of the {stated} normals of its face corners are absent, zero, not finite, or on the back "
            "of their face: these are computed from the faces"
        )
    if rounded > _MAX_ROUNDED * area:
        yield (
            f"its normals round the edges of {rounded / area:.0%} of its area: if these edges are sharp, export it "
            "with split normals (flat shading), or without normals"
        )


def with_normals(proxy: trimesh.Trimesh, meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return a proxy of meshes with the stated normals of their nearest faces, if they differ from its own."""
    found = [stated_normals(mesh) for mesh in meshes]
    if all(normals is None for normals in found):
        return proxy
    source = trimesh.util.concatenate([trimesh.Trimesh(m.vertices, m.faces, process=False) for m in meshes])
    stated = np.concatenate(
        [np.full((len(m.faces), 3, 3), np.nan) if n is None else n for m, n in zip(meshes, found, strict=True)]
    )
    places = (proxy.triangles + _INSET * (proxy.triangles_center[:, None] - proxy.triangles)).reshape(-1, 3)
    facing = np.repeat(proxy.face_normals, 3, axis=0)
    faces, barycentric = nearest_faces(source, places)
    alike = (source.face_normals[faces] * facing).sum(axis=1) > _ALIKE
    if not alike.all():
        lift = _LIFT * source.scale
        raised = source.triangles + lift * source.face_normals[:, None]
        raised = trimesh.Trimesh(raised.reshape(-1, 3), np.arange(raised.size // 3).reshape(-1, 3), process=False)
        back = np.flatnonzero(~alike)
        faces[back], barycentric[back] = nearest_faces(raised, places[back] + 2 * lift * facing[back])
        alike[back] = (source.face_normals[faces[back]] * facing[back]).sum(axis=1) > _ALIKE
    normals = np.einsum("nk,nkd->nd", barycentric, stated[faces])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    alike &= (length[:, 0] > 1e-3) & ((normals * facing).sum(axis=1) > 0)  # False for NaN
    own = smooth_normals(proxy)
    normals = np.where(alike[:, None], normals / np.maximum(length, 1e-3), own.reshape(-1, 3)).reshape(-1, 3, 3)
    if ((normals * own).sum(axis=2) > _EQUAL).all():
        return proxy
    made = proxy.copy()
    state_normals(made, normals)
    return made
