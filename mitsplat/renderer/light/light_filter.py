"""Averages of traced light over neighbours on the same surface, and the error that they leave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.rays.camera_rays import CameraView

RADIUS = 4
"""Of the filter [px]."""

NOISE_LIMIT = 4.0
"""Squared standard deviations within which two neighbours' shadows may be averaged."""

GUESS_WEIGHT = 1e-3
"""How much a point counts that is not known to lie on a surface, beside ones that are."""

SMALL = 64 / 9
"""Pixels of equal weight that have the noise of a mean over 3 x 3 with halves at the ends."""

GAIN = 10.0
"""By how much the filter, and rays that are spread more evenly than by chance, divide the variance of a mean over 3 x 3
pixels. With this, ``python -m benchmarks.light.traced`` finds six tenths of a wanted error of 0.03 over all shadows."""

HALF = 0.5
"""Light, as a share of white, at which a wanted error is the standard error that is wanted of it."""

DARKEST = 0.05
"""Light below which none is looked at more closely."""

DISPLAY = 1 / 2.2
"""Exponent that displayed light has, of which the eye and a file see even steps."""

BRIGHTEST, DIMMEST = 64.0, 1 / 64
"""What a camera that exposes by itself multiplies light by at the most and the least."""

_STEPS = 4096
"""Of displayed light, sums of which do not depend on the number of threads."""

NOWHERE = 0xFFFFFFFF
"""Place of a pixel at which no light was traced."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Sums over the shadow rays of every point.

    Attributes:
        lit, base: Light that arrives and light to compare with (Color3f).
        shine, glare: Light that is mirrored towards the camera, sum of its channels, and the same of all that is sent.
        squares: Sum of the squares of what is added to ``base``.
        rays: Number of rays.
    """

    lit: Any
    base: Any
    shine: Any
    glare: Any
    squares: Any
    rays: Any

    @classmethod
    def nothing(cls, count: int) -> Estimate:
        """No rays yet at ``count`` points."""
        colours, numbers = ([dr.zeros(kind, count) for _ in range(n)] for kind, n in ((mi.Color3f, 2), (mi.Float, 4)))
        return cls(*colours, *numbers)

    @property
    def sums(self) -> tuple[Any, ...]:
        """All but the number of rays."""
        return self.lit, self.base, self.shine, self.glare, self.squares

    def moved(self, places: Any, count: int) -> Estimate:
        """The same at ``places`` of ``count`` points, with no rays yet at the others."""
        return Estimate.nothing(count).updated(places, *self.sums, self.rays)

    def updated(self, places: Any, *values: Any) -> Estimate:
        """The estimate with new values at some points."""
        dr.eval(values)  # else what they were made from would be copied before it is written to
        for old, new in zip((*self.sums, self.rays), values, strict=True):
            dr.scatter(old, new, places)
        dr.eval(self.sums, self.rays)
        return self


class LightFilter:
    """A separable filter that keeps edges, at those pixels of an image where light was traced.

    A neighbour counts where it belongs to the same instance, its normal agrees, it lies in the tangent plane, and its
    share of light differs by no more than noise explains, so that a hard shadow keeps its edge while a penumbra becomes
    smooth. A few rays per pixel say too little about that share; both are taken from 3 x 3 pixels. Their noise is that
    of as many binary draws as equal weights would need for the same variance (Kish 1965, section 11.7). Equal sums stay
    equal, so that the ratio of an unshadowed point is exactly 1.

    At a silhouette a pixel may show one thing and its ray meet the proxy of another. Such a point has its light from
    the known neighbours that show the same thing.
    """

    def __init__(self, here: Any, view: CameraView, index: Any, coarse: Any = None, stride: int = 1) -> None:
        """A filter at the pixels ``index`` of an image, which show the points ``here``.

        Neighbours are ``stride`` pixels apart. Where ``coarse`` is true of a pixel of the image, its neighbours are two
        pixels apart, and it stands for four.
        """
        self.view, self.index, self.here = view, index, here
        self.stride = mi.Int32(stride)
        if coarse is not None:
            self.stride = dr.select(dr.gather(mi.Bool, coarse, index), mi.Int32(2), 1)
        # What is gathered from neighbours lies together, and holds no more than the pixels in question.
        self.place = dr.full(mi.UInt32, NOWHERE, view.width * view.height)
        dr.scatter(self.place, dr.arange(mi.UInt32, dr.width(index)), index)
        dr.eval(self.place)
        # Whom neighbours see at a pixel: without those that stand for others, every other column would see fewer.
        self.shown = self.place
        if coarse is not None:
            pixel = dr.arange(mi.UInt32, view.width * view.height)
            x, y = pixel % view.width, pixel // view.width
            stands = (y - (y & 1)) * view.width + x - (x & 1)
            self.shown = dr.select(coarse, dr.gather(mi.UInt32, self.place, stands, coarse), self.place)
            dr.eval(self.shown)

    def rays_for(self, estimate: Estimate, error: float, unshadowed: Any, metered: int = 0) -> Any:
        """Rays per pixel of ``index`` after which light errs no more to the eye than by ``error`` at half of white.

        Elsewhere the standard error may be as many steps of the display: less in the dark, more where it is bright.

        Args:
            estimate: From the rays so far.
            error: Standard error of light that is HALF.
            unshadowed: Light without occluders at each pixel, of which rays say what share arrives; 1 is white.
            metered: Pixels of a picture that is exposed so that the mean of it looks HALF, those without a place here
                being lit by 1; 0 if it is exposed for white.
        """
        share, variance, shared = self._share(estimate)
        # Where few of 3 x 3 pixels are alike, as good as none of those farther away are.
        gain = dr.fma(GAIN - 1, dr.square((shared - 1) / (SMALL - 1)), 1)
        light = unshadowed * share
        if metered:
            exposure = _metered(light, self.stride * self.stride, metered)
            light, unshadowed = light * exposure, unshadowed * exposure
        # What a step of the display is of the share that arrives, for one of light that is HALF.
        allowed = error * dr.power(dr.clip(light, DARKEST, 1) / HALF, 1 - DISPLAY)
        return estimate.rays * variance * dr.square(unshadowed / allowed) / gain

    def smooth(self, estimate: Estimate, beside: tuple[Any, Any] | None = None) -> tuple[Any, Any, Any, Any, Any]:
        """The first four sums of the estimate per ray, averaged over neighbours, at the pixels of ``index``.

        And so other light ``beside`` it (Color3f), from where it is known (1, else 0); 0 where no neighbour knows it.
        """
        weight = dr.rcp(dr.maximum(estimate.rays, 1))
        values = [c * weight for c in (*estimate.lit, *estimate.base, estimate.shine, estimate.glare)]
        if beside is not None:
            values += [*beside[0], beside[1]]
        values, _ = self._average(values, estimate.rays, RADIUS, self._share(estimate)[:2])
        other = None
        if beside is not None:
            *colour, share = values[8:]
            other = dr.select(share > 1e-6, mi.Color3f(*colour) / share, 0)
        return mi.Color3f(*values[:3]), mi.Color3f(*values[3:6]), values[6], values[7], other

    def _share(self, estimate: Estimate) -> tuple[Any, Any, Any]:
        """Share of light that arrives, over 3 x 3 pixels, its variance, and of how many pixels' rays that is."""
        weight = dr.rcp(dr.maximum(estimate.rays, 1))
        values = [dr.sum(estimate.lit) * weight, dr.sum(estimate.base) * weight, estimate.squares * weight]
        (lit, base, squares), shared = self._average(values, estimate.rays, 1)
        share = dr.select(base > 0, lit / base, 1)
        draws = dr.maximum(shared * estimate.rays * dr.square(base) / dr.maximum(squares, 1e-20), 1)
        likely = (share * draws + 0.5) / (draws + 1)
        variance = likely * (1 - likely) / draws
        dr.eval(share, variance)
        return share, variance, shared

    def average(self, values: list[Any]) -> list[Any]:
        """Averages at the pixels of ``index`` of values there, all of as many rays."""
        return self._average(values, dr.full(mi.Float, 1, dr.width(self.index)), RADIUS)[0]

    def _average(
        self, values: list[Any], rays: Any, radius: int, share: tuple[Any, Any] | None = None
    ) -> tuple[list[Any], Any]:
        """The same, and of how many pixels of equal weight and as many rays an average has the noise.

        Given a ``share`` of light and its variance, only those neighbours count whose share noise explains.
        """
        here = self.here
        known = dr.select(here.known, mi.Float(1), 0)
        traits = packed([*here.position, *here.normal, here.trait, known, rays, *(share or (0, 0))])
        alike = mi.Float(1)
        for direction in ((1, 0), (0, 1)):
            values, along = self._average_along(values, traits, direction, radius, share)
            alike *= along
            dr.eval(values, alike)
        return values, alike

    def _average_along(
        self, values: list[Any], traits: Any, direction: tuple[int, int], radius: int, share: tuple[Any, Any] | None
    ) -> tuple[list[Any], Any]:
        """Averages over the pixels up to ``radius`` away along a direction (x, y), of which the last ones count half.

        A loop that is traced once, because a step takes the host as long as the device.
        """
        here, view, width = self.here, self.view, dr.width(self.index)
        x, y = mi.Int32(self.index % view.width), mi.Int32(self.index // view.width)
        along_x, along_y = (dr.opaque(mi.Int32, step) * self.stride for step in direction)
        images = packed(values)
        own_rays = dr.gather(mi.ArrayXf, traits, dr.arange(mi.UInt32, width), shape=(_TRAITS, width))[8]
        last = dr.opaque(mi.UInt32, radius)

        def add(step: Any, weights: Any, squares: Any, *sums: Any) -> tuple[Any, ...]:
            distance = (step >> 1) + 1
            signed = dr.select((step & 1) == 0, -mi.Int32(distance), mi.Int32(distance))
            nx, ny = x + signed * along_x, y + signed * along_y
            inside = (nx >= 0) & (nx < view.width) & (ny >= 0) & (ny < view.height)
            place = dr.gather(mi.UInt32, self.shown, mi.UInt32(ny * view.width + nx), inside)
            same = inside & (place != NOWHERE)
            other = dr.gather(mi.ArrayXf, traits, place, same, shape=(_TRAITS, width))
            position, normal = mi.Point3f(*other[:3]), mi.Vector3f(*other[3:6])
            trait, known, rays = other[6], other[7] > 0, other[8]
            same &= trait == here.trait
            plane = dr.abs(dr.dot(here.normal, position - here.position))
            near = (dr.dot(here.normal, normal) > 0.95) & (plane < here.offset * mi.Float(8 * distance))
            if share is not None:
                near &= dr.square(other[9] - share[0]) <= NOISE_LIMIT * (share[1] + other[10])
            same &= (near & (known == here.known)) | (known & ~here.known)
            # Halves at the ends: the filter spans one period of the dither, not one pixel more.
            weight = dr.select(known, 1.0, GUESS_WEIGHT) * dr.select(distance == last, mi.Float(0.5), 1.0)
            squares += dr.select(same, weight * weight * rays, 0)
            weight = dr.select(same, weight * rays, 0)
            theirs = dr.gather(mi.ArrayXf, images, place, same, shape=(_padded(len(values)), width))
            # Differences from the middle, so that equal neighbours leave it bit for bit as it was.
            changed = [
                dr.fma(weight, their - own, total)
                for their, own, total in zip(theirs[: len(values)], values, sums, strict=True)
            ]
            return step + 1, weights + weight, squares, *changed

        own_weight = dr.select(here.known, mi.Float(1), GUESS_WEIGHT)
        state = dr.zeros(mi.UInt32, width), own_rays * own_weight, own_rays * own_weight * own_weight
        sums = [dr.zeros(mi.Float, width) for _ in values]
        state = *state, *sums
        _, weights, squares, *sums = dr.while_loop(state, lambda step, *_: step < 2 * last, add, label="light filter")
        averages = [own + total / weights for own, total in zip(values, sums, strict=True)]
        return averages, weights * weights / (squares * own_rays)


def _metered(light: Any, area: Any, pixels: int) -> Any:
    """What light is multiplied by for the mean of a picture to look HALF.

    It is the light of points that stand for ``area`` pixels each, and 1 at the others.
    """
    area = mi.UInt64(area + dr.zeros(mi.Int32, dr.width(light)))  # of one number, the sum would be that number
    looks = dr.minimum(dr.power(dr.maximum(light, 0), DISPLAY), 4) * _STEPS
    looks = dr.sum(mi.UInt64(looks + 0.5) * area) - dr.sum(area) * _STEPS
    looks += dr.opaque(mi.UInt64, pixels * _STEPS)
    mean = mi.Float(looks) / dr.opaque(mi.Float, pixels * _STEPS)
    exposure = HALF * dr.power(dr.maximum(mean, 1e-6), -1 / DISPLAY)
    return dr.clip(exposure, DIMMEST, BRIGHTEST)


_TRAITS = 12


def _padded(count: int) -> int:
    return -(-count // 4) * 4


def packed(columns: list[Any]) -> Any:
    """One row of floats per pixel, padded to packets of four."""
    columns = [mi.Float(column) for column in columns]
    count, stride = max(dr.width(column) for column in columns), _padded(len(columns))
    rows = dr.empty(mi.Float, stride * count)
    dr.scatter(rows, mi.ArrayXf([*columns, *[mi.Float(0)] * (stride - len(columns))]), dr.arange(mi.UInt32, count))
    dr.eval(rows)
    return rows
