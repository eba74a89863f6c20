"""Materials of proxy surfaces at ray hits, derived from the Gaussians that the proxies represent.

Every corner of every triangle has the mean material of the nearest Gaussians that are parallel to it, and hits
interpolate between the corners. The parameters are those of Mitsuba's BSDF ``principled``. A surface without material
parameters is diffuse, and its colour is the captured one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float32Array, Float64Array, Int64Array
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.images.colour import decode_srgb
from mitsplat.renderer.projection.splat_appearance import SplatAppearance
from mitsplat.renderer.rays.device_arrays import wrapped

INSIDE = 0.1
"""Position at which a corner looks for Gaussians, as a share of the way from the corner to the triangle's centre.
Corners of different triangles at one vertex therefore find the Gaussians on their own side of an edge.
"""

NEIGHBOURS = 4, 64
"""Smallest and largest number of Gaussians per corner. A coarse mesh has more Gaussians per corner than a fine one."""

FACING = 8
"""Exponent of the cosine between a Gaussian's shortest axis and the normal of the triangle in the Gaussian's weight."""

KINDS = 4
"""Steps of the material parameters in which Gaussians count as different materials."""

NEIGHBOURS_OF_MIXED = 16
"""Smallest number of Gaussians per corner on a mesh of several materials. All of the nearest may lie across a step."""

OFF_TRIANGLE = 0.25
"""Distance from a triangle at which a Gaussian of a mesh with several materials counts less, by the factor exp(-1/2),
than on the triangle, as a share of the Gaussian's largest standard deviation.
"""

SHORTEST = 5
"""Edge length of triangles that are not divided further, in standard deviations of the Gaussians."""

SURFACE_OPACITY = 0.5
"""Opacity above which Gaussians form the surface."""


class MaterialColumns:
    """Columns of the packed material of a corner."""

    COLOUR = slice(0, 3)
    METALLIC, ROUGHNESS, SPECULAR = range(3, 6)
    WIDTH = 8


_BLACK = np.array([[0, 0, 0, 0, 1, 0, 0, 0]], np.float32)
"""Material of surfaces without Gaussians."""


class GlossChange(NamedTuple):
    """Roughness and specular that replace those of all materials of a placement; None keeps them."""

    roughness: float | None = None
    specular: float | None = None


UNCHANGED_GLOSS = GlossChange()


@dataclass(frozen=True, eq=False)
class SurfaceMaterial:
    """Materials at points.

    Attributes:
        colour: Linear base colour (Color3f), or captured colour of diffuse surfaces.
        metallic, roughness, specular: Parameters of ``principled``.
    """

    colour: mi.Color3f
    metallic: mi.Float
    roughness: mi.Float
    specular: mi.Float


class ProxyPart(NamedTuple):
    """Mesh of a placement with what determines its materials.

    Attributes:
        mesh: Surface in its own frame [m].
        instance: Instance id.
        pose: Bytes of the 16 floats of the pose.
        splats: Gaussians of the materials; None for a black surface.
        appearance: Change of the colours.
        gloss: Change of roughness and specular.
    """

    mesh: trimesh.Trimesh
    instance: int
    pose: bytes
    splats: Splats | None
    appearance: SplatAppearance | None
    gloss: GlossChange


@dataclass(frozen=True, eq=False)
class CornerMaterials:
    """Materials of the corners of triangles.

    Attributes:
        values: Packed values, see :class:`MaterialColumns`.
        glossy: True if any surface has a specular reflection.
    """

    values: mi.Float
    glossy: bool

    @classmethod
    def of(cls, parts: list[ProxyPart]) -> CornerMaterials | None:
        """Build the table of merged meshes; return None if no mesh has Gaussians."""
        if all(part.splats is None for part in parts):
            return None
        values = np.concatenate([part_materials(part) for part in parts])
        glossy = bool((values[:, [MaterialColumns.METALLIC, MaterialColumns.SPECULAR]] > 0).any())
        return cls(wrapped(mi.Float, values), glossy)

    def at(self, triangle: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> SurfaceMaterial:
        """Return the materials at barycentric coordinates ``uv`` of triangles."""
        shape = (MaterialColumns.WIDTH, dr.width(triangle))
        total = mi.ArrayXf(dr.zeros(mi.ArrayXf, shape))
        for corner, weight in enumerate((1 - uv.x - uv.y, uv.x, uv.y)):
            total += dr.gather(mi.ArrayXf, self.values, triangle * 3 + corner, active, shape=shape) * weight
        return SurfaceMaterial(
            mi.Color3f(*total[MaterialColumns.COLOUR]),
            total[MaterialColumns.METALLIC],
            total[MaterialColumns.ROUGHNESS],
            total[MaterialColumns.SPECULAR],
        )


@dataclass(frozen=True, eq=False)
class Triangles:
    """Parts of the triangles of a mesh.

    Attributes:
        face: Index of the mesh's triangle, shape (T,).
        barycentric: Barycentric coordinates of the corners in that triangle, shape (T, 3, 3).
    """

    face: npt.NDArray[np.intp]
    barycentric: Float64Array

    def interpolate(self, values: Float64Array) -> Float64Array:
        """Return values at the corners, shape (T, 3, C), given those at the corners of the mesh, shape (F, 3, C)."""
        return np.asarray(np.einsum("tij,tjc->tic", self.barycentric, values[self.face]))


@lru_cache(maxsize=64)
def material_triangles(mesh: trimesh.Trimesh, splats: Splats | None) -> Triangles | None:
    """Divide the triangles near which Gaussians have different materials; return None if no triangle is divided.

    A large triangle may lie below several materials, such as a printed disc on a bolt head. Such triangles are divided
    into four until their edges are about as short as the distance between Gaussians.
    """
    if splats is None or splats.materials is None:
        return None
    opaque = splats.opacities > SURFACE_OPACITY
    parameters = splats.materials.metallic, splats.materials.roughness, splats.materials.specular
    kinds, kind = np.unique(np.round(np.stack(parameters)[:, opaque] * KINDS), axis=1, return_inverse=True)
    if kinds.shape[1] < 2:
        return None
    means = splats.means[opaque]
    trees = [KDTree(means[kind.ravel() == k]) for k in range(kinds.shape[1])]
    shortest = SHORTEST * float(np.median(splats.scales[opaque].max(axis=1)))
    divided = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # corners 0 to 2, middles of 01, 12 and 20
    done: list[tuple[npt.NDArray[np.intp], Float64Array]] = []
    face, barycentric = np.arange(len(mesh.faces)), np.broadcast_to(np.eye(3), (len(mesh.faces), 3, 3))
    while len(face):
        corners = np.einsum("tij,tjc->tic", barycentric, mesh.triangles[face])
        edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        centre = corners.mean(axis=1)
        reach = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
        near = sum((tree.query(centre)[0] <= reach).astype(int) for tree in trees)
        mixed = (near > 1) & (edge > shortest)
        done.append((face[~mixed], barycentric[~mixed]))
        own = barycentric[mixed]
        points = np.concatenate([own, (own + np.roll(own, -1, axis=1)) / 2], axis=1)
        face, barycentric = np.repeat(face[mixed], 4), points[:, divided].reshape(-1, 3, 3)
    if len(done) == 1:
        return None
    return Triangles(np.concatenate([f for f, _ in done]), np.concatenate([b for _, b in done]))


@lru_cache(maxsize=64)
def corner_materials(mesh: trimesh.Trimesh, splats: Splats | None) -> Float32Array:
    """Return the packed materials of all corners in the frame of the splats, shape (3 T, 8); cached.

    The corners are those of :func:`material_triangles`, or of the T faces of the mesh.
    """
    triangles = material_triangles(mesh, splats)
    corners, facing = mesh.triangles, mesh.face_normals
    if triangles is not None:
        corners, facing = triangles.interpolate(corners), facing[triangles.face]
    count = 3 * len(corners)
    opaque = np.flatnonzero(splats.opacities > SURFACE_OPACITY) if splats is not None else np.zeros(0, int)
    if splats is None or not len(opaque):
        return np.repeat(_BLACK, count, axis=0)
    rows = np.repeat(_BLACK, len(opaque), axis=0)
    rows[:, MaterialColumns.COLOUR] = np.clip(decode_srgb(0.5 + SH_C0 * splats.sh[opaque, 0]), 0, 1)
    if splats.materials is not None:
        rows[:, MaterialColumns.METALLIC] = splats.materials.metallic[opaque]
        rows[:, MaterialColumns.ROUGHNESS] = splats.materials.roughness[opaque]
        rows[:, MaterialColumns.SPECULAR] = splats.materials.specular[opaque]
    places = corners + INSIDE * (corners.mean(axis=1, keepdims=True) - corners)
    least = NEIGHBOURS[0] if triangles is None else NEIGHBOURS_OF_MIXED
    neighbours = min(int(np.clip(len(opaque) // count, least, NEIGHBOURS[1])), len(opaque))
    _, nearest = KDTree(splats.means[opaque]).query(places.reshape(-1, 3), range(1, neighbours + 1))
    shortest, normals = shortest_axes(splats.select(opaque))
    agreement = np.einsum("nki,ni->nk", normals[nearest], np.repeat(facing, 3, axis=0))
    if (shortest == 2).all():
        # The third axis of surfels points outward: those of the other side of a sheet do not count.
        agreement = np.maximum(agreement, 0)
    weights = agreement**FACING + 1e-9
    if triangles is not None:
        weights *= _on_triangle(corners, splats, opaque[nearest])
    return np.einsum("nk,nkc->nc", weights / weights.sum(axis=1, keepdims=True), rows[nearest]).astype(np.float32)


def shortest_axes(splats: Splats) -> tuple[Int64Array, Float64Array]:
    """Return the index (N,) of the shortest axis of each Gaussian, and its direction (N, 3), which has no side."""
    axes, shortest = Rotation.from_quat(splats.quats).as_matrix(), splats.scales.argmin(axis=1)
    return shortest, np.take_along_axis(axes, shortest[:, None, None], axis=2)[..., 0]


def _on_triangle(corners: Float64Array, splats: Splats, nearest: Int64Array) -> Float64Array:
    """Return weights (3 T, K) of the Gaussians ``nearest`` (3 T, K) of each corner, 1 for the one nearest its triangle.

    A step or a seam is an edge of the mesh. Gaussians across it are close to the corner, but not to its triangle.
    """
    count, neighbours = nearest.shape
    triangle = np.repeat(corners, 3 * neighbours, axis=0)
    points = splats.means[nearest.ravel()]
    away = np.linalg.norm(points - trimesh.triangles.closest_point(triangle, points), axis=1)
    squares = np.square(away / (OFF_TRIANGLE * splats.scales[nearest.ravel()].max(axis=1))).reshape(count, neighbours)
    return np.asarray(np.exp(-0.5 * (squares - squares.min(axis=1, keepdims=True))))


def part_materials(part: ProxyPart) -> Float32Array:
    """Return the packed materials of all corners of a placement, shape (3 T, 8); dirt is ignored."""
    corners, appearance, gloss = corner_materials(part.mesh, part.splats), part.appearance, part.gloss
    if appearance is None and gloss == UNCHANGED_GLOSS:
        return corners
    result = corners.copy()
    if appearance is not None:
        matrix = np.reshape(appearance.matrix, (3, 3))
        result[:, MaterialColumns.COLOUR] = np.clip(corners[:, MaterialColumns.COLOUR] @ matrix.T, 0, 1)
    for column, value in ((MaterialColumns.ROUGHNESS, gloss.roughness), (MaterialColumns.SPECULAR, gloss.specular)):
        if value is not None:
            result[:, column] = value
    return result
