"""Light without occluders at relit points and highlights, integrated over fixed directions without noise.

Shadow rays only estimate the share of it that arrives (Heitz, Hill and McGuire 2018, "Combining Analytic Direct
Illumination and Stochastic Shadows").
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.emitter_sampling import Emitters, receiver
from mitsplat.renderer.light.highlight import Lobe, mirrored_tent
from mitsplat.renderer.light.light_points import LightPoints
from mitsplat.renderer.light.lit_surface import LitSurface
from mitsplat.renderer.rays.device_arrays import gathered


@dataclass(frozen=True, eq=False)
class UnoccludedLight:
    """Light without occluders at points that are relit or have a highlight.

    Attributes:
        place: Places of these points among the traced pixels.
        irradiance: Irradiance (Color3f).
        mirrored: Mirrored radiance (Color3f).
        tent: Share of the captured colour that mirrors the light of the capture.
        level: Mean over channels of irradiance over white for relit points, otherwise 1, by traced pixel.
    """

    place: mi.UInt32
    irradiance: mi.Color3f | None
    mirrored: mi.Color3f | None
    tent: mi.Float | None
    level: mi.Float

    @classmethod
    def integrate(cls, emitters: Emitters, points: LightPoints, here: LitSurface, white: mi.Color3f) -> UnoccludedLight:
        """Integrate the light at those of the pixels ``here`` that are relit or have a highlight.

        E = integral of L(w) max(0, n.w) dw, and R = integral of L(w) f(w) max(0, n.w) dw with the lobe f, over all
        emitters. Both are means over the sample ``points`` of a pixel.
        """
        place = dr.compress(here.relit | (here.specular > 0))
        level = dr.full(mi.Float, 1, dr.width(here.relit))
        if not dr.width(place):
            return cls(place, None, None, None, level)
        irradiance, mirrored, tent = _mean_over_points(emitters, points, place)
        relit = dr.gather(mi.Bool, here.relit, place)
        dr.scatter(level, dr.sum(irradiance / white) / 3, place, relit)
        dr.eval(level)
        return cls(place, irradiance, mirrored, tent, level)


def _mean_over_points(
    emitters: Emitters, points: LightPoints, place: mi.UInt32
) -> tuple[mi.Color3f, mi.Color3f, mi.Float]:
    """Return unoccluded means over the points of pixels: irradiance, mirrored light, and mirrored tent."""
    rows = points.rows(place)
    own = gathered(points.surface, rows)
    dr.eval(own)
    count = dr.width(rows)
    columns: list[mi.Float | mi.Color3f] = [
        dr.zeros(mi.Color3f, count),
        dr.zeros(mi.Color3f, count),
        mirrored_tent(own),
    ]
    columns.append(dr.select(own.valid, mi.Float(1), 0))
    dr.eval(columns)
    for shiny in (False, True):
        which = dr.compress((own.specular > 0) == mi.Bool(shiny))
        if dr.width(which):
            some = gathered(own, which)
            dr.eval(some)
            found = emitters.open_light(
                receiver(some.position, some.normal), Lobe.of(some) if shiny else None, some.valid
            )
            dr.eval(found)
            for column, values in zip(columns, found, strict=False):
                dr.scatter(column, values, which)
    dr.eval(columns)
    means = []
    for column in columns:
        by_row = dr.zeros(type(column), dr.width(points.owner))
        dr.scatter(by_row, dr.select(own.valid, column, 0), rows)
        dr.eval(by_row)
        means.append(dr.gather(type(column), points.sum_by_pixel(by_row), place))
    *sums, count = means
    light, mirrored, tent = (total / dr.maximum(count, 1) for total in sums)
    dr.eval(light, mirrored, tent)
    return light, mirrored, tent
