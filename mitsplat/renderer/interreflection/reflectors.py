"""Light that surfaces reflect along rays: captured surroundings, objects and visible meshes.

Captured surroundings keep their captured colour, which contains all earlier bounces. Dynamic objects cast shadows on
them and reflect light onto them. Objects, relit surroundings and visible meshes reflect the emitters' light according
to their material, and the light of one further ray, which ends at the next surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import Beam, Emitters, receiver
from mitsplat.renderer.interreflection.captured_hits import CapturedHits
from mitsplat.renderer.interreflection.ray_paths import (
    Paths,
    end_kernel,
    lifted,
    next_key,
    occluded,
    place_on,
    sequence_number,
    shadow_ray,
    towards,
)
from mitsplat.renderer.materials.principled import SpecularLobe, power_weight
from mitsplat.renderer.materials.proxy_materials import SurfaceMaterial
from mitsplat.renderer.materials.radiance_grid import RadianceGrid
from mitsplat.renderer.occluders.proxies import Proxies, TraceScene
from mitsplat.renderer.rays.device_arrays import gathered

LANES = 1 << 20
"""Number of rays that are traced at once."""

BOUNCES = 2
"""Number of objects along a path. The last one is diffuse: a metal then reflects the mean of the light around it."""

MIN_LAMP_ROUGHNESS = 0.3
"""Roughness above which the emitters that plastics mirror are added. On smoother surfaces they are rare and bright."""

DIFFUSE_SPREAD = 0.5
"""GGX's alpha of a diffuse reflection in :func:`widened`."""


@dataclass(frozen=True, eq=False)
class _Point:
    """Points of objects and visible meshes that rays hit.

    Attributes:
        origin: Positions, lifted off the surface [m].
        normal: Unit normals towards the origin of the ray.
        instance: Instance ids.
        surface: Materials.
        albedo: Diffuse reflectance (Color3f).
        lobe: Specular lobes along the rays; None if the points are diffuse.
    """

    origin: mi.Point3f
    normal: mi.Normal3f
    instance: mi.UInt32
    surface: SurfaceMaterial
    albedo: mi.Color3f
    lobe: SpecularLobe | None

    @property
    def metal(self) -> mi.Bool:
        """True for metals, which mirror the further ray."""
        return self.surface.metallic > 0.5


@dataclass(frozen=True, eq=False)
class Reflectors:
    """Surfaces that reflect light.

    Attributes:
        scene: Mitsuba scene with the emitters.
        grid: Captured colours of the static proxies; None if there are none.
        proxies: Surfaces that rays hit, and their occluders.
        emitters: Light on objects and visible meshes.
        white: Irradiance (Color3f) of display white.
    """

    scene: mi.Scene
    grid: RadianceGrid | None
    proxies: Proxies
    emitters: Emitters
    white: mi.Color3f

    @property
    def any(self) -> bool:
        """True if any surface reflects light."""
        reflecting = self.proxies.reflecting
        lit = reflecting is not None and (self.proxies.shows_meshes or reflecting.materials is not None)
        return lit or (self.grid is not None and self.proxies.captured is not None)

    def irradiance(
        self,
        origin: mi.Point3f,
        normal: mi.Vector3f,
        start: mi.UInt32,
        step: int,
        rays: int,
        sequence: Callable[[mi.UInt32], tuple[mi.Point2f, mi.Point2f]],
    ) -> tuple[mi.Color3f, mi.Color3f, mi.Float]:
        """Compute the reflected irradiance at points (Color3f) over the irradiance of display white.

        Args:
            origin: Ray origins [m].
            normal: Unit normal of the surface.
            start: Sequence number of the first ray of every point.
            step: Difference between the numbers of two rays of a point.
            rays: Number of rays per point.
            sequence: Function that maps ray numbers to two points of the unit square.

        Returns:
            Irradiance from all surfaces, irradiance from the surroundings as if there were no dynamic objects,
            and inverse distance [1/m] of the surfaces, a mean that is weighted by their light.
        """
        count = dr.width(origin)
        together = max(1, min(rays, LANES // count))
        totals = [mi.Color3f(dr.zeros(mi.Float, count)) for _ in range(2)]
        nearness = dr.zeros(mi.Float, count)
        for first in range(0, rays, together):
            some = min(together, rays - first)
            lane = dr.arange(mi.UInt32, count * some)
            row = lane // dr.opaque(mi.UInt32, some)
            number = dr.gather(mi.UInt32, start, row) + (lane - row * some + dr.opaque(mi.UInt32, first)) * step
            upward, emitter_sample = sequence(number)
            frame = mi.Frame3f(dr.gather(mi.Vector3f, normal, row))
            direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(upward))
            ray = mi.Ray3f(dr.gather(mi.Point3f, origin, row), direction)
            dr.eval(ray, number, emitter_sample)
            spread = dr.opaque(mi.Float, DIFFUSE_SPREAD, count * some)
            colour, captured, distance = self._trace(ray, number, emitter_sample, spread, BOUNCES)
            for total, colours in zip(totals, (colour, captured), strict=True):
                total += mi.Color3f(*[dr.block_sum(c, some) for c in colours])
            nearness += dr.block_sum(dr.sum(colour) / dr.maximum(distance, 1e-6), some)
            dr.eval(totals, nearness)
        return totals[0] / rays, totals[1] / rays, nearness / dr.maximum(dr.sum(totals[0]), 1e-20)

    def outgoing(
        self, ray: mi.Ray3f, key: mi.UInt32, emitter_sample: mi.Point2f, spread: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        """Compute the radiance of the surfaces that rays hit, times pi over the irradiance of display white.

        Args:
            ray: Rays.
            key: Integer per ray, which selects its points of a low-discrepancy sequence.
            emitter_sample: Point of the unit square per ray that selects an emitter.
            spread: GGX's alpha of the lobe that reflects the light of each ray.

        Returns:
            Radiance (Color3f), 0 for a miss, and distances of the hits [m], infinite for a miss.
        """
        colour, _, distance = self._trace(mi.Ray3f(ray), key, emitter_sample, spread, BOUNCES)
        return colour, distance

    def _trace(
        self, ray: mi.Ray3f, key: mi.UInt32, emitter_sample: mi.Point2f, spread: mi.Float, bounces: int
    ) -> tuple[mi.Color3f, mi.Color3f, mi.Float]:
        """Return the colours (Color3f) at the hits of rays, those of surroundings alone, and the distances."""
        static, reflecting = self.proxies.captured, self.proxies.reflecting
        captured, distance = mi.Color3f(dr.zeros(mi.Float, dr.width(key))), mi.Float(dr.inf)
        ray.maxt = dr.inf
        if static is not None:
            ground = static.intersect(ray)
            hit = ground.is_valid()
            if self.grid is not None:
                captured = dr.select(hit, self.grid.at(ray, dr.select(hit, ground.t, 0), hit), 0)
            ray.maxt = distance = ground.t
            triangle = ground.prim_index
            dr.eval(triangle, ray, captured)
        if reflecting is None:
            return captured, captured, distance
        near = reflecting.intersect(ray)
        colour = dr.select(near.is_valid(), 0, captured)
        hits_object = near.is_valid()
        if self.emitters.sky is not None:  # indoors, the sky represents the light that walls reflect
            hits_object &= near.t < self.emitters.sky_reach
        distance = dr.select(near.is_valid(), dr.select(hits_object, near.t, dr.inf), distance)
        has_colour = dr.max(colour) > 0
        boxes = self.proxies.boxes if bounces > 1 and reflecting.materials is not None else None
        weight = mi.Color3f(1) if boxes is None else dr.full(mi.Color3f, 1, dr.width(key))
        dr.eval(near, colour, captured, hits_object, distance, has_colour, weight, key, emitter_sample)
        paths = Paths(ray, near, key, emitter_sample, spread, weight)
        lane = dr.compress(has_colour)
        if static is not None and dr.width(lane):
            seen, number, light_sample = (dr.gather(type(v), v, lane) for v in (captured, key, emitter_sample))
            place = place_on(static, dr.gather(mi.Ray3f, ray, lane), dr.gather(mi.UInt32, triangle, lane))
            hits = CapturedHits(static, self.grid, self.proxies, self.emitters, self.white)
            share = hits.arriving_share(place, number, light_sample)
            dr.scatter(colour, seen * share, lane)
            onward = None if boxes is None else hits.paths_to_objects(reflecting, boxes, place, seen, number)
            if onward is not None:
                lane = dr.gather(mi.UInt32, lane, onward[0])
                paths.set(lane, onward[1])
                dr.scatter(hits_object, mi.Bool(True), lane)
        lane = dr.compress(hits_object)
        if dr.width(lane):
            light = dr.gather(mi.Color3f, colour, lane) + self._reflected(bounces, gathered(paths, lane))
            dr.eval(light)  # avoids a copy of the colours before the write
            dr.scatter(colour, light, lane)  # scatter_add compiles per size
            if self.proxies.first_relit is not None:
                own = self.proxies.on_relit_surroundings(dr.gather(mi.PreliminaryIntersection3f, near, lane))
                dr.scatter(captured, light, lane, own)
                dr.eval(captured)
        dr.eval(colour)
        return colour, captured, distance

    def _reflected(self, bounces: int, paths: Paths) -> mi.Color3f:
        """Return the colour (Color3f) of objects and visible meshes: reflected light of one emitter and one ray."""
        reflecting = self.proxies.reflecting
        if reflecting is None:
            return mi.Color3f(0)
        materials, last = reflecting.materials, bounces == 1
        glossy = materials is not None and materials.glossy and not last
        point = self._point_at(reflecting, paths.ray, paths.hit, paths.spread if glossy else None)
        lit = self._direct_light(point, paths.key, paths.emitter_sample)
        if not last and materials is not None:
            lit = self._with_onward_light(lit, point, paths.key, bounces - 1)
        return lit * paths.weight

    def _point_at(
        self, reflecting: TraceScene, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, spread: mi.Float | None
    ) -> _Point:
        """Return the surface points at hits; with a ``spread``, with the specular lobes that reflect along the rays."""
        visible = reflecting.is_visible(hit)
        normal = reflecting.normal_at(hit.prim_index, ~visible)
        surface = reflecting.surface_at(hit.prim_index, hit.prim_uv, ~visible)
        colour, instance = surface.colour, dr.gather(mi.UInt32, reflecting.instances, hit.prim_index, ~visible)
        if self.proxies.shows_meshes:
            si = hit.compute_surface_interaction(ray)
            normal = dr.select(visible, si.n, normal)
            diffuse = (si.bsdf().flags() & int(mi.BSDFFlags.DiffuseReflection)) != 0
            colour = dr.select(visible, si.bsdf().eval_diffuse_reflectance(si, diffuse & visible), colour)
        normal = towards(normal, ray)
        origin = lifted(ray(hit.t), normal)
        if spread is None:
            return _Point(origin, normal, instance, surface, colour, None)
        roughness = widened(surface.roughness, spread)
        lobe = SpecularLobe.of(mi.Vector3f(normal), -ray.d, roughness, surface.metallic, surface.specular)
        return _Point(origin, normal, instance, surface, colour * (1 - surface.metallic), lobe)

    def _direct_light(self, point: _Point, key: mi.UInt32, emitter_sample: mi.Point2f) -> mi.Color3f:
        """Return the light (Color3f) of one sampled emitter that points reflect."""
        beam = self.emitters.sample(receiver(point.origin, point.normal), emitter_sample, mi.Bool(True))
        lit = point.albedo * beam.irradiance / self.white
        if point.lobe is not None:
            cosine = dr.dot(point.normal, beam.direction)
            lit += self._mirrored_emitter(point.lobe, point.surface, beam, cosine, point.metal)
        shadow, free = shadow_ray(point.origin, beam.direction, beam.reach), dr.max(lit) > 0
        end_kernel(self.proxies, lit, shadow, key, free, point.instance)
        free &= ~occluded(self.proxies, shadow, point.instance, key, free, self.proxies.occluder_scenes)
        return dr.select(free, lit, 0)

    def _with_onward_light(self, lit: mi.Color3f, point: _Point, key: mi.UInt32, bounces: int) -> mi.Color3f:
        """Add the light (Color3f) of one further ray per point: mirrored on metals, diffuse on other materials."""
        numbers = [sequence_number(key, dimension) for dimension in range(4)]
        sample, other = mi.Point2f(*numbers[:2]), mi.Point2f(*numbers[2:])
        direction = mi.Frame3f(point.normal).to_world(mi.warp.square_to_cosine_hemisphere(sample))
        throughput, density = mi.Color3f(point.albedo), mi.Float(0)
        spread, lobe, surface = dr.opaque(mi.Float, DIFFUSE_SPREAD, dr.width(key)), point.lobe, point.surface
        if lobe is not None:
            mirrored, weight, cos_half = lobe.sample(sample)
            direction, fresnel = dr.select(point.metal, mirrored, direction), lobe.fresnel(cos_half)
            throughput = dr.select(point.metal, (surface.colour * fresnel.tint + fresnel.white) * weight, throughput)
            density = dr.select(point.metal, lobe.evaluate(direction)[1], 0)
            spread = dr.select(point.metal, lobe.blur, spread)
        onward, normal = mi.Ray3f(point.origin, direction), point.normal
        throughput = dr.select(dr.dot(normal, direction) > 0, throughput, 0)
        dr.eval(lit, onward, throughput, normal, density, other, spread)
        lane = dr.compress(dr.max(throughput) > 0)
        if not dr.width(lane):
            return lit
        some = (dr.gather(type(v), v, lane) for v in (onward, key, other, normal, density, spread))
        onward, key, other, normal, density, spread = some
        key = next_key(key)
        dr.eval(onward, key, other, normal, density, spread)
        colour, _, onward.maxt = self._trace(onward, key, other, spread, bounces)
        if lobe is not None:
            colour += self._mirrored_emission(onward, normal, density)
        total = dr.gather(mi.Color3f, lit, lane) + dr.gather(mi.Color3f, throughput, lane) * colour
        dr.eval(total)
        dr.scatter(lit, total, lane)
        return lit

    def _mirrored_emission(self, ray: mi.Ray3f, normal: mi.Normal3f, density: mi.Float) -> mi.Color3f:
        """Return the light (Color3f) of emitters along mirrored rays; ``density`` is 0 for other rays."""
        mirrored = density > 0
        radiance, other = self.emitters.emission(self.scene, receiver(ray.o, normal), ray, mirrored)
        return dr.select(mirrored, radiance * (power_weight(density, other) * dr.pi / self.white), 0)

    def _mirrored_emitter(
        self, lobe: SpecularLobe, surface: SurfaceMaterial, beam: Beam, cosine: mi.Float, metal: mi.Bool
    ) -> mi.Color3f:
        """Return the specular reflection (Color3f) of sampled emitters. Mirrored rays of metals find them too."""
        value, density, cos_half = lobe.evaluate(beam.direction)
        fresnel = lobe.fresnel(cos_half)
        reflectance = (surface.colour * fresnel.tint + fresnel.white) * (dr.pi * value / dr.maximum(cosine, 1e-3))
        weight = dr.select(metal, power_weight(beam.density, density), 1)
        used = (cosine > 0) & (metal | (lobe.blur >= MIN_LAMP_ROUGHNESS**2))
        return dr.select(used, reflectance * beam.irradiance * (weight / self.white), 0)


def widened(roughness: mi.Float, spread: mi.Float) -> mi.Float:
    """Return the roughness of a surface that another lobe of GGX's alpha ``spread`` mirrors.

    The squares of both parameters add up, as the variances of their microfacet slopes. The other lobe blurs
    the image in any case, and few of its rays would find a narrow highlight. The energy is the same
    (Kaplanyan and Dachsbacher 2013, "Path Space Regularization for Holistic and Robust Light Transport").
    """
    return dr.sqrt(dr.sqrt(dr.power(roughness, 4) + dr.square(spread)))
