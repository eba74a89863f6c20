"""Irradiance without occluders at relit points, integrated over fixed directions without noise.

Shadow rays only estimate the share of it that arrives (Heitz, Hill and McGuire 2018, "Combining Analytic Direct
Illumination and Stochastic Shadows").
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import Emitters, receiver
from mitsplat.renderer.light.light_points import LightPoints
from mitsplat.renderer.light.lit_surface import LitSurface
from mitsplat.renderer.rays.device_arrays import gathered


@dataclass(frozen=True, eq=False)
class UnoccludedLight:
    """Light without occluders at relit points that reflect diffuse light.

    Attributes:
        place: Places of these points among the traced pixels.
        irradiance: Irradiance (Color3f); None if there are none.
        level: Mean over channels of irradiance over white for these points, its mean over orientations at the
            reference point for other relit points, and otherwise 1, by traced pixel.
    """

    place: mi.UInt32
    irradiance: mi.Color3f | None
    level: mi.Float

    @classmethod
    def integrate(cls, emitters: Emitters, points: LightPoints, here: LitSurface, white: mi.Color3f) -> UnoccludedLight:
        """Integrate the light at those of the pixels ``here`` that are relit and no pure metals.

        E = integral of L(w) max(0, n.w) dw over all emitters, a mean over the sample ``points`` of a pixel.
        """
        place = dr.compress(here.relit & here.diffuse)
        # Of pure metals, the light matters only for the metering and for the number of rays.
        usual = emitters.fluence / (4 * dr.mean(white))
        level = dr.select(here.relit, usual, mi.Float(1))
        dr.eval(level)
        if not dr.width(place):
            return cls(place, None, level)
        rows = points.rows(place)
        own = gathered(points.surface, rows)
        dr.eval(own)
        light = emitters.unoccluded_irradiance(receiver(own.position, own.normal), own.valid)
        irradiance = points.mean_by_pixel(light, rows, own.valid, place)
        dr.scatter(level, dr.sum(irradiance / white) / 3, place)
        dr.eval(level)
        return cls(place, irradiance, level)
