"""Reflection rays: light that surfaces, lamps and the sky send into the specular lobe of visible points.

Each ray samples the visible microfacet normals of the point. It ends at an emitter or at the nearest surface, whose
outgoing light is that of :class:`mitsplat.renderer.interreflection.reflectors.Reflectors`. Light of emitters is
weighted by the power heuristic against the shadow rays, which sample the emitters (Veach 1997, section 9.2.4). The
number of rays follows the variance of the first rays, as for shadow rays.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import receiver
from mitsplat.renderer.interreflection.reflectors import LANES, Reflectors
from mitsplat.renderer.light.light_filter import Guide, LightFilter, packed
from mitsplat.renderer.light.shadow_rays import ROBERTS, ShadowTracer, ray_origin, sequence_point
from mitsplat.renderer.materials.principled import power_weight, typical_brightness
from mitsplat.renderer.rays.device_arrays import concatenated, gathered, opaque_seed

RAY_STEP, COLUMN_STEP, ROW_STEP = 3484022021, 2665396185, 3590773907
"""Steps in Roberts' sequence to the next ray of a pixel, to the pixel on its right, and to the pixel below.

On a cylinder, only pixels along its axis mirror similar directions. Their average is even only if the points of each
row and of each column are. The ordered dither of the shadow rays has uneven columns, which show as stripes. A search
over random steps found these. The distance between points of eight rays, of eight pixels of a row, column or diagonal,
of 8 x 8 pixels, and of eight rays of eight such pixels is at least 0.43 of the largest possible distance. Among such
steps, these have little noise and bias on a metal ball under uniform light.
"""

FEW_PIXELS = 30.0
"""Effective number of averaged pixels below which the average is widened as far as noise explains differences."""


@dataclass(frozen=True, eq=False)
class Reflections:
    """Sums over the reflection rays of every point, in units of the colour under the irradiance of white.

    Attributes:
        tinted: Light that the base colour multiplies (Color3f).
        colourless: Other light (Color3f).
        squares: Sum of the squares of :func:`mitsplat.renderer.materials.principled.typical_brightness` of all rays.
        rays: Number of rays.
    """

    tinted: mi.Color3f
    colourless: mi.Color3f
    squares: mi.Float
    rays: mi.Float

    @classmethod
    def empty(cls, count: int) -> Reflections:
        """Return sums without rays at ``count`` points."""
        return cls(*[dr.zeros(kind, count) for kind in (mi.Color3f, mi.Color3f, mi.Float, mi.Float)])

    @property
    def variance(self) -> mi.Float:
        """Variance of the mean brightness of the rays."""
        rays = dr.maximum(self.rays, 1)
        mean = typical_brightness(self.tinted, self.colourless) / rays
        return dr.maximum(self.squares / rays - dr.square(mean), 0) / dr.maximum(rays - 1, 1)

    def of_valid(self, share: mi.Float) -> Reflections:
        """Return the sums with the number of rays that started at a surface, a ``share`` of all (at least one)."""
        return replace(self, rays=dr.maximum(self.rays * share, 1))

    def add(self, places: mi.UInt32, more: Reflections) -> None:
        """Add the sums ``more`` of distinct ``places`` in place."""
        for field in fields(self):
            total = getattr(self, field.name)
            value = dr.gather(type(total), total, places) + getattr(more, field.name)
            dr.eval(value)
            dr.scatter(total, value, places)
        dr.eval(self.tinted, self.colourless, self.squares, self.rays)


@dataclass(frozen=True, eq=False)
class ReflectionTracer:
    """Reflection rays from visible points.

    Attributes:
        tracer: The points, and the emitters.
        reflectors: Surfaces that the rays hit.
        steps: First number in the sequence of the pixel, and the step to the next number, by point.
    """

    tracer: ShadowTracer
    reflectors: Reflectors
    steps: tuple[mi.UInt32, mi.UInt32]

    def trace(self, places: mi.UInt32, done: mi.Float, rays: mi.UInt32) -> Reflections:
        """Trace ``rays`` (at least one) from each of the points ``places``, which had ``done`` rays before."""
        count = dr.width(places)
        first = dr.prefix_sum(rays)
        dr.eval(first, rays)
        lanes = first[count - 1] + rays[count - 1]
        if lanes > LANES and count > 1:
            halves = dr.arange(mi.UInt32, count // 2), dr.arange(mi.UInt32, count - count // 2) + count // 2
            parts = [self.trace(*(dr.gather(type(v), v, half) for v in (places, done, rays))) for half in halves]
            return Reflections(*[concatenated([getattr(p, f.name) for p in parts]) for f in fields(Reflections)])
        # The lanes of a point are adjacent: marks at the first lanes, summed up, are the numbers of the points.
        marks = dr.zeros(mi.UInt32, lanes)
        dr.scatter(marks, mi.UInt32(1), first, first > 0)
        row = dr.cumsum(marks)
        begin, step = (dr.gather(mi.UInt32, values, places) for values in self.steps)
        start = self._sequence_start(dr.gather(mi.UInt32, self.tracer.pixel, places))
        dr.eval(row, begin, step, start)
        number = dr.arange(mi.UInt32, lanes) - dr.gather(mi.UInt32, first, row)
        number += mi.UInt32(dr.gather(mi.Float, done, row))
        number = dr.gather(mi.UInt32, begin, row) + number * dr.gather(mi.UInt32, step, row)
        number = dr.gather(mi.UInt32, start, row) + number * RAY_STEP
        tinted, colourless = self._light(dr.gather(mi.UInt32, places, row), number)
        light = packed([*tinted, *colourless, typical_brightness(tinted, colourless)])

        def add(i: mi.UInt32, total: mi.ArrayXf, squares: mi.Float) -> tuple[mi.UInt32, mi.ArrayXf, mi.Float]:
            own = dr.gather(mi.ArrayXf, light, first + i, shape=(8, count))
            return i + 1, total + own, dr.fma(own[6], own[6], squares)

        state = dr.zeros(mi.UInt32, count), dr.zeros(mi.ArrayXf, (8, count)), dr.zeros(mi.Float, count)
        _, total, squares = dr.while_loop(state, lambda i, *_: i < rays, add, label="sum of reflections")
        sums = mi.Color3f(*total[0:3]), mi.Color3f(*total[3:6]), squares, mi.Float(rays)
        dr.eval(sums)
        return Reflections(*sums)

    def _sequence_start(self, pixel: mi.UInt32) -> mi.UInt32:
        """Return the number of the first point of pixels in Roberts' sequence."""
        width = self.tracer.view.width
        return opaque_seed(self.tracer.seed) + pixel % width * COLUMN_STEP + pixel // width * ROW_STEP

    def _light(self, places: mi.UInt32, number: mi.UInt32) -> tuple[mi.Color3f, mi.Color3f]:
        """Return the tinted and the colourless light of one ray per lane; each scene has a kernel of its own."""
        surface = gathered(self.tracer.surface, places)
        lobe = surface.lobe
        direction, weight, cos_half = lobe.sample(sequence_point(number, ROBERTS))
        fresnel = lobe.fresnel(cos_half)
        tint, white = (dr.select(surface.valid, weight * share, 0) for share in (fresnel.tint, fresnel.white))
        density = lobe.evaluate(direction)[1]
        # The smooth normal may send a ray below the triangle.
        below = dr.minimum(dr.dot(direction, surface.face), 0)
        ray = mi.Ray3f(mi.Point3f(ray_origin(surface)), direction - 2 * below * surface.face)
        si = receiver(surface.position, surface.normal)
        active = (tint > 0) | (white > 0)
        dr.eval(ray, si, tint, white, density, active, number, lobe.blur)
        # Few neighbours mirror similar directions, so that random numbers leave the least structure.
        key = mi.sample_tea_32(number, mi.UInt32(0), 4)[0]
        light, ray.maxt = self.reflectors.outgoing(ray, key, sequence_point(number), lobe.blur)
        dr.eval(light, ray)
        radiance, other = self.tracer.emitters.emission(self.reflectors.scene, si, ray, active)
        light += radiance * (power_weight(density, other) * dr.pi / self.reflectors.white)
        tinted, colourless = light * tint, light * white
        dr.eval(tinted, colourless)
        return tinted, colourless


def averaged_reflections(
    light_filter: LightFilter, tinted: mi.Color3f, colourless: mi.Color3f, variance: mi.Float, mirrored: mi.Vector3f
) -> tuple[mi.Color3f, mi.Color3f]:
    """Average reflected light over neighbours.

    On a cylinder, only pixels along its axis mirror similar directions, and those of an edge differ from all others.
    Their noise would show as streaks and dashes. These pixels are averaged once more with neighbours that mirror other
    directions, if noise explains the difference (Rousselle et al. 2013, "Robust Denoising using Feature and Color
    Information", section 3).

    Args:
        light_filter: Filter over the pixels.
        tinted: Light per ray that the base colour multiplies (Color3f).
        colourless: Other light per ray (Color3f).
        variance: Variance of the brightness of the reflection rays. That of light in the lobe that shadow rays find is
            missing: pixels that mirror a lamp are averaged less.
        mirrored: Mean of the directions that a pixel mirrors.
    """
    dr.eval(tinted, colourless, variance)
    (variance,) = light_filter.average([variance], 1)  # a few rays often have no variance by chance
    means, shared = light_filter.mirror([*tinted, *colourless], mirrored)
    few = dr.compress(shared < FEW_PIXELS)
    if dr.width(few):
        own, some = gathered(light_filter.here, few), [dr.gather(mi.Float, mean, few) for mean in means]
        brightness = typical_brightness(mi.Color3f(*some[:3]), mi.Color3f(*some[3:]))
        guide = Guide(brightness, dr.gather(mi.Float, variance / shared, few))
        towards, pixels = dr.gather(mi.Vector3f, mirrored, few), dr.gather(mi.UInt32, light_filter.index, few)
        dr.eval(own, some, *guide, towards, pixels)
        wide, _ = LightFilter(own, light_filter.view, pixels).mirror(some, towards, guide=guide)
        dr.eval(means, wide)
        for mean, value in zip(means, wide, strict=True):
            dr.scatter(mean, value, few)
    return mi.Color3f(*means[:3]), mi.Color3f(*means[3:])
