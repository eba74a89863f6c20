"""Captured colours of the surroundings, for rays that hit them.

A grid of mean colours is sufficient where light is averaged over many directions. Colours depend on the direction: a
mat is brighter at grazing angles, and the constant term of spherical harmonics, which is its colour there, is up to 1.5
times as bright as the mat from above.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.gaussians.spherical_harmonics import SH_C0, sh_basis
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.rigid import transform_points
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.renderer.materials.proxy_materials import SURFACE_OPACITY
from mitsplat.renderer.projection.gaussian import srgb_to_linear
from mitsplat.renderer.projection.splat_appearance import SplatAppearance, changed_colours
from mitsplat.renderer.rays.device_arrays import wrapped

CELLS = 80
"""Cells of the grid along its longest side."""


@dataclass(frozen=True, eq=False)
class RadianceGrid:
    """Mean linear colour of splats in the cells of a box; an empty cell has the colour of the nearest filled cell.

    Every channel of the colour in the direction d of a ray is a + b . d, display-encoded.

    Attributes:
        terms: a and b for red, green and blue of each cell, x fastest, flat.
        low: Lower corner [m].
        size: Edge of a cell [m].
        cells: Number of cells along x, y and z.
    """

    terms: mi.Float
    low: mi.Point3f
    size: mi.Float
    cells: mi.Point3i

    @classmethod
    def build(
        cls, splats: Splats, world_from_splats: Float64Array, appearance: SplatAppearance | None = None
    ) -> RadianceGrid | None:
        """Build the grid from the splats that form surfaces; return None if there are none.

        Args:
            splats: The surroundings in their own frame.
            world_from_splats: Similarity transform, shape (4, 4).
            appearance: Change of their colours, or None.
        """
        opaque = splats.opacities > SURFACE_OPACITY
        if not opaque.any():
            return None
        points = transform_points(world_from_splats, splats.means[opaque])
        encoded = 0.5 + SH_C0 * splats.sh[opaque, 0]
        slopes = _slopes(splats.sh[opaque, :4], world_from_splats[:3, :3])
        if appearance is not None:
            change = partial(changed_colours, appearance=appearance, points=splats.means[opaque])
            ends = [(change(encoded + slope), change(encoded - slope)) for slope in np.moveaxis(slopes, 2, 0)]
            slopes = np.stack([(ahead - behind) / 2 for ahead, behind in ends], axis=2)
            encoded = change(encoded)
        colours = decode_srgb(np.clip(encoded, 0.0, None))
        area = np.prod(np.sort(splats.scales[opaque], axis=1)[:, 1:], axis=1)
        low, high = points.min(axis=0), points.max(axis=0)
        size = float((high - low).max()) / CELLS or 1.0
        cells = np.maximum(np.ceil((high - low) / size).astype(int), 1)
        x, y, z = np.clip((points - low) / size, 0, cells - 1).astype(int).T
        cell = (z * cells[1] + y) * cells[0] + x
        weight = np.bincount(cell, area, minlength=cells.prod())
        values = [*colours.T, *slopes.reshape(len(slopes), -1).T]
        sums = np.stack([np.bincount(cell, area * v, minlength=cells.prod()) for v in values], axis=1)
        nearest = distance_transform_edt(
            (weight == 0).reshape(cells[::-1]), return_distances=False, return_indices=True
        )
        source = np.ravel_multi_index(tuple(nearest), tuple(cells[::-1])).ravel()
        mean = (sums / np.maximum(weight, 1e-30)[:, None])[source]
        terms = np.concatenate([encode_srgb(mean[:, :3, None]), mean[:, 3:].reshape(-1, 3, 3)], axis=2)
        return cls(
            wrapped(mi.Float, terms.astype(np.float32).ravel()),
            mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in low]),
            dr.opaque(mi.Float, size),
            mi.Point3i(*[dr.opaque(mi.Int32, int(v)) for v in cells]),
        )

    def at(self, ray: mi.Ray3f, distance: mi.Float, active: mi.Bool) -> mi.Color3f:
        """Return the linear colour (Color3f) that rays see at a distance [m]."""
        i = dr.clip(mi.Point3i(dr.floor((ray(distance) - self.low) / self.size)), 0, self.cells - 1)
        cell = mi.UInt32((i.z * self.cells.y + i.y) * self.cells.x + i.x)
        rows = [dr.gather(mi.Vector4f, self.terms, 3 * cell + channel, active) for channel in range(3)]
        encoded = [row.x + dr.dot(mi.Vector3f(row.y, row.z, row.w), ray.d) for row in rows]
        return mi.Color3f(*[srgb_to_linear(dr.maximum(channel, 0)) for channel in encoded])


def _slopes(sh: Float32Array, world_from_splats: Float64Array) -> Float64Array:
    """Return the change (N, 3, 3) of encoded red, green and blue along the world's axes: the band 1 of ``sh``."""
    rotation = world_from_splats / np.cbrt(np.linalg.det(world_from_splats))
    degree = 1 if sh.shape[1] > 1 else 0
    return np.asarray(np.einsum("ak,nkc->nca", sh_basis(rotation, degree)[:, 1:], sh[:, 1:]))
