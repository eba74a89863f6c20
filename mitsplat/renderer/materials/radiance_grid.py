"""Captured colours of the surroundings, for rays that hit them.

A grid of mean colours is sufficient where light is averaged over many directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.rigid import transform_points
from mitsplat.images.colour import decode_srgb
from mitsplat.renderer.rays.device_arrays import wrapped

CELLS = 80
"""Cells of the grid along its longest side."""


@dataclass(frozen=True, eq=False)
class RadianceGrid:
    """Mean linear colour of splats in the cells of a box; an empty cell has the colour of the nearest filled cell.

    Attributes:
        colours: Linear RGB per cell, x fastest, flat.
        low: Lower corner [m].
        size: Edge of a cell [m].
        cells: Number of cells along x, y and z.
    """

    colours: mi.Float
    low: mi.Point3f
    size: mi.Float
    cells: mi.Point3i

    @classmethod
    def build(cls, splats: Splats, world_from_splats: np.ndarray) -> RadianceGrid | None:
        """Build the grid from the splats with opacity above 0.5; return None if there are none."""
        opaque = splats.opacities > 0.5
        if not opaque.any():
            return None
        points = transform_points(world_from_splats, splats.means[opaque])
        encoded = np.clip(0.5 + SH_C0 * splats.sh[opaque, 0], 0.0, None)
        colours = decode_srgb(encoded)
        area = np.prod(np.sort(splats.scales[opaque], axis=1)[:, 1:], axis=1)
        low, high = points.min(axis=0), points.max(axis=0)
        size = float((high - low).max()) / CELLS or 1.0
        cells = np.maximum(np.ceil((high - low) / size).astype(int), 1)
        x, y, z = np.clip((points - low) / size, 0, cells - 1).astype(int).T
        cell = (z * cells[1] + y) * cells[0] + x
        weight = np.bincount(cell, area, minlength=cells.prod())
        sums = np.stack([np.bincount(cell, area * c, minlength=cells.prod()) for c in colours.T], axis=1)
        nearest = distance_transform_edt(
            (weight == 0).reshape(cells[::-1]), return_distances=False, return_indices=True
        )
        source = np.ravel_multi_index(tuple(nearest), tuple(cells[::-1])).ravel()
        mean = (sums / np.maximum(weight, 1e-30)[:, None])[source]
        return cls(
            wrapped(mi.Float, mean.astype(np.float32)),
            mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in low]),
            dr.opaque(mi.Float, size),
            mi.Point3i(*[dr.opaque(mi.Int32, int(v)) for v in cells]),
        )

    def at(self, point: mi.Point3f, active: mi.Bool) -> mi.Color3f:
        """Return the linear colour (Color3f) at points [m]."""
        i = dr.clip(mi.Point3i(dr.floor((point - self.low) / self.size)), 0, self.cells - 1)
        return dr.gather(mi.Color3f, self.colours, mi.UInt32((i.z * self.cells.y + i.y) * self.cells.x + i.x), active)
