"""Indirect light on objects: one bounce from captured splats and visible meshes.

A ray from an object that hits the surroundings takes the colour captured there, which contains all earlier bounces. A
grid of mean colours is sufficient, because irradiance blurs it over the hemisphere. A visible mesh contributes the
emitters' light that its diffuse material reflects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.images.colour import decode_srgb
from mitsplat.renderer.light.emitter_sampling import Emitters, receiver
from mitsplat.renderer.light.light_filter import RADIUS, LightFilter
from mitsplat.renderer.light.light_tiles import STRIDE
from mitsplat.renderer.light.shadow_rays import ROBERTS, ShadowTracer, ray_origin, sequence_point
from mitsplat.renderer.occluders.proxies import Proxies
from mitsplat.renderer.rays.device_arrays import gathered, wrapped

CELLS = 80
"""Cells of the grid along its longest side."""

BOUNCE_RAYS = 7
"""Rays per object pixel, before neighbours are averaged."""

MESH_RAYS = 2
"""Rays per pixel on visible meshes such as a table, at one pixel of four; averages over even surfaces reduce the noise.
"""

LANES = 1 << 20
"""Number of rays that are traced at once."""


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

    def at(self, point: mi.Point3f, active: mi.Bool) -> mi.Color3f:
        """Return the linear colour (Color3f) at points [m]."""
        i = dr.clip(mi.Point3i(dr.floor((point - self.low) / self.size)), 0, self.cells - 1)
        return dr.gather(mi.Color3f, self.colours, mi.UInt32((i.z * self.cells.y + i.y) * self.cells.x + i.x), active)


@dataclass(frozen=True, eq=False)
class Reflectors:
    """Surfaces that reflect light onto objects.

    Attributes:
        grid: Captured colours of the static proxies; None if there are none.
        proxies: Surfaces that rays hit, and their occluders.
        emitters: Light on visible meshes.
        white: Irradiance (Color3f) of display white.
    """

    grid: RadianceGrid | None
    proxies: Proxies
    emitters: Emitters
    white: mi.Color3f

    @property
    def any(self) -> bool:
        """True if any surface reflects light."""
        return self.proxies.shows_meshes or (self.grid is not None and self.proxies.static is not None)

    def irradiance(
        self,
        origin: mi.Point3f,
        normal: mi.Vector3f,
        start: mi.UInt32,
        rays: int,
        sequence: Callable[[mi.UInt32], tuple[mi.Point2f, mi.Point2f]],
    ) -> mi.Color3f:
        """Compute the reflected irradiance at points (Color3f) over the irradiance of display white.

        Args:
            origin: Ray origins [m].
            normal: Unit normal of the surface.
            start: Sequence number of the first ray of every point.
            rays: Number of rays per point.
            sequence: Function that maps ray numbers to two points of the unit square.
        """
        count = dr.width(origin)
        together = max(1, min(rays, LANES // count))
        total = mi.Color3f(dr.zeros(mi.Float, count))
        for first in range(0, rays, together):
            some = min(together, rays - first)
            lane = dr.arange(mi.UInt32, count * some)
            row = lane // dr.opaque(mi.UInt32, some)
            number = dr.gather(mi.UInt32, start, row) + (lane - row * some + dr.opaque(mi.UInt32, first)) * STRIDE
            upward, light = sequence(number)
            frame = mi.Frame3f(dr.gather(mi.Vector3f, normal, row))
            towards = frame.to_world(mi.warp.square_to_cosine_hemisphere(upward))
            ray = mi.Ray3f(dr.gather(mi.Point3f, origin, row), towards)
            dr.eval(ray, number, light)
            total += mi.Color3f(*[dr.block_sum(c, some) for c in self._colour(ray, number, light)])
            dr.eval(total)
        return total / rays

    def outgoing(self, ray: mi.Ray3f, key: mi.UInt32, light: mi.Point2f) -> tuple[mi.Color3f, mi.Float]:
        """Return the light (Color3f) that surfaces send against rays, in units of white, and their distances [m]."""
        ray.maxt = dr.inf
        colour = self._colour(ray, key, light)
        distance = mi.Float(ray.maxt)
        if self.proxies.dynamic is not None:
            hit = self.proxies.dynamic.scene.ray_intersect_preliminary(ray)
            distance = dr.minimum(distance, hit.t)
        return colour, distance

    def _colour(self, ray: mi.Ray3f, key: mi.UInt32, light: mi.Point2f) -> mi.Color3f:
        """Return the colour (Color3f) at the hits of rays.

        Each scene is traced by a kernel of its own, see ``Proxies.separate_kernels``.
        """
        static, dynamic = self.proxies.static, self.proxies.dynamic
        colour = mi.Color3f(dr.zeros(mi.Float, dr.width(key)))
        if static is not None:
            ray.maxt = static.scene.ray_intersect_preliminary(ray).t
            dr.eval(ray)
        met, mesh, hit = ray.maxt < dr.inf, None, None
        if dynamic is not None and self.proxies.shows_meshes:
            hit = dynamic.scene.ray_intersect_preliminary(ray)
            mesh = hit.is_valid() & dynamic.is_visible(hit)
            if self.emitters.sky is not None:  # indoors, the sky represents the light that walls reflect
                mesh &= hit.t < self.emitters.sky_reach
            met &= ~hit.is_valid()
            dr.eval(hit, mesh)
        elif dynamic is not None:
            met &= ~dynamic.scene.ray_test(ray, active=met)
        if self.grid is not None:
            colour = dr.select(met, self.grid.at(ray(dr.select(met, ray.maxt, 0)), met), 0)
        dr.eval(colour)
        if mesh is not None:
            lane = dr.compress(mesh)
            if dr.width(lane):
                some = (dr.gather(type(v), v, lane) for v in (ray, hit, key, light))
                dr.scatter(colour, self._lit_mesh(*some), lane)
        return colour

    def _lit_mesh(
        self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, key: mi.UInt32, light: mi.Point2f
    ) -> mi.Color3f:
        """Return the colour (Color3f) of visible meshes: reflected light of one ray to an emitter."""
        si = hit.compute_surface_interaction(ray)
        normal = dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n)
        diffuse = (si.bsdf().flags() & int(mi.BSDFFlags.DiffuseReflection)) != 0
        reflectance = dr.select(diffuse, si.bsdf().eval_diffuse_reflectance(si, diffuse), 0)
        beam = self.emitters.sample(receiver(si.p, normal), light, mi.Bool(True))
        colour, shadow = reflectance * beam.irradiance / self.white, si.spawn_ray(beam.direction)
        shadow.maxt = beam.reach * (1 - 1e-3)
        free = dr.max(colour) > 0
        dr.eval(colour, shadow, key, free)
        for occluder_scene in self.proxies.occluder_scenes:
            free = free & ~occluder_scene.occluded(shadow, mi.UInt32(0), key, free)
            dr.eval(free)
        return dr.select(free, colour, 0)


def trace_bounce(tracer: ShadowTracer, reflectors: Reflectors) -> tuple[mi.Color3f, mi.Float]:
    """Return the reflected irradiance (Color3f), divided by that of display white, and a mask (Float).

    The mask is 1 at points where the irradiance was computed, and 0 elsewhere.

    Relit points of objects use a few rays each, so that their neighbours must be averaged. On visible meshes, one
    pixel in each cell of 2 x 2 is traced, and the result is already a mean over many cells. This mean is necessary,
    because few rays hit small bright regions such as a wall near a lamp.
    """
    surface, view, pixel = tracer.surface, tracer.view, tracer.pixel
    cells = replace(view, width=-(-view.width // 2), height=-(-view.height // 2))
    x, y = pixel % view.width, pixel // view.width
    column, row = x >> 1, y >> 1
    selected = ((x & 1) == (row & 1)) & (
        (y & 1) == ((column + row) & 1)
    )  # equally often in each row and in each column
    if tracer.lattice is not None:
        selected |= dr.gather(mi.Bool, tracer.lattice, pixel)
    thing, count = surface.instance > 0, dr.width(pixel)
    total, known = mi.Color3f(dr.zeros(mi.Float, count)), dr.zeros(mi.Float, count)
    for on_mesh, which, rays in ((False, thing, BOUNCE_RAYS), (True, ~thing & selected, MESH_RAYS)):
        places = dr.compress(surface.relit & which)
        if not dr.width(places):
            continue
        own = gathered(surface, places)
        start = tracer.sequence_start(dr.gather(mi.UInt32, pixel, places))
        origin, normal = mi.Point3f(ray_origin(own)), mi.Vector3f(own.normal)
        dr.eval(own, start, origin, normal)
        found = reflectors.irradiance(origin, normal, start, rays, _two_points)
        if on_mesh:
            cell = dr.gather(mi.UInt32, row * cells.width + column, places)
            for stride in (1, RADIUS):
                found = LightFilter(own, cells, cell, stride=stride).average([*found])
        dr.scatter(total, mi.Color3f(*found), places)
        dr.scatter(known, mi.Float(1), places)
        dr.eval(total, known)
    return total, known


def _two_points(i: mi.UInt32) -> tuple[mi.Point2f, mi.Point2f]:
    return sequence_point(i), sequence_point(i, ROBERTS)
