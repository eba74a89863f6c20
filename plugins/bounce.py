"""Light that reaches objects from their surroundings: the radiance that the surroundings' splats have captured.

What a ray from an object meets, if it is not another object, shines with the colour that was captured there, which
holds all earlier bounces. A grid of mean colours is enough, because irradiance blurs it over the hemisphere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt

from mitsplat.colour import decode_srgb
from mitsplat.plugins.device import wrapped
from mitsplat.spherical_harmonics import SH_C0
from mitsplat.splats import Splats

CELLS = 80
"""Cells of the grid along its longest side."""

BOUNCE_RAYS = 6
"""Rays per object pixel, before neighbours are averaged."""


@dataclass(frozen=True, eq=False)
class RadianceGrid:
    """Mean linear colour of splats in the cells of a box; an empty cell has that of the nearest one with splats.

    Attributes:
        colours: Linear RGB per cell, x fastest, flat.
        low: Lower corner [m].
        size: Edge of a cell [m].
        cells: Cells along x, y and z.
    """

    colours: Any
    low: Any
    size: Any
    cells: Any

    @classmethod
    def build(cls, splats: Splats, world_from_splats: np.ndarray) -> RadianceGrid | None:
        """The grid of the opaque ones among ``splats``; None if there are none."""
        opaque = splats.opacities > 0.5
        if not opaque.any():
            return None
        points = splats.means[opaque] @ world_from_splats[:3, :3].T + world_from_splats[:3, 3]
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

    def at(self, point: Any, active: Any) -> Any:
        """Linear colour (Color3f) at points [m]."""
        i = dr.clip(mi.Point3i(dr.floor((point - self.low) / self.size)), 0, self.cells - 1)
        return dr.gather(mi.Color3f, self.colours, mi.UInt32((i.z * self.cells.y + i.y) * self.cells.x + i.x), active)


def bounced_light(grid: RadianceGrid, proxies: Any, origin: Any, normal: Any, sequence: Any) -> Any:
    """Irradiance (Color3f) from static proxies over that of display white, at points where there is no noise yet.

    Args:
        grid: Captured colours of the static proxies.
        proxies: What rays meet.
        origin: Where rays start [m].
        normal: Unit normal of the surface.
        sequence: Gives the point of the unit square for ray ``i`` of every point.
    """
    static, dynamic = proxies.static.scene, proxies.dynamic
    count = dr.width(origin)
    frame = mi.Frame3f(normal)
    rounds = dr.opaque(mi.UInt32, BOUNCE_RAYS)

    def ray_of(i: Any) -> Any:
        return mi.Ray3f(origin, frame.to_world(mi.warp.square_to_cosine_hemisphere(sequence(i))))

    def meet(i: Any) -> Any:
        """Distance [m] to what ray ``i`` of every point meets, infinite for nothing."""
        return static.ray_intersect_preliminary(ray_of(i)).t

    known = None
    if proxies.apart and dynamic is not None:
        known = dr.empty(mi.Float, BOUNCE_RAYS * count)
        lane = dr.arange(mi.UInt32, count) * BOUNCE_RAYS

        def note(i: Any) -> tuple[Any]:
            dr.scatter(known, meet(i), lane + i)
            return (i + 1,)

        dr.while_loop((dr.zeros(mi.UInt32, count),), lambda i: i < rounds, note, label="met")
        dr.eval(known)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        ray = ray_of(i)
        away = meet(i) if known is None else dr.gather(mi.Float, known, lane + i)
        met = away < dr.inf
        if dynamic is not None:
            ray.maxt = away
            met &= ~dynamic.scene.ray_test(ray, active=met)
        return i + 1, total + dr.select(met, grid.at(ray(away), met), 0)

    state = dr.zeros(mi.UInt32, count), dr.zeros(mi.Color3f, count)
    return dr.while_loop(state, lambda i, _: i < rounds, body, label="bounce")[1] / BOUNCE_RAYS
