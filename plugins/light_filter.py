"""Averages of traced light over neighbours on the same surface, and the error that they leave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.plugins.rays import View

RADIUS = 4
"""Of the filter [px]."""

NOISE_LIMIT = 2.0
"""Squared standard deviations within which two neighbours' shadows may be averaged."""

GUESS_WEIGHT = 1e-3
"""How much a point counts that is not known to lie on a surface, beside ones that are."""

SMALL = 64 / 9
"""Pixels of equal weight that have the noise of a mean over 3 x 3 with halves at the ends."""

GAIN = 3.0
"""By how much averaging over the filter's pixels, of which a penumbra leaves about half, divides the variance of a mean
over 3 x 3."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Sums over the shadow rays of every pixel.

    Attributes:
        lit, base: Light that arrives and light to compare with (Color3f).
        shine: Highlight (Color3f).
        squares: Sum of the squares of what is added to ``base``.
        rays: Number of rays.
    """

    lit: Any
    base: Any
    shine: Any
    squares: Any
    rays: Any

    @classmethod
    def nothing(cls, count: int) -> Estimate:
        """No rays yet at ``count`` pixels."""
        lit, base, shine = (dr.zeros(mi.Color3f, count) for _ in range(3))
        return cls(lit, base, shine, dr.zeros(mi.Float, count), dr.zeros(mi.Float, count))

    def updated(self, index: Any, *values: Any) -> Estimate:
        """The estimate with new values at some pixels."""
        for old, new in zip((self.lit, self.base, self.shine, self.squares, self.rays), values, strict=True):
            dr.scatter(old, new, index)
        dr.eval(self.lit, self.base, self.shine, self.squares, self.rays)
        return self


class LightFilter:
    """A separable filter that keeps edges, at those pixels of an image where light was traced.

    A neighbour counts where it belongs to the same ``group``, its normal agrees, it lies in the tangent plane, and its
    share of light differs by no more than noise explains, so that a hard shadow keeps its edge while a penumbra becomes
    smooth. A few rays per pixel say too little about that share; both are taken from 3 x 3 pixels. Their noise is that
    of as many binary draws as equal weights would need for the same variance (Kish 1965, section 11.7). Equal sums stay
    equal, so that the ratio of an unshadowed point is exactly 1.

    At a silhouette a pixel may show one thing and its ray meet the proxy of another. Such a point has its light from
    the known neighbours that show the same thing.
    """

    def __init__(self, surface: Any, group: Any, view: View, index: Any, traced: Any) -> None:
        """A filter at the pixels ``index``; ``traced`` says of every pixel whether it is among them."""
        self.surface, self.group, self.view, self.index, self.traced = surface, group, view, index, traced
        self.here = surface.at(index)
        self.own_group = dr.gather(mi.UInt32, group, index)
        dr.eval(surface.position, surface.normal, surface.known, self.here, self.own_group)

    def rays_for(self, estimate: Estimate, error: float) -> Any:
        """Rays per pixel of ``index`` after which the filtered share of light has a standard error of ``error``."""
        _, variance = self._share(estimate)
        return dr.gather(mi.Float, estimate.rays, self.index) * variance / (GAIN * error * error)

    def smooth(self, estimate: Estimate) -> tuple[Any, Any, Any]:
        """Light that arrives, light to compare with, and highlight (Color3f) per ray, at the pixels of ``index``."""
        share, variance = self._share(estimate)
        own_share, own_variance = share, variance
        share, variance = self._everywhere([share, variance])

        def alike(other: Any, same: Any) -> Any:
            noise = own_variance + dr.gather(mi.Float, variance, other, same)
            return dr.square(dr.gather(mi.Float, share, other, same) - own_share) <= NOISE_LIMIT * noise

        weight = dr.rcp(dr.maximum(estimate.rays, 1))
        values = [c * weight for colour in (estimate.lit, estimate.base, estimate.shine) for c in colour]
        dr.eval(values)
        values = self.average(values, estimate.rays, RADIUS, alike)
        return mi.Color3f(*values[:3]), mi.Color3f(*values[3:6]), mi.Color3f(*values[6:])

    def _share(self, estimate: Estimate) -> tuple[Any, Any]:
        """Share of light that arrives, over 3 x 3 pixels, and its variance."""
        weight = dr.rcp(dr.maximum(estimate.rays, 1))
        values = [dr.sum(estimate.lit) * weight, dr.sum(estimate.base) * weight, estimate.squares * weight]
        dr.eval(values)
        lit, base, squares = self.average(values, estimate.rays, 1)
        share = dr.select(base > 0, lit / base, 1)
        rays = SMALL * dr.gather(mi.Float, estimate.rays, self.index)
        draws = dr.maximum(rays * dr.square(base) / dr.maximum(squares, 1e-20), 1)
        likely = (share * draws + 0.5) / (draws + 1)
        variance = likely * (1 - likely) / draws
        dr.eval(share, variance)
        return share, variance

    def _everywhere(self, values: list[Any]) -> list[Any]:
        """Values at ``index`` as images."""
        images = [dr.zeros(mi.Float, dr.width(self.group)) for _ in values]
        for image, value in zip(images, values, strict=True):
            dr.scatter(image, value, self.index)
        dr.eval(images)
        return images

    def average(
        self, images: list[Any], rays: Any, radius: int, alike: Callable[[Any, Any], Any] = lambda _, same: same
    ) -> list[Any]:
        """Averages of images, weighted by their rays, at the pixels of ``index``."""
        steps = [s for r in range(1, radius + 1) for s in (-r, r)]
        across = self._everywhere(self._average_along(images, rays, [(s, 0) for s in steps], alike))
        averages = self._average_along(across, rays, [(0, s) for s in steps], alike)
        dr.eval(averages)
        return averages

    def _average_along(
        self, images: list[Any], rays: Any, steps: list[tuple[int, int]], alike: Callable[[Any, Any], Any]
    ) -> list[Any]:
        """Averages over the pixels that are ``steps`` (x, y) away, of which the last ones count half."""
        here, view = self.here, self.view
        x, y = mi.Int32(self.index % view.width), mi.Int32(self.index // view.width)
        radius = max(abs(sum(step)) for step in steps)
        own = [dr.gather(mi.Float, image, self.index) for image in images]
        weights = dr.gather(mi.Float, rays, self.index) * dr.select(here.known, 1, GUESS_WEIGHT)
        sums = [mi.Float(0) for _ in images]
        for step in steps:
            nx, ny, distance = x + step[0], y + step[1], abs(sum(step))
            inside = (nx >= 0) & (nx < view.width) & (ny >= 0) & (ny < view.height)
            other = mi.UInt32(ny * view.width + nx)
            inside &= dr.gather(mi.Bool, self.traced, other, inside)
            same = inside & (dr.gather(mi.UInt32, self.group, other, inside) == self.own_group)
            position = dr.gather(mi.Point3f, self.surface.position, other, same)
            normal = dr.gather(mi.Vector3f, self.surface.normal, other, same)
            plane = dr.abs(dr.dot(here.normal, position - here.position))
            known = dr.gather(mi.Bool, self.surface.known, other, same)
            near = (dr.dot(here.normal, normal) > 0.95) & (plane < here.offset * (8 * distance)) & alike(other, same)
            same &= (near & (known == here.known)) | (known & ~here.known)
            # Halves at the ends: the filter spans one period of the dither, not one pixel more.
            weight = dr.select(known, 1.0, GUESS_WEIGHT) * (0.5 if distance == radius else 1.0)
            weight = dr.select(same, weight * dr.gather(mi.Float, rays, other, same), 0)
            weights += weight
            # Differences from the middle, so that equal neighbours leave it bit for bit as it was.
            sums = [
                dr.fma(weight, dr.gather(mi.Float, image, other, same) - middle, total)
                for image, middle, total in zip(images, own, sums, strict=True)
            ]
        return [middle + total / weights for middle, total in zip(own, sums, strict=True)]
