"""Shadow rays from visible points to sampled emitters, and the low-discrepancy sequence that they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import Beam, Emitters, receiver
from mitsplat.renderer.light.light_estimate import Estimate
from mitsplat.renderer.light.light_filter import packed
from mitsplat.renderer.light.light_tiles import BLOCK, STRIDE, ShadowTiles, block_order, parity
from mitsplat.renderer.light.lit_surface import LitSurface
from mitsplat.renderer.materials.principled import power_weight, typical_brightness
from mitsplat.renderer.occluders.proxies import OccluderScene, Proxies
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered, opaque_seed, unit_float

ROBERTS = (3242174889, 2447445414)
"""Additive recurrence of the two-dimensional golden ratio in units of 2^-32 (Roberts 2018, "The unreasonable
effectiveness of quasirandom sequences"). The shadow search takes one point of it per pixel.
"""

RECURRENCE = (1996816038, 1246200886)
"""Additive recurrence of the shadow rays: a pixel takes every 64th point, and its 8 x 8 neighbours take the others.

Every 64th point of this recurrence is a point of Roberts' recurrence, in whose own order every 16th point is nearly the
same. There are 4096 recurrences of this kind; in this one consecutive points are farthest apart.
"""

SURROUNDINGS_RECURRENCE = (3070557862, 373785654)
"""Recurrence of this kind for the shadow rays of surroundings and visible meshes.

A straight edge hides a part of an emitter that gets a tenth to all of the rays. The error of the visible part, over 3 x
3 pixels and over rows and columns of 8 pixels, is 0.6 of that of independent rays, nearly the smallest of the 4096.
With the other recurrence, rows differ by more than noise, so that penumbras have combs. On objects, which also mirror
the emitters, the other recurrence is better.
"""

WORD_BITS = 32
"""Number of rays whose occlusion is stored as bits of one integer."""


@dataclass(frozen=True, eq=False)
class ShadowTracer:
    """Shadow rays from visible points.

    Attributes:
        emitters: Emitters of the scene.
        proxies: Occluders.
        surface: The points.
        pixel: Number of the image's pixel of each point.
        view: Camera.
        seed: Offset into the sequence.
        lattice: True for traced pixels of coarse tiles, by pixel of the image; None if there are no coarse tiles.
    """

    emitters: Emitters
    proxies: Proxies
    surface: LitSurface
    pixel: mi.UInt32
    view: CameraView
    seed: int
    lattice: mi.Bool | None = None

    def search(self, captured: mi.Bool) -> ShadowTiles:
        """Estimate by tiles the light that dynamic objects occlude, with one ray per captured point of all pixels.

        The four blocks of a 2 x 2 group have different points; otherwise a shadow too small for the points of one block
        would be missed in all of them. The light without dynamic objects is only a divisor, for which a quarter of the
        rays is sufficient. The other rays test static occluders only if a dynamic object occludes them as well.
        """
        proxies, width, watertight = self.proxies, self.view.width, self.emitters.any_without_extent
        pixel, inside = block_order(self.view)
        origin, normal, offset, instance = _packed_rays(self.surface, captured, pixel)
        x, y = pixel % width, pixel // width
        number = self.sequence_start(pixel) + parity(x // BLOCK, y // BLOCK) * STRIDE
        active = inside & (offset > 0)
        beam = self.emitters.sample(receiver(origin, normal), sequence_point(number, ROBERTS), active)
        ray, key = _shadow_ray(origin, beam, offset), pixel * RECURRENCE[0] + number
        active &= dr.sum(beam.irradiance) > 0
        blocked, counts, share = mi.Bool(False), active, 1
        for occluder_scene in proxies.shadow_casters:
            blocked |= occluder_scene.occluded(ray, instance, key, active & ~blocked, watertight=watertight)
            if proxies.separate_kernels:
                dr.eval(blocked)
        if proxies.static is not None:
            one_of_four = ((x | y) & 1) == 0
            tested = active & (blocked | one_of_four)
            stopped = proxies.static.occluded(ray, instance, key, tested, watertight=watertight)
            blocked &= ~stopped
            counts, share = active & one_of_four & ~stopped, 4
        arriving = dr.select(counts, beam.irradiance * share, 0)
        lost = dr.select(blocked, beam.irradiance, 0)
        dr.eval(arriving, lost)
        return ShadowTiles.of(arriving, lost, self.view)

    def trace(
        self,
        places: mi.UInt32,
        before: Estimate,
        rays: mi.UInt32,
        most: int,
        steps: tuple[mi.UInt32, mi.UInt32],
        *,
        matt: bool = False,
    ) -> Estimate:
        """Add ``rays`` more rays to an estimate at ``places``.

        Args:
            places: Indices of the points.
            before: Estimate so far.
            rays: Number of additional rays per point.
            most: Upper limit of ``rays``.
            steps: First number in the sequence of the pixel, and the step to the next number, by point.
            matt: True if no point mirrors light, so that the sums of the specular lobe are skipped.
        """
        separate_kernels = self.proxies.separate_kernels
        if separate_kernels and most > WORD_BITS:
            for begin in range(0, most, WORD_BITS):
                # As a literal, the start of each part would need a kernel of its own.
                done = dr.opaque(mi.UInt32, begin)
                part = dr.minimum(dr.maximum(rays, done) - done, WORD_BITS)
                before = self.trace(places, before, part, min(WORD_BITS, most - begin), steps, matt=matt)
            return before
        batch = _RayBatch.of(self, places, before, steps)
        known: list[mi.UInt32] = []
        if separate_kernels:  # one bit per ray and scene except the last, one kernel each
            for occluder_scene in self.proxies.occluder_scenes[:-1]:
                known.append(batch.occlusion_bits(occluder_scene, rays, known))
        sums = batch.add_light([dr.gather(type(v), v, places) for v in before.sums], rays, known, matt)
        return before.updated(places, *sums, dr.gather(mi.Float, before.rays, places) + mi.Float(rays))

    def sequence_start(self, pixel: mi.UInt32) -> mi.UInt32:
        """Return the number of the first point of pixels in the sequence."""
        x, y = pixel % self.view.width, pixel // self.view.width
        if self.lattice is not None:
            # Traced neighbours are two pixels apart there.
            shift = dr.select(dr.gather(mi.Bool, self.lattice, pixel), mi.UInt32(1), 0)
            x, y = x >> shift, y >> shift
        return self.start_at(x, y)

    def start_at(self, x: mi.UInt32, y: mi.UInt32) -> mi.UInt32:
        """Return the number of the first point of the elements of a grid: neighbours take distant points."""
        return opaque_seed(self.seed) + _bayer(x, y)


@dataclass(frozen=True, eq=False)
class _RayBatch:
    """Shadow rays from some points: ray i of a point takes point ``start + i * step`` of the sequence.

    Attributes:
        tracer: Emitters and occluders.
        surface, pixel: The points and their pixels.
        origin: Ray origins [m].
        start, step: Numbers in the sequence, by point.
    """

    tracer: ShadowTracer
    surface: LitSurface
    pixel: mi.UInt32
    origin: mi.Vector3f
    start: mi.UInt32
    step: mi.UInt32

    @classmethod
    def of(
        cls, tracer: ShadowTracer, places: mi.UInt32, before: Estimate, steps: tuple[mi.UInt32, mi.UInt32]
    ) -> _RayBatch:
        """Create the rays that follow those of an estimate."""
        surface = gathered(tracer.surface, places)
        pixel = dr.gather(mi.UInt32, tracer.pixel, places)
        begin, step = steps
        done = mi.UInt32(dr.gather(mi.Float, before.rays, places))
        start = tracer.sequence_start(pixel) + (begin + done * step) * STRIDE
        return cls(tracer, surface, pixel, ray_origin(surface), start, step * STRIDE)

    def sample(self, i: mi.UInt32) -> tuple[Beam, mi.UInt32, mi.Bool]:
        """Sample ray ``i`` of every point: its beam, its number in the sequence, and True if it carries light."""
        surface, number = self.surface, self.start + i * self.step
        point = dr.select(surface.instance > 0, sequence_point(number), sequence_point(number, SURROUNDINGS_RECURRENCE))
        beam = self.tracer.emitters.sample(receiver(surface.position, surface.normal), point, surface.valid)
        return beam, number, surface.valid & (dr.sum(beam.irradiance) > 0)

    def occluded(self, occluder_scene: OccluderScene, beam: Beam, number: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Return True for rays that a scene occludes."""
        ray = _shadow_ray(self.origin, beam, self.surface.offset)
        key, watertight = self.pixel * RECURRENCE[0] + number, self.tracer.emitters.any_without_extent
        return occluder_scene.occluded(ray, self.surface.instance, key, active, watertight=watertight)

    def occlusion_bits(self, occluder_scene: OccluderScene, rays: mi.UInt32, known: Sequence[mi.UInt32]) -> mi.UInt32:
        """Return the rays that a scene occludes and the scenes of ``known`` do not, as bits of an integer per point."""

        def add_bit(i: mi.UInt32, word: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
            beam, number, free = self.sample(i)
            for occluded in _bits(known, i):
                free = free & ~occluded
            return i + 1, word | dr.select(self.occluded(occluder_scene, beam, number, free), mi.UInt32(1) << i, 0)

        nothing = dr.zeros(mi.UInt32, dr.width(self.pixel))
        _, word = dr.while_loop((nothing, mi.UInt32(nothing)), lambda i, _: i < rays, add_bit, label="stopped")
        dr.eval(word)
        return word

    def add_light(
        self, sums: list[mi.Float | mi.Color3f], rays: mi.UInt32, known: Sequence[mi.UInt32], matt: bool
    ) -> list[mi.Float | mi.Color3f]:
        """Add the light of rays to the sums of an :class:`Estimate`.

        With the unoccluded estimate e = L(w) max(0, n.w) / p(w) of a ray (Veach 1997, section 2.4.2), visibility V
        past all occluders and V_0 past static occluders, a point adds V e to ``lit`` and V_0 e to ``base`` if its
        captured colours contain shadows, or e if it is relit. ``known`` holds the occlusion of the first scenes as
        bits; the other scenes are traced here. Light in the specular lobe is weighted by the power heuristic against
        the reflection rays of :mod:`mitsplat.renderer.light.reflections`.
        """
        proxies, surface, lobe = self.tracer.proxies, self.surface, self.surface.lobe

        def add(
            i: mi.UInt32,
            lit: mi.Color3f,
            base: mi.Color3f,
            tinted: mi.Color3f,
            colourless: mi.Color3f,
            squares: mi.Float,
            mirrored_squares: mi.Float,
        ) -> tuple[mi.UInt32, mi.Color3f, mi.Color3f, mi.Color3f, mi.Color3f, mi.Float, mi.Float]:
            beam, number, active = self.sample(i)
            occluded = _bits(known, i)
            static_light = free = active
            for each, occluder_scene in enumerate(proxies.occluder_scenes):
                if each < len(occluded):
                    free = free & ~occluded[each]
                else:
                    free = free & ~self.occluded(occluder_scene, beam, number, free)
                if occluder_scene is proxies.static:
                    static_light = free
            light, unshadowed = (dr.select(where, beam.irradiance, 0) for where in (free, static_light))
            compared = dr.select(surface.relit, dr.select(active, beam.irradiance, 0), unshadowed)
            lit += light
            base += compared
            if not matt:
                value, density, cos_half = lobe.evaluate(beam.direction)
                cosine = dr.dot(surface.normal, beam.direction)
                mirrored = light * (value * power_weight(beam.density, density) / dr.maximum(cosine, 1e-6))
                fresnel = lobe.fresnel(cos_half)
                tinted += mirrored * fresnel.tint
                colourless += mirrored * fresnel.white
                mirrored_squares += dr.square(typical_brightness(mirrored * fresnel.tint, mirrored * fresnel.white))
            squares += dr.square(dr.sum(compared))
            return i + 1, lit, base, tinted, colourless, squares, mirrored_squares

        state = dr.zeros(mi.UInt32, dr.width(self.pixel)), *sums
        _, *sums = dr.while_loop(state, lambda i, *_: i < rays, add, label="light")
        return sums


def _bits(words: Sequence[mi.UInt32], i: mi.UInt32) -> list[mi.Bool]:
    """Return bit ``i`` (Bool) of words."""
    return [(word >> i & 1) != 0 for word in words]


def ray_origin(surface: LitSurface) -> mi.Vector3f:
    """Return the origins of shadow rays: on the smooth surface of the proxy, and off the triangle itself."""
    return surface.position + surface.lift + surface.face * surface.offset


def _packed_rays(
    surface: LitSurface, selected: mi.Bool, pixel: mi.UInt32
) -> tuple[mi.Point3f, mi.Vector3f, mi.Float, mi.Float]:
    """Return ray origins, normals, offsets and instances of pixels in any order, given the points of all pixels.

    The offset is 0 where ``selected`` is False. The values are packed, because separate fetches take half of the
    time.
    """
    offset = dr.select(selected, surface.offset, 0)
    rows = packed([*ray_origin(surface), *surface.normal, offset, surface.instance])
    row = dr.gather(mi.ArrayXf, rows, pixel, shape=(8, dr.width(pixel)))
    return mi.Point3f(*row[:3]), mi.Vector3f(*row[3:6]), row[6], row[7]


def _shadow_ray(origin: mi.Vector3f, beam: Beam, offset: mi.Float) -> mi.Ray3f:
    ray = mi.Ray3f(origin, beam.direction)
    ray.maxt = dr.maximum(beam.reach - 2 * offset, 0)
    return ray


def sequence_point(i: mi.UInt32, recurrence: tuple[int, int] = RECURRENCE) -> mi.Point2f:
    """Return point ``i`` of a low-discrepancy sequence with 24 bits of precision for every ``i``."""
    return mi.Point2f(*[unit_float(i * step) for step in recurrence])


def _bayer(x: mi.UInt32, y: mi.UInt32) -> mi.UInt32:
    """Return the rank of a pixel in an 8 x 8 ordered-dither matrix: neighbours take distant points of the sequence."""
    result = mi.UInt32(0)
    for bit in range(3):
        a, b = (x >> bit) & 1, (y >> bit) & 1
        result |= ((a ^ b) << (5 - 2 * bit)) | (b << (4 - 2 * bit))
    return result
