"""Visible meshes: camera hits, and the radiance of their materials.

Purely diffuse meshes are lit like splats, see :mod:`mitsplat.renderer.light.light`. All other materials of Mitsuba are
path traced (Kajiya 1986). Each vertex samples one emitter and one direction of the material, weighted by the power
heuristic (Veach 1997, section 9.2.4). For meshes alone, the result equals that of Mitsuba's integrator ``path``. A path
ends at a splat, whose captured colour contains all further bounces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.renderer.light.emitter_sampling import receiver
from mitsplat.renderer.meshes.mirrored_splats import SplatHits, SplatMirror
from mitsplat.renderer.occluders.proxies import Hit, Proxies
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered, ray_scene, wrapped
from mitsplat.renderer.splatting.gaussian import srgb_to_linear

LANES = 1 << 20
"""Number of paths that are traced at once."""

R7 = (3915259345, 3569120481, 3253582939, 2965941329, 2703729436, 2464699080, 2246800835)
"""Additive recurrence of seven dimensions in units of 2^-32 (Roberts 2018): powers of 1/g with g^8 = g + 1."""

PER_VERTEX = 16
"""Random numbers that are reserved for each vertex of a path."""

ROUNDS = 8
"""Rounds of the hash behind the random numbers (Zafar et al. 2010). After four rounds, the numbers of adjacent pixels
are still correlated.
"""

FOOTPRINT = 4
"""Sample points along each side of a pixel's footprint for the reflectance of textured meshes."""

_NORMAL_MODIFIERS = ("NormalMap", "BumpMap")
"""Materials that perturb the normals of their nested material."""


def _has(flags: mi.UInt32, *names: str) -> mi.Bool:
    return (flags & reduce(or_, (int(getattr(mi.BSDFFlags, name)) for name in names))) != 0


def is_diffuse(bsdf: mi.BSDF) -> bool:
    """Return True if a material is purely diffuse."""
    flags, diffuse = int(bsdf.flags()), int(mi.BSDFFlags.DiffuseReflection)
    return (flags & int(mi.BSDFFlags.All)) == diffuse and not any(name in str(bsdf) for name in _NORMAL_MODIFIERS)


def is_transmissive(bsdf: mi.BSDF) -> bool:
    """Return True if light passes through a material, which then casts no shadow on splats and diffuse meshes."""
    return bool(_has(int(bsdf.flags()), "GlossyTransmission", "DeltaTransmission")) or "ThinDielectric" in str(bsdf)


def has_texture(bsdf: mi.BSDF) -> bool:
    """Return True if a material depends on texture coordinates; Mitsuba does not set its flag for textures."""
    return any(key.endswith(".to_uv") for key in mi.traverse(bsdf).keys())  # noqa: SIM118 - no mapping


@dataclass(frozen=True, eq=False)
class MeshHits:
    """Camera hits on visible meshes.

    Attributes:
        depth: Depth along z [m], infinite for a miss.
        reflectance: Diffuse albedo (Color3f) of purely diffuse meshes.
        valid: True for a hit.
        diffuse: True if the mesh is purely diffuse.
        normal, face: Unit normals of the surface and of its triangle, towards the camera.
        hit: Mitsuba's intersection.
    """

    depth: mi.Float
    reflectance: mi.Color3f
    valid: mi.Bool
    diffuse: mi.Bool
    normal: mi.Normal3f
    face: mi.Normal3f
    hit: mi.PreliminaryIntersection3f

    def before(self, other: Hit) -> Hit:
        """Return the nearer of these hits and other hits of the same rays."""
        closer = self.valid & (self.hit.t < other.distance)
        return Hit(
            dr.select(closer, self.hit.t, other.distance),
            dr.select(closer, self.face, other.face),
            dr.select(closer, self.normal, other.normal),
            dr.select(closer, 0, other.lift),
            dr.select(closer, 0, other.instance),
        )


@dataclass(frozen=True, eq=False)
class VisibleMeshes:
    """Meshes of a scene that are neither splats nor lights.

    Attributes:
        scene: Mitsuba scene of these meshes only.
        diffuse: True if a shape is purely diffuse, by shape number; None if all shapes are.
        textured: True if the reflectance of any mesh varies over its surface.
    """

    scene: mi.Scene
    diffuse: mi.Bool | None
    textured: bool

    @classmethod
    def build(cls, shapes: Sequence[mi.Shape]) -> VisibleMeshes | None:
        """Build the scene of the visible ``shapes``; return None if there are none."""
        if not shapes:
            return None
        scene = ray_scene({f"visible_{i}": shape for i, shape in enumerate(shapes)})
        diffuse = [is_diffuse(shape.bsdf()) for shape in shapes]
        textured = any(map(has_texture, (shape.bsdf() for shape in shapes)))
        if all(diffuse):
            return cls(scene, None, textured)
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        table = np.zeros(1 + max(numbers), bool)
        table[numbers] = diffuse
        return cls(scene, wrapped(mi.Bool, table), textured)

    def is_diffuse(self, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Return True for hits on purely diffuse meshes, False for misses."""
        if self.diffuse is None:
            return hit.is_valid()
        return dr.gather(mi.Bool, self.diffuse, dr.reinterpret_array(mi.UInt32, hit.shape), hit.is_valid())

    def trace(self, view: CameraView, rays: mi.Ray3f, at: tuple[mi.Float, mi.Float] | None = None) -> MeshHits:
        """Trace camera rays through positions ``at`` [px], or through the centres of all pixels."""
        hit = self.scene.ray_intersect_preliminary(rays, coherent=True)
        si = hit.compute_surface_interaction(rays)
        valid = si.is_valid()
        diffuse = self.is_diffuse(hit)
        reflectance = self._reflectance(view, rays, at, si, valid & diffuse)
        depth = dr.select(valid, si.t * view.cosine(rays), dr.inf)
        normal, face = (dr.select(dr.dot(n, rays.d) > 0, -n, n) for n in (si.sh_frame.n, si.n))
        behind = MeshHits(depth, reflectance, valid, diffuse, normal, face, hit)
        dr.eval(behind)
        return behind

    def _reflectance(
        self,
        view: CameraView,
        rays: mi.Ray3f,
        at: tuple[mi.Float, mi.Float] | None,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> mi.Color3f:
        """Return the diffuse albedo (Color3f) of hits; for textures, its mean over the pixel's footprint.

        The footprint is the parallelogram of ray differentials (Igehy 1999), sampled at ``FOOTPRINT`` squared points.
        """
        if not self.textured:
            return si.bsdf().eval_diffuse_reflectance(si, active)
        x, y = at or view.centres()
        wide = mi.RayDifferential3f(rays)
        wide.o_x, wide.o_y, wide.has_differentials = rays.o, rays.o, True
        wide.d_x, wide.d_y = view.direction(x + 1, y), view.direction(x, y + 1)
        si.compute_uv_partials(wide)
        bsdf, uv, total = si.bsdf(), mi.Point2f(si.uv), mi.Color3f(0)
        across, along = (dr.select(dr.isfinite(step), step, 0) for step in (si.duv_dx, si.duv_dy))
        for i in range(FOOTPRINT**2):
            s, t = ((number + 0.5) / FOOTPRINT - 0.5 for number in divmod(i, FOOTPRINT))
            si.uv = uv + s * across + t * along
            total += bsdf.eval_diffuse_reflectance(si, active)
        si.uv = uv
        return total / FOOTPRINT**2


@dataclass(frozen=True, eq=False)
class VisibleEmitters:
    """Emitters seen by a camera.

    Attributes:
        depth: Depth along z [m] of emitters that are shapes, infinite for a miss.
        radiance: Radiance of the shape, otherwise of the sky (Color3f).
        everywhere: True if there is a sky.
    """

    depth: mi.Float
    radiance: mi.Color3f
    everywhere: bool

    @classmethod
    def trace(cls, scene: mi.Scene, view: CameraView, rays: mi.Ray3f) -> VisibleEmitters | None:
        """Trace camera rays to a scene's emitters; return None if no emitter can be visible."""
        sky = scene.environment()
        if any(shape.is_emitter() for shape in scene.shapes()):
            si = scene.ray_intersect(rays, mi.RayFlags.All, coherent=True)
        elif sky is not None:
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(rays))
            si.t, si.wi = dr.full(mi.Float, dr.inf, dr.width(rays)), -rays.d
        else:
            return None
        emitter = si.emitter(scene)
        shines = emitter != None  # noqa: E711 - of every element
        depth = dr.select(shines & si.is_valid(), si.t * view.cosine(rays), dr.inf)
        # Meshes that occlude the sky are handled by their depth.
        lights = cls(depth, dr.select(shines, emitter.eval(si, shines), 0), sky is not None)
        dr.eval(lights)
        return lights


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
        exposure: Factor from radiance to the picture's scale (Color3f).
        white: Irradiance (Color3f) under which uniformly captured colours are shown unchanged.
        max_depth: Largest path length, counted as in Mitsuba: 2 is direct light.
        bounce: True if splats light diffuse surfaces; mirrors always show splats.
        seed: Seed of all random numbers.
    """

    meshes: VisibleMeshes
    scene: mi.Scene
    proxies: Proxies
    mirror: SplatMirror | None
    exposure: mi.Color3f
    white: mi.Color3f
    max_depth: int
    bounce: bool
    seed: int

    def radiance(
        self, view: CameraView, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, pixel: mi.UInt32, samples: int
    ) -> mi.Color3f:
        """Return the mean radiance (Color3f) over ``samples`` paths per pixel, in the picture's scale.

        ``ray`` through the pixel's centre hits a mesh at ``hit``. Paths start along other rays of the pixel where these
        hit a mesh too.
        """
        count = dr.width(pixel)
        # The factor separates the seeds, so that no two pictures share random numbers.
        seed = dr.opaque(mi.UInt32, self.seed * 2654435761 % (1 << 32))
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
        other.d = view.direction(x + numbers.number_of(0, 5), y + numbers.number_of(0, 6))
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
            u = [own.number_of(depth, i) for i in range(5)]
            if lights:
                self._add_direct(result, path, si, bsdf, context, mi.Point2f(u[0], u[1]), own.key(depth))
            sample, weight = bsdf.sample(context, si, u[2], mi.Point2f(u[3], u[4]))
            throughput = path.throughput * weight
            ray = si.spawn_ray(si.to_world(sample.wo))
            delta = _has(sample.sampled_type, "Delta")
            smooth = _has(sample.sampled_type, "Diffuse")
            at, density = mi.Point3f(si.p), mi.Float(sample.pdf)
            dr.eval(throughput, ray, delta, smooth, at, density)
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
            splat_hits = self._add_splats(path, dr.gather(mi.Bool, smooth, alive), numbers, depth, result)
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
            path = _Path(
                dr.gather(mi.UInt32, lane, continuing),
                dr.gather(mi.Ray3f, ray, continuing),
                dr.gather(mi.PreliminaryIntersection3f, hit, continuing),
                dr.gather(mi.Color3f, throughput, continuing),
            )
            dr.eval(path)
        return result

    @staticmethod
    def _interaction(path: _Path) -> mi.SurfaceInteraction3f:
        """Return the surface at path vertices, flipped towards the path if its material is opaque and one-sided."""
        si = path.hit.compute_surface_interaction(path.ray, mi.RayFlags.All)
        flags = si.bsdf().flags()
        behind = (si.wi.z < 0) & ~_has(flags, "BackSide", "Transmission")
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
        rough = _has(bsdf.flags(), "Smooth")
        towards, light = self.scene.sample_emitter_direction(si, point, False, rough)
        out = si.to_local(towards.d)
        value, density = bsdf.eval_pdf(context, si, out, rough & (towards.pdf > 0))
        weight = dr.select(towards.delta, 1, _power(towards.pdf, density))
        arrives = path.throughput * value * light * self.exposure * weight
        arrives = dr.select(rough & (towards.pdf > 0), arrives, 0)
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
        self, path: _Path, smooth: mi.Bool, numbers: _RandomNumbers, depth: int, result: mi.Color3f
    ) -> SplatHits | None:
        """Add the light of splats that paths hit."""
        if self.mirror is None:
            return None
        own = gathered(numbers, path.lane)
        key = own.key(depth)
        splat_hits = self.mirror.trace(path.ray, key, True)
        colour = mi.Color3f(*[srgb_to_linear(c) for c in splat_hits.colour])
        nearer = splat_hits.distance < path.hit.t
        if not self.bounce:
            colour = dr.select(smooth, 0, colour)
        colour = dr.select(nearer, colour * path.throughput, 0)
        dr.eval(splat_hits, colour, key, nearer)
        _add(result, path.lane, dr.select(splat_hits.relit, 0, colour))
        anew = dr.compress(nearer & splat_hits.relit)
        if dr.width(anew) and self.scene.emitters():
            ray, normal = dr.gather(mi.Ray3f, path.ray, anew), dr.gather(mi.Vector3f, splat_hits.normal, anew)
            place = ray(dr.gather(mi.Float, splat_hits.distance, anew))
            si = receiver(place, normal)
            numbers_here = gathered(own, anew)
            point = mi.Point2f(numbers_here.number_of(depth, 7), numbers_here.number_of(depth, 8))
            towards, light = self.scene.sample_emitter_direction(si, point, False)
            cosine = dr.maximum(dr.dot(normal, towards.d), 0)
            lit = dr.gather(mi.Color3f, colour, anew) * light * cosine / self.white
            infinite = _has_emitter_flag(towards.emitter, mi.EmitterFlags.Infinite)
            off = dr.gather(mi.Float, splat_hits.footprint, anew)
            shadow = mi.Ray3f(place + normal * off, towards.d)
            shadow.maxt = dr.select(infinite, dr.inf, dr.maximum(towards.dist * (1 - 1e-3) - off, 0))
            lane = dr.gather(mi.UInt32, path.lane, anew)
            self._add_unoccluded(result, lane, shadow, lit, dr.gather(mi.UInt32, key, anew))
        return splat_hits

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
        weight = dr.select(delta, 1, _power(density, chance))
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
        return self.pixel * 0x9E3779B1 + self.number * PER_VERTEX * 64 + self._dimension(depth, 9) + self.seed

    def number_of(self, depth: int, dimension: int) -> mi.Float:
        """Return a random number in [0, 1)."""
        if depth == 0 and dimension < len(R7):
            shift = mi.sample_tea_32(self.pixel, self.seed + self._dimension(0, dimension), ROUNDS)[0]
            return mi.Float((shift + self.number * R7[dimension]) >> 8) * 2.0**-24
        own = mi.sample_tea_32(self.pixel, self.number + self.seed, ROUNDS)[0]
        return mi.sample_tea_float32(own, self._dimension(depth, dimension), ROUNDS)

    @staticmethod
    def _dimension(depth: int, dimension: int) -> mi.UInt32:
        return dr.opaque(mi.UInt32, depth * PER_VERTEX + dimension)


def _has_emitter_flag(emitter: mi.EmitterPtr, flag: mi.EmitterFlags) -> mi.Bool:
    return (emitter.flags() & int(flag)) != 0


def _power(own: mi.Float, other: mi.Float) -> mi.Float:
    return dr.select(own > 0, dr.rcp(1 + dr.square(other / own)), 0)


def _add(total: mi.Color3f, lane: mi.UInt32, light: mi.Color3f) -> None:
    """Add ``light`` to the paths ``lane``, which must be distinct."""
    light = dr.gather(mi.Color3f, total, lane) + light
    dr.eval(light)
    dr.scatter(total, light, lane)
    dr.eval(total)
