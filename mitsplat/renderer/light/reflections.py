"""Reflection rays: light that surfaces, lamps and the sky send into the specular lobe of visible points.

Each ray samples the visible microfacet normals of the point. It ends at an emitter or at the nearest surface, whose
outgoing light is that of :class:`mitsplat.renderer.light.reflectors.Reflectors`. Light of emitters is weighted by the
power heuristic against the shadow rays, which sample the emitters (Veach 1997, section 9.2.4). The number of rays
follows the variance of the first rays, as for shadow rays.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.emitter_sampling import receiver
from mitsplat.renderer.light.light_tiles import STRIDE
from mitsplat.renderer.light.reflectors import LANES, Reflectors
from mitsplat.renderer.light.shadow_rays import ROBERTS, ShadowTracer, ray_origin, sequence_point
from mitsplat.renderer.materials.principled import power_weight, typical_brightness
from mitsplat.renderer.rays.device_arrays import gathered


@dataclass(frozen=True, eq=False)
class Reflections:
    """Sums over the reflection rays of every point, in units of the colour under the irradiance of white.

    Attributes:
        tinted: Light that the base colour multiplies (Color3f).
        colourless: Other light (Color3f).
        brightness: Sum of :func:`mitsplat.renderer.light.principled.typical_brightness` of all rays.
        squares: Sum of the squares of this brightness.
        rays: Number of rays.
    """

    tinted: mi.Color3f
    colourless: mi.Color3f
    brightness: mi.Float
    squares: mi.Float
    rays: mi.Float

    @classmethod
    def empty(cls, count: int) -> Reflections:
        """Return sums without rays at ``count`` points."""
        colours, numbers = ([dr.zeros(kind, count) for _ in range(n)] for kind, n in ((mi.Color3f, 2), (mi.Float, 3)))
        return cls(*colours, *numbers)

    def add(self, places: mi.UInt32, more: Reflections) -> None:
        """Add the sums ``more`` of distinct ``places`` in place."""
        for field in fields(self):
            total = getattr(self, field.name)
            value = dr.gather(type(total), total, places) + getattr(more, field.name)
            dr.eval(value)
            dr.scatter(total, value, places)
        dr.eval(self.tinted, self.colourless, self.brightness, self.squares, self.rays)


@dataclass(frozen=True, eq=False)
class ReflectionTracer:
    """Reflection rays from visible points.

    Attributes:
        scene: Mitsuba scene with the emitters.
        tracer: The points, and the emitters.
        reflectors: Surfaces that the rays hit.
        steps: First number in the sequence of the pixel, and the step to the next number, by point.
    """

    scene: mi.Scene
    tracer: ShadowTracer
    reflectors: Reflectors
    steps: tuple[mi.UInt32, mi.UInt32]

    def trace(self, places: mi.UInt32, done: mi.Float, rays: int) -> Reflections:
        """Trace ``rays`` rays from each of the points ``places``, which had ``done`` rays before."""
        count = dr.width(places)
        begin, step = (dr.gather(mi.UInt32, values, places) for values in self.steps)
        pixel = dr.gather(mi.UInt32, self.tracer.pixel, places)
        start = self.tracer.sequence_start(pixel) + (begin + mi.UInt32(done) * step) * STRIDE
        step *= STRIDE
        dr.eval(start, step)
        total = Reflections.empty(count)
        together = max(1, min(rays, LANES // count))
        for first in range(0, rays, together):
            some = min(together, rays - first)
            lane = dr.arange(mi.UInt32, count * some)
            row = lane // dr.opaque(mi.UInt32, some)
            number = dr.gather(mi.UInt32, start, row)
            number += (lane - row * some + dr.opaque(mi.UInt32, first)) * dr.gather(mi.UInt32, step, row)
            tinted, colourless = self._light(dr.gather(mi.UInt32, places, row), number)
            brightness = typical_brightness(tinted, colourless)
            more = Reflections(
                mi.Color3f(*[dr.block_sum(c, some) for c in tinted]),
                mi.Color3f(*[dr.block_sum(c, some) for c in colourless]),
                dr.block_sum(brightness, some),
                dr.block_sum(dr.square(brightness), some),
                dr.full(mi.Float, some, count),
            )
            total.add(dr.arange(mi.UInt32, count), more)
        return total

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
        dr.eval(ray, si, tint, white, density, active, number)
        light, ray.maxt = self.reflectors.outgoing(ray, number, sequence_point(number))
        dr.eval(light, ray)
        radiance, other = self.tracer.emitters.emission(self.scene, si, ray, active)
        light += radiance * (power_weight(density, other) * dr.pi / self.reflectors.white)
        tinted, colourless = light * tint, light * white
        dr.eval(tinted, colourless)
        return tinted, colourless
