"""Radiance of visible meshes along camera rays, for materials that are not purely diffuse.

The meshes are path traced (Kajiya 1986). Each vertex samples one emitter and one direction of the material, weighted by
the power heuristic (Veach 1997, section 9.2.4). For meshes alone, the result equals that of Mitsuba's integrator
``path``. A path ends at a splat, whose captured colour contains all further bounces.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import receiver
from mitsplat.renderer.materials.principled import power_weight
from mitsplat.renderer.meshes.mirrored_splats import SplatHits, SplatMirror
from mitsplat.renderer.meshes.visible_meshes import VisibleMeshes, has_bsdf_flag
from mitsplat.renderer.occluders.proxies import Proxies
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered, opaque_seed, unit_float

LANES = 1 << 20
"""Number of paths that are traced at once."""

R7 = (3915259345, 3569120481, 3253582939, 2965941329, 2703729436, 2464699080, 2246800835)
"""Additive recurrence of seven dimensions in units of 2^-32 (Roberts 2018): powers of 1/g with g^8 = g + 1."""

MAX_DEPTH = 64
"""Largest path length, counted as in Mitsuba: 2 is direct light."""


class _Dimension:
    """Random numbers of a vertex of a path: first number of each choice, and the key of stochastic occluders."""

    EMITTER, LOBE, DIRECTION, PIXEL, EMITTER_OF_SPLATS, KEY = 0, 2, 3, 5, 7, 9
    COUNT = 16


ROUNDS = 8
"""Rounds of the hash behind the random numbers (Zafar et al. 2010). After four rounds, the numbers of adjacent pixels
are still correlated.
"""


@dataclass(frozen=True, eq=False)
class _Path:
    """Paths at a vertex.

    Attributes:
        lane: Number of the path.
        ray, hit: Incoming ray and its intersection.
        throughput: Radiance at the camera per radiance that leaves the vertex (Color3f).
    """

    lane: mi.UInt32
    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    throughput: mi.Color3f


@dataclass(frozen=True, eq=False)
class PathTracer:
    """Path tracer for the radiance of visible meshes along camera rays.

    Attributes:
        meshes: Meshes that camera rays hit.
        scene: Complete scene with its emitters.
        proxies: Additional occluders.
        mirror: Splats that paths may hit, or None.
        white: Irradiance (Color3f) under which uniformly captured colours are shown unchanged.
        max_depth: Largest path length, counted as in Mitsuba: 2 is direct light.
        bounce: True if splats light diffuse surfaces; mirrors always show splats.
        relights: True if the scene's emitters light splats that were captured under uniform light.
        seed: Seed of all random numbers.
    """

    meshes: VisibleMeshes
    scene: mi.Scene
    proxies: Proxies
    mirror: SplatMirror | None
    white: mi.Color3f
    max_depth: int
    bounce: bool
    relights: bool
    seed: int

    @property
    def exposure(self) -> mi.Color3f:
        """Factor from radiance to the picture's scale."""
        return dr.pi / self.white

    def radiance(
        self, view: CameraView, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, pixel: mi.UInt32, samples: int
    ) -> mi.Color3f:
        """Return the mean radiance (Color3f) over ``samples`` paths per pixel, in the picture's scale.

        ``ray`` through the pixel's centre hits a mesh at ``hit``. Paths start along other rays of the pixel where these
        hit a mesh too.
        """
        count = dr.width(pixel)
        seed = opaque_seed(self.seed)
        most = max(1, min(samples, LANES // count))
        total, done = mi.Color3f(dr.zeros(mi.Float, count)), 0
        while done < samples:
            own = min(most, samples - done)
            lane = dr.arange(mi.UInt32, count * own)
            row = lane // dr.opaque(mi.UInt32, own)
            number = lane - row * own + dr.opaque(mi.UInt32, done)
            numbers = _RandomNumbers(dr.gather(mi.UInt32, pixel, row), number, seed)
            centre = dr.gather(mi.Ray3f, ray, row), dr.gather(mi.PreliminaryIntersection3f, hit, row)
            dr.eval(lane, numbers, centre)
            path = _Path(lane, *self._jittered(view, numbers, *centre), dr.full(mi.Color3f, 1, count * own))
            dr.eval(path)
            light = self._trace(path, numbers)
            total += mi.Color3f(*[dr.block_sum(channel, own) for channel in light])
            dr.eval(total)
            done += own
        return total / samples

    def _jittered(
        self, view: CameraView, numbers: _RandomNumbers, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f
    ) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
        """Return rays through random points of the pixels and their hits.

        The ray through the centre is used where the random ray misses or hits a purely diffuse mesh.
        """
        row = numbers.pixel // view.width
        other = mi.Ray3f(ray)
        x, y = mi.Float(numbers.pixel - row * view.width), mi.Float(row)
        dx, dy = numbers.point(0, _Dimension.PIXEL)
        other.d = view.direction(x + dx, y + dy)
        jittered = self.meshes.scene.ray_intersect_preliminary(other, coherent=True)
        usable = jittered.is_valid() & ~self.meshes.is_diffuse(jittered)
        return dr.select(usable, other, ray), dr.select(usable, jittered, hit)

    def _trace(self, path: _Path, numbers: _RandomNumbers) -> mi.Color3f:
        """Return the radiance (Color3f) of every path."""
        result = mi.Color3f(dr.zeros(mi.Float, dr.width(path.lane)))
        lights = bool(self.scene.emitters())
        for depth in range(self.max_depth - 1):
            own = gathered(numbers, path.lane)
            si = self._interaction(path)
            bsdf, context = si.bsdf(path.ray), mi.BSDFContext()
            if lights:
                self._add_direct(result, path, si, bsdf, context, own.point(depth, _Dimension.EMITTER), own.key(depth))
            lobe, direction = own.number_of(depth, _Dimension.LOBE), own.point(depth, _Dimension.DIRECTION)
            sample, weight = bsdf.sample(context, si, lobe, direction)
            throughput = path.throughput * weight
            ray = si.spawn_ray(si.to_world(sample.wo))
            delta = has_bsdf_flag(sample.sampled_type, "Delta")
            diffuse = has_bsdf_flag(sample.sampled_type, "Diffuse")
            at, density = mi.Point3f(si.p), mi.Float(sample.pdf)
            dr.eval(throughput, ray, delta, diffuse, at, density)
            alive = dr.compress(dr.max(throughput) > 0)
            if not dr.width(alive):
                break
            lane = dr.gather(mi.UInt32, path.lane, alive)
            throughput = dr.gather(mi.Color3f, throughput, alive)
            ray = dr.gather(mi.Ray3f, ray, alive)
            dr.eval(lane, throughput, ray)
            hit = self.scene.ray_intersect_preliminary(ray)
            dr.eval(hit)
            path = _Path(lane, ray, hit, throughput)
            continuing = hit.is_valid()
            splat_hits = self._add_splats(path, dr.gather(mi.Bool, diffuse, alive), numbers, depth, result)
            if splat_hits is not None:
                continuing &= splat_hits.distance >= hit.t
            if lights:
                reference = dr.zeros(mi.Interaction3f, dr.width(lane))
                reference.p = dr.gather(mi.Point3f, at, alive)
                seen = mi.Bool(True) if splat_hits is None else ~(splat_hits.distance < hit.t)
                chance = dr.gather(mi.Float, density, alive)
                self._add_emission(result, path, reference, chance, dr.gather(mi.Bool, delta, alive), seen)
            continuing = dr.compress(continuing)
            if not dr.width(continuing):
                break
            path = gathered(path, continuing)
            dr.eval(path)
        return result

    @staticmethod
    def _interaction(path: _Path) -> mi.SurfaceInteraction3f:
        """Return the surface at path vertices, flipped towards the path if its material is opaque and one-sided."""
        si = path.hit.compute_surface_interaction(path.ray, mi.RayFlags.All)
        flags = si.bsdf().flags()
        behind = (si.wi.z < 0) & ~has_bsdf_flag(flags, "BackSide", "Transmission")
        frame = si.sh_frame
        si.sh_frame = mi.Frame3f(
            dr.select(behind, -frame.s, frame.s), frame.t, mi.Normal3f(dr.select(behind, -frame.n, frame.n))
        )
        si.n = dr.select(behind, -si.n, si.n)
        si.wi = si.to_local(-path.ray.d)
        return si

    def _add_direct(
        self,
        result: mi.Color3f,
        path: _Path,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        context: mi.BSDFContext,
        point: mi.Point2f,
        key: mi.UInt32,
    ) -> None:
        """Add the direct light of one sampled emitter."""
        scatters = has_bsdf_flag(bsdf.flags(), "Smooth")  # other than into single directions
        towards, light = self.scene.sample_emitter_direction(si, point, False, scatters)
        out = si.to_local(towards.d)
        value, density = bsdf.eval_pdf(context, si, out, scatters & (towards.pdf > 0))
        weight = dr.select(towards.delta, 1, power_weight(towards.pdf, density))
        arrives = path.throughput * value * light * self.exposure * weight
        arrives = dr.select(scatters & (towards.pdf > 0), arrives, 0)
        ray = si.spawn_ray_to(si.p + towards.d * towards.dist)
        infinite = _has_emitter_flag(towards.emitter, mi.EmitterFlags.Infinite)
        ray.maxt = dr.select(infinite, dr.inf, ray.maxt)
        self._add_unoccluded(result, path.lane, ray, arrives, key)

    def _add_unoccluded(
        self, result: mi.Color3f, lane: mi.UInt32, ray: mi.Ray3f, light: mi.Color3f, key: mi.UInt32
    ) -> None:
        """Add light to paths whose shadow rays are unoccluded; each traced scene has a kernel of its own."""
        dr.eval(ray, light, key)
        free = dr.max(light) > 0
        free &= ~self.scene.ray_test(ray, active=free)
        for occluder_scene in self.proxies.occluder_scenes:
            dr.eval(free)
            free = free & ~occluder_scene.occluded(ray, mi.UInt32(0), key, free)
        _add(result, lane, dr.select(free, light, 0))

    def _add_splats(
        self, path: _Path, diffuse: mi.Bool, numbers: _RandomNumbers, depth: int, result: mi.Color3f
    ) -> SplatHits | None:
        """Add the light of splats that paths hit; ``diffuse`` marks paths that a diffuse lobe has reflected."""
        if self.mirror is None:
            return None
        own = gathered(numbers, path.lane)
        key = own.key(depth)
        splat_hits = self.mirror.trace(path.ray, key)
        colour, nearer = splat_hits.colour, splat_hits.distance < path.hit.t
        if not self.bounce:
            colour = dr.select(diffuse, 0, colour)
        colour = dr.select(nearer, colour * path.throughput, 0)
        dr.eval(splat_hits, colour, key, nearer)
        if not self.relights:
            _add(result, path.lane, colour)
            return splat_hits
        _add(result, path.lane, dr.select(splat_hits.relit, 0, colour))
        relit = dr.compress(nearer & splat_hits.relit)
        if dr.width(relit):
            self._add_relit_splats(
                result,
                gathered(path, relit),
                gathered(splat_hits, relit),
                dr.gather(mi.Color3f, colour, relit),
                gathered(own, relit).point(depth, _Dimension.EMITTER_OF_SPLATS),
                dr.gather(mi.UInt32, key, relit),
            )
        return splat_hits

    def _add_relit_splats(
        self,
        result: mi.Color3f,
        path: _Path,
        splat_hits: SplatHits,
        colour: mi.Color3f,
        point: mi.Point2f,
        key: mi.UInt32,
    ) -> None:
        """Add the direct light of one sampled emitter on splats of a captured ``colour`` (Color3f)."""
        place = path.ray(splat_hits.distance)
        towards, light = self.scene.sample_emitter_direction(receiver(place, splat_hits.normal), point, False)
        cosine = dr.maximum(dr.dot(splat_hits.normal, towards.d), 0)
        infinite = _has_emitter_flag(towards.emitter, mi.EmitterFlags.Infinite)
        off = splat_hits.footprint
        shadow = mi.Ray3f(place + splat_hits.normal * off, towards.d)
        shadow.maxt = dr.select(infinite, dr.inf, dr.maximum(towards.dist * (1 - 1e-3) - off, 0))
        self._add_unoccluded(result, path.lane, shadow, colour * light * cosine / self.white, key)

    def _add_emission(
        self,
        result: mi.Color3f,
        path: _Path,
        reference: mi.Interaction3f,
        density: mi.Float,
        delta: mi.Bool,
        active: mi.Bool,
    ) -> None:
        """Add the light of emitters that paths hit."""
        si = path.hit.compute_surface_interaction(path.ray, mi.RayFlags.All)
        emitter = si.emitter(self.scene)
        towards = mi.DirectionSample3f(self.scene, si, reference)
        chance = self.scene.pdf_emitter_direction(reference, towards, active & ~delta)
        weight = dr.select(delta, 1, power_weight(density, chance))
        light = path.throughput * emitter.eval(si, active) * self.exposure * weight
        _add(result, path.lane, dr.select(active & (emitter != None), light, 0))  # noqa: E711 - of every element


@dataclass(frozen=True, eq=False)
class _RandomNumbers:
    """Random numbers of paths; the first vertices of a pixel's paths share a low-discrepancy sequence."""

    pixel: mi.UInt32
    number: mi.UInt32
    seed: mi.UInt32

    def key(self, depth: int) -> mi.UInt32:
        """Return an integer that differs between paths and vertices."""
        dimension = self._dimension(depth, _Dimension.KEY)
        return self.pixel * 0x9E3779B1 + self.number * _Dimension.COUNT * MAX_DEPTH + dimension + self.seed

    def point(self, depth: int, dimension: int) -> mi.Point2f:
        """Return a random point of the unit square, from two consecutive dimensions."""
        return mi.Point2f(self.number_of(depth, dimension), self.number_of(depth, dimension + 1))

    def number_of(self, depth: int, dimension: int) -> mi.Float:
        """Return a random number in [0, 1)."""
        if depth == 0 and dimension < len(R7):
            shift = mi.sample_tea_32(self.pixel, self.seed + self._dimension(0, dimension), ROUNDS)[0]
            return unit_float(shift + self.number * R7[dimension])
        own = mi.sample_tea_32(self.pixel, self.number + self.seed, ROUNDS)[0]
        return mi.sample_tea_float32(own, self._dimension(depth, dimension), ROUNDS)

    @staticmethod
    def _dimension(depth: int, dimension: int) -> mi.UInt32:
        return dr.opaque(mi.UInt32, depth * _Dimension.COUNT + dimension)


def _has_emitter_flag(emitter: mi.EmitterPtr, flag: mi.EmitterFlags) -> mi.Bool:
    return (emitter.flags() & int(flag)) != 0


def _add(total: mi.Color3f, lane: mi.UInt32, light: mi.Color3f) -> None:
    """Add ``light`` to the paths ``lane``, which must be distinct."""
    light = dr.gather(mi.Color3f, total, lane) + light
    dr.eval(light)
    dr.scatter(total, light, lane)
    dr.eval(total)
