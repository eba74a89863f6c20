"""Sums of traced light, and their means."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True, eq=False)
class Estimate:
    """Sums over the shadow rays of every point.

    Attributes:
        lit, base: Arriving light and reference light (Color3f).
        tinted, colourless: Arriving light in the specular lobe (Color3f): the part that the base colour multiplies, and
            the rest.
        squares: Sum of the squares of the terms of ``base``.
        mirrored_squares: Sum of the squares of the brightness of light in the specular lobe.
        rays: Number of rays.
    """

    lit: mi.Color3f
    base: mi.Color3f
    tinted: mi.Color3f
    colourless: mi.Color3f
    squares: mi.Float
    mirrored_squares: mi.Float
    rays: mi.Float

    @classmethod
    def empty(cls, count: int) -> Estimate:
        """Return an estimate without rays at ``count`` points."""
        colours, numbers = ([dr.zeros(kind, count) for _ in range(n)] for kind, n in ((mi.Color3f, 4), (mi.Float, 3)))
        return cls(*colours, *numbers)

    @property
    def sums(self) -> tuple[mi.Color3f, mi.Color3f, mi.Color3f, mi.Color3f, mi.Float, mi.Float]:
        """All fields except the number of rays."""
        return self.lit, self.base, self.tinted, self.colourless, self.squares, self.mirrored_squares

    def scattered(self, places: mi.UInt32, count: int) -> Estimate:
        """Return this estimate at ``places`` of ``count`` points, without rays at the others."""
        return Estimate.empty(count).updated(places, *self.sums, self.rays)

    def updated(self, places: mi.UInt32, *values: mi.Float | mi.Color3f) -> Estimate:
        """Write new values at some points in place and return the estimate."""
        dr.eval(values)  # avoids a copy of the source arrays before the write
        for old, new in zip((*self.sums, self.rays), values, strict=True):
            dr.scatter(old, new, places)
        dr.eval(self.sums, self.rays)
        return self


@dataclass(frozen=True, eq=False)
class LightMeans:
    """Means of light per ray, over the neighbours of every pixel.

    Attributes:
        lit, base: Arriving light and reference light (Color3f).
        bounced: Reflected light (Color3f) over the irradiance of white, or None.
    """

    lit: mi.Color3f
    base: mi.Color3f
    bounced: mi.Color3f | None
