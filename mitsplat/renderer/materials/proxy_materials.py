"""Materials of proxy surfaces at ray hits, derived from the Gaussians that the proxies represent.

Every corner of every triangle has the mean material of the nearest Gaussians that are parallel to it, and hits
interpolate between the corners.
The parameters are those of Mitsuba's BSDF ``principled``. A surface without material parameters is diffuse, and its
colour is the captured one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float32Array
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

MIN_OPACITY = 0.5
"""Opacity above which Gaussians form the surface."""


class _Columns:
    """Columns of the packed material of a corner."""

    COLOUR = slice(0, 3)
    METALLIC, ROUGHNESS, SPECULAR = range(3, 6)
    WIDTH = 8


_BLACK = np.array([[0, 0, 0, 0, 1, 0, 0, 0]], np.float32)
"""Material of surfaces without Gaussians."""


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


@dataclass(frozen=True, eq=False)
class CornerMaterials:
    """Materials of the corners of triangles.

    Attributes:
        values: Packed values, see :class:`_Columns`.
        glossy: True if any surface has a specular reflection.
    """

    values: mi.Float
    glossy: bool

    @classmethod
    def of(cls, parts: list[tuple[trimesh.Trimesh, Splats | None, SplatAppearance | None]]) -> CornerMaterials | None:
        """Build the table of merged meshes; return None if no mesh has Gaussians."""
        if all(splats is None for _, splats, _ in parts):
            return None
        values = np.concatenate(
            [_recoloured(corner_materials(mesh, splats), appearance) for mesh, splats, appearance in parts]
        )
        glossy = bool((values[:, [_Columns.METALLIC, _Columns.SPECULAR]] > 0).any())
        return cls(wrapped(mi.Float, values), glossy)

    def at(self, triangle: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> SurfaceMaterial:
        """Return the materials at barycentric coordinates ``uv`` of triangles."""
        shape = (_Columns.WIDTH, dr.width(triangle))
        total = mi.ArrayXf(dr.zeros(mi.ArrayXf, shape))
        for corner, weight in enumerate((1 - uv.x - uv.y, uv.x, uv.y)):
            total += dr.gather(mi.ArrayXf, self.values, triangle * 3 + corner, active, shape=shape) * weight
        return SurfaceMaterial(
            mi.Color3f(*total[_Columns.COLOUR]),
            total[_Columns.METALLIC],
            total[_Columns.ROUGHNESS],
            total[_Columns.SPECULAR],
        )


@lru_cache(maxsize=64)
def corner_materials(mesh: trimesh.Trimesh, splats: Splats | None) -> Float32Array:
    """Return the packed materials of all corners of a mesh in the frame of the splats, shape (3 F, 8); cached."""
    count = 3 * len(mesh.faces)
    opaque = np.flatnonzero(splats.opacities > MIN_OPACITY) if splats is not None else np.zeros(0, int)
    if splats is None or not len(opaque):
        return np.repeat(_BLACK, count, axis=0)
    rows = np.repeat(_BLACK, len(opaque), axis=0)
    rows[:, _Columns.COLOUR] = np.clip(decode_srgb(0.5 + SH_C0 * splats.sh[opaque, 0]), 0, 1)
    if splats.materials is not None:
        rows[:, _Columns.METALLIC] = splats.materials.metallic[opaque]
        rows[:, _Columns.ROUGHNESS] = splats.materials.roughness[opaque]
        rows[:, _Columns.SPECULAR] = splats.materials.specular[opaque]
    corners = mesh.triangles
    places = corners + INSIDE * (corners.mean(axis=1, keepdims=True) - corners)
    neighbours = min(int(np.clip(len(opaque) // count, *NEIGHBOURS)), len(opaque))
    _, nearest = KDTree(splats.means[opaque]).query(places.reshape(-1, 3), range(1, neighbours + 1))
    axes = Rotation.from_quat(splats.quats[opaque]).as_matrix()
    normals = np.take_along_axis(axes, splats.scales[opaque].argmin(axis=1)[:, None, None], axis=2)[..., 0]
    agreement = np.einsum("nki,ni->nk", normals[nearest], np.repeat(mesh.face_normals, 3, axis=0))
    weights = agreement**FACING + 1e-9
    return np.einsum("nk,nkc->nc", weights / weights.sum(axis=1, keepdims=True), rows[nearest]).astype(np.float32)


def _recoloured(corners: Float32Array, appearance: SplatAppearance | None) -> Float32Array:
    """Return the corners of a placement with the colour matrix of its appearance; dirt is ignored."""
    if appearance is None:
        return corners
    result = corners.copy()
    matrix = np.reshape(appearance.matrix, (3, 3))
    result[:, _Columns.COLOUR] = np.clip(corners[:, _Columns.COLOUR] @ matrix.T, 0, 1)
    return result
