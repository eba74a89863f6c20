"""Edge-preserving average of traced light over neighbours on the same surface, and its remaining error."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.error_target import allowed_error, exposure_factor, share_variance
from mitsplat.renderer.light.light_estimate import Estimate, LightMeans
from mitsplat.renderer.light.lit_surface import LitSurface
from mitsplat.renderer.rays.camera_rays import CameraView

RADIUS = 4
"""Radius of the filter [px]."""

LOBE_SHARE = 0.5
"""Largest angle between the mirrored directions of two neighbours whose reflections are averaged, over GGX's alpha."""

WIDE_LOBE_SHARE = 2.0
"""The same for neighbours whose difference is explained by noise."""

SAME_GLOSS = 0.1
"""Largest difference of roughness plus twice the metalness between neighbours whose reflections are averaged."""

NOISE_LIMIT = 16.0
"""Squared difference between the light shares of two neighbours, in variances, at which their weight reaches 0.

The weight is Tukey's biweight (Beaton and Tukey 1974), which falls smoothly. A weight that falls in one step at a noisy
difference gives adjacent pixels different windows, so that penumbrae get saw-teeth.
"""

SECOND_NOISE = 0.4
"""Factor of the variance of light shares after the average along rows, for the average along columns."""

GUESS_WEIGHT = 1e-3
"""Weight of a point that is not known to lie on a surface, relative to a known point."""

SMALL_FILTER_PIXELS = 64 / 9
"""Number of equally weighted pixels with the same noise as a mean over 3 x 3 pixels with half weights at the ends."""

GAIN = 10.0
"""Factor by which the full filter and stratified rays reduce the variance of a mean over 3 x 3 pixels. With this value,
``python -m benchmarks.light.traced`` measures 0.6 of a wanted error of 0.03 over all shadows.
"""

UNTRACED = 0xFFFFFFFF
"""Place of a pixel without traced light."""


class _Traits:
    """Columns of the packed data of a pixel by which the filter compares neighbours."""

    POSITION, NORMAL = slice(0, 3), slice(3, 6)
    TRAIT, KNOWN, RAYS = range(6, 9)
    GUIDE, VARIANCE = range(9, 11)
    MIRRORED, GLOSS = slice(11, 14), 14


class Guide(NamedTuple):
    """Estimate that limits the average: neighbours count as far as noise explains their difference.

    Attributes:
        value: Light share or brightness at each pixel of the filter.
        variance: Variance of ``value``.
    """

    value: mi.Float
    variance: mi.Float


class _Lobe(NamedTuple):
    """Reflection that limits the average: neighbours of the same gloss that mirror similar directions count.

    Attributes:
        mirrored: Mean of the directions that a pixel mirrors.
        min_cosine: Smallest cosine between the directions of two neighbours.
        gloss: Roughness plus twice the metalness.
    """

    mirrored: mi.Vector3f
    min_cosine: mi.Float
    gloss: mi.Float


class LightFilter:
    """Separable edge-preserving filter at the pixels of an image where light was traced.

    A neighbour counts if it belongs to the same shape, its normal agrees, and it lies in the tangent plane. Its weight
    is larger if noise explains the difference of its light share. A hard shadow therefore keeps its edge, while a
    penumbra becomes smooth. A few rays per pixel estimate the share too roughly, so share and variance are taken from
    3 x 3 pixels. The variance is that of n binary draws, where n is the effective sample size of the weighted rays
    (Kish 1965, section 11.7). The average along columns compares the shares averaged along rows, so that adjacent
    columns have similar windows. Equal sums stay equal, so that the ratio of an unshadowed point is exactly 1.

    At a silhouette, a pixel may show one instance while its ray hits the proxy of another. Such a point takes its light
    from the nearest known neighbours that show the same instance.
    """

    def __init__(
        self, here: LitSurface, view: CameraView, index: mi.UInt32, coarse: mi.Bool | None = None, stride: int = 1
    ) -> None:
        """Prepare the filter.

        Args:
            here: Visible points of the pixels.
            view: Camera.
            index: Pixels of the image where light was traced.
            coarse: True for pixels of coarse tiles, by pixel of the image. Their neighbours are two pixels apart, and
                each traced pixel represents four.
            stride: Distance between neighbours elsewhere [px].
        """
        self.view, self.index, self.here = view, index, here
        self.stride = mi.Int32(stride)
        if coarse is not None:
            self.stride = dr.select(dr.gather(mi.Bool, coarse, index), mi.Int32(2), 1)
        # Neighbour data is stored compactly, for the traced pixels only.
        self.place = dr.full(mi.UInt32, UNTRACED, view.width * view.height)
        dr.scatter(self.place, dr.arange(mi.UInt32, dr.width(index)), index)
        dr.eval(self.place)
        # Untraced pixels of coarse tiles map to the traced pixel of their 2 x 2 cell. Otherwise neighbours in every
        # second column would find fewer samples.
        self.nearest_place = self.place
        if coarse is not None:
            pixel = dr.arange(mi.UInt32, view.width * view.height)
            x, y = pixel % view.width, pixel // view.width
            traced = (y - (y & 1)) * view.width + x - (x & 1)
            self.nearest_place = dr.select(coarse, dr.gather(mi.UInt32, self.place, traced, coarse), self.place)
            dr.eval(self.nearest_place)

    def rays_for(
        self, estimate: Estimate, error: float, unshadowed: mi.Float, others: mi.UInt32 | None = None
    ) -> tuple[mi.Float, mi.Float]:
        """Compute the number of rays per pixel of ``index`` at which light reaches the wanted error.

        The wanted error applies at ``MID_GREY``. At other levels the same perceptual error is tolerated: a smaller
        standard error in the dark, a larger one where it is bright.

        Args:
            estimate: Estimate from the rays so far.
            error: Target standard error of mid-grey light.
            unshadowed: Light without occluders at each pixel; 1 is white. Rays estimate the share of it that arrives.
            others: Number of other pixels that show a surface, under automatic exposure, which makes the mean look like
                ``MID_GREY``. They count as lit by 1. None means exposure for white.

        Returns:
            Number of rays, and the factor of the exposure.
        """
        share, variance, shared = self._share(estimate)
        light, exposure = unshadowed * share, mi.Float(1)
        if others is not None:
            exposure = exposure_factor(light, self.stride * self.stride, others)
        error = allowed_error(error, light * exposure)
        return estimate.rays * variance * dr.square(unshadowed * exposure / error) / _gain(shared), exposure

    def smooth(self, estimate: Estimate, bounced: tuple[mi.Color3f, mi.Float] | None = None) -> LightMeans:
        """Average the light of the estimate per ray over neighbours of the pixels of ``index``.

        ``bounced`` is reflected light and the flag (Float) where it is known (1, otherwise 0). Its average is 0 where
        no neighbour knows it.
        """
        weight = dr.rcp(dr.maximum(estimate.rays, 1))
        values = [c * weight for c in (*estimate.lit, *estimate.base)]
        values, _ = self._average(values, estimate.rays, RADIUS, Guide(*self._share(estimate)[:2]))
        mean_bounced = None
        if bounced is not None:  # shadows of lamps do not limit its average
            *colour, share = self.average([*bounced[0], bounced[1]])
            mean_bounced = dr.select(share > 1e-6, mi.Color3f(*colour) / share, 0)
        return LightMeans(mi.Color3f(*values[:3]), mi.Color3f(*values[3:6]), mean_bounced)

    def mirror(
        self, values: list[mi.Float], mirrored: mi.Vector3f, radius: int = RADIUS, *, guide: Guide | None = None
    ) -> tuple[list[mi.Float], mi.Float]:
        """Average reflected light per ray over neighbours that mirror similar directions.

        All pixels have equal weights, because bright pixels have more rays: weights by rays would add light beside
        highlights. Numbers of rays in proportion to the variance make all pixels equally accurate.

        Args:
            values: Reflected light per ray.
            mirrored: Mean of the directions that a pixel mirrors. It is short where they differ, and such pixels are
                averaged only with a ``guide``.
            radius: Radius of the filter [px].
            guide: Brightness. Neighbours whose brightness differs by no more than noise may mirror
                directions that are farther apart.

        Returns:
            The averages, and the effective number of pixels.
        """
        here = self.here
        gloss = here.roughness + 2 * here.metallic
        share = LOBE_SHARE if guide is None else WIDE_LOBE_SHARE
        closeness = dr.cos(dr.clip(share * dr.square(here.roughness), 1e-3, 1))
        dr.eval(closeness, gloss)
        even = dr.full(mi.Float, 1, dr.width(self.index))
        return self._average(values, even, radius, guide, _Lobe(mirrored, closeness, gloss))

    def reflections_for(
        self,
        brightness: mi.Float,
        squares: mi.Float,
        rays: mi.Float,
        mirrored: mi.Vector3f,
        error: float,
        exposure: mi.Float,
    ) -> mi.Float:
        """Compute the number of reflection rays per pixel of ``index`` at which they reach the wanted error.

        Args:
            brightness: Sum of the brightness of the rays so far, in units of white.
            squares: Sum of its squares.
            rays: Number of these rays.
            mirrored: Mean of the directions that a pixel mirrors.
            error: Target standard error of mid-grey light.
            exposure: Factor of the exposure, that of :meth:`rays_for`.
        """
        rays = dr.maximum(rays, 1)
        mean = brightness * exposure / rays
        variance = (
            dr.maximum(squares * dr.square(exposure) / rays - dr.square(mean), 0) * rays / dr.maximum(rays - 1, 1)
        )
        dr.eval(mean, variance)
        # Own samples would stop at small variance and large values by chance, so that the picture would be too bright.
        (variance,), _ = self._average([variance], rays, 1)
        (mean,), shared = self.mirror([mean], mirrored, 1)
        return variance / (dr.square(allowed_error(error, mean)) * _gain(shared))

    def _share(self, estimate: Estimate) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return the light share over 3 x 3 pixels, its variance, and the number of pixels that contribute."""
        weight = dr.rcp(dr.maximum(estimate.rays, 1))
        values = [dr.sum(estimate.lit) * weight, dr.sum(estimate.base) * weight, estimate.squares * weight]
        (lit, base, squares), shared = self._average(values, estimate.rays, 1)
        share = dr.select(base > 0, lit / base, 1)
        draws = dr.maximum(shared * estimate.rays * dr.square(base) / dr.maximum(squares, 1e-20), 1)
        variance = share_variance(share, draws)
        dr.eval(share, variance)
        return share, variance, shared

    def average(self, values: list[mi.Float], radius: int = RADIUS) -> list[mi.Float]:
        """Average values at the pixels of ``index`` that all have the same number of rays."""
        return self._average(values, dr.full(mi.Float, 1, dr.width(self.index)), radius)[0]

    def _average(
        self, values: list[mi.Float], rays: mi.Float, radius: int, guide: Guide | None = None, lobe: _Lobe | None = None
    ) -> tuple[list[mi.Float], mi.Float]:
        """Return averages, and the effective number of equally weighted pixels with the same number of rays."""
        here = self.here
        known = dr.select(here.known, mi.Float(1), 0)
        limits = [*(guide or (0, 0)), *([] if lobe is None else [*lobe.mirrored, lobe.gloss])]
        traits = packed([*here.position, *here.normal, here.trait, known, rays, *limits])  # see _Traits
        shared, count, noise = mi.Float(1), len(values), NOISE_LIMIT
        values = values if guide is None else [*values, guide.value]
        for direction in ((1, 0), (0, 1)):
            values, along = self._average_along(values, traits, direction, radius, guide, lobe, noise)
            shared *= along
            dr.eval(values, shared)
            if guide is not None:
                guide, noise = guide._replace(value=values[count]), noise * SECOND_NOISE
                row = dr.arange(mi.UInt32, dr.width(self.index)) * (dr.width(traits) // dr.width(self.index))
                dr.scatter(traits, guide.value, row + _Traits.GUIDE)
        return values[:count], shared

    def _average_along(
        self,
        values: list[mi.Float],
        traits: mi.Float,
        direction: tuple[int, int],
        radius: int,
        guide: Guide | None,
        lobe: _Lobe | None,
        noise: float,
    ) -> tuple[list[mi.Float], mi.Float]:
        """Average over pixels up to ``radius`` away along a direction (x, y); the outermost pixels have half weight.

        The loop is symbolic, because tracing a step on the host takes as long as its execution on the device.
        """
        view, width = self.view, dr.width(self.index)
        x, y = mi.Int32(self.index % view.width), mi.Int32(self.index // view.width)
        along_x, along_y = (dr.opaque(mi.Int32, step) * self.stride for step in direction)
        images, columns = packed(values), dr.width(traits) // width
        own_rays = dr.gather(mi.ArrayXf, traits, dr.arange(mi.UInt32, width), shape=(columns, width))[_Traits.RAYS]
        last, limit = dr.opaque(mi.UInt32, radius), dr.opaque(mi.Float, noise)

        def add(
            step: mi.UInt32, weights: mi.Float, squares: mi.Float, *sums: mi.Float
        ) -> tuple[mi.UInt32 | mi.Float, ...]:
            distance = (step >> 1) + 1
            signed = dr.select((step & 1) == 0, -mi.Int32(distance), mi.Int32(distance))
            nx, ny = x + signed * along_x, y + signed * along_y
            inside = (nx >= 0) & (nx < view.width) & (ny >= 0) & (ny < view.height)
            place = dr.gather(mi.UInt32, self.nearest_place, mi.UInt32(ny * view.width + nx), inside)
            traced = inside & (place != UNTRACED)
            other = dr.gather(mi.ArrayXf, traits, place, traced, shape=(columns, width))
            similar, weight = self._similarity(other, distance, guide, lobe, limit)
            similar &= traced
            # With half weights at the ends, the filter spans exactly one period of the dither.
            weight *= dr.select(distance == last, mi.Float(0.5), 1.0)
            squares += dr.select(similar, weight * weight * other[_Traits.RAYS], 0)
            weight = dr.select(similar, weight * other[_Traits.RAYS], 0)
            theirs = dr.gather(mi.ArrayXf, images, place, similar, shape=(_padded(len(values)), width))
            # Sums of differences from the centre leave the value bit-identical if all neighbours are equal.
            changed = [
                dr.fma(weight, their - own, total)
                for their, own, total in zip(theirs[: len(values)], values, sums, strict=True)
            ]
            return step + 1, weights + weight, squares, *changed

        own_weight = dr.select(self.here.known, mi.Float(1), GUESS_WEIGHT)
        sums = [dr.zeros(mi.Float, width) for _ in values]
        state = dr.zeros(mi.UInt32, width), own_rays * own_weight, own_rays * own_weight * own_weight, *sums
        _, weights, squares, *sums = dr.while_loop(state, lambda step, *_: step < 2 * last, add, label="light filter")
        averages = [own + total / weights for own, total in zip(values, sums, strict=True)]
        return averages, weights * weights / (squares * own_rays)

    def _similarity(
        self, other: mi.ArrayXf, distance: mi.UInt32, guide: Guide | None, lobe: _Lobe | None, noise: mi.Float
    ) -> tuple[mi.Bool, mi.Float]:
        """Return whether a neighbour counts, and its weight per ray.

        Args:
            other: Columns of the neighbour, see :class:`_Traits`.
            distance: Distance of the neighbour, in steps of the filter.
            guide: Estimate that limits the average.
            lobe: Reflection that limits the average.
            noise: Squared difference of the guide at which the weight reaches 0, in variances.
        """
        here = self.here
        position, normal = mi.Point3f(*other[_Traits.POSITION]), mi.Vector3f(*other[_Traits.NORMAL])
        known = other[_Traits.KNOWN] > 0
        plane = dr.abs(dr.dot(here.normal, position - here.position))
        near = (dr.dot(here.normal, normal) > 0.95) & (plane < here.offset * mi.Float(8 * distance))
        likely = mi.Float(1)
        if guide is not None:
            difference, variance = (
                other[_Traits.GUIDE] - guide.value,
                noise * (guide.variance + other[_Traits.VARIANCE]),
            )
            likely = dr.square(dr.maximum(1 - dr.square(difference) / dr.maximum(variance, 1e-20), 0))
        if lobe is not None:
            towards = mi.Vector3f(*other[_Traits.MIRRORED])
            # Both are the cosine of unit vectors. The second one accepts equal mean directions of any length.
            cosine = (
                dr.dot(towards, lobe.mirrored) if guide is None else 1 - dr.squared_norm(towards - lobe.mirrored) / 2
            )
            near &= (cosine > lobe.min_cosine) & (dr.abs(other[_Traits.GLOSS] - lobe.gloss) < SAME_GLOSS)
        alike = near & (known == here.known)
        # Shadows at contacts change from row to row: the nearest known neighbours of other points count most.
        weight = dr.select(known, 1.0, GUESS_WEIGHT) * dr.select(
            alike, likely, dr.rcp(dr.square(dr.square(mi.Float(distance))))
        )
        return (other[_Traits.TRAIT] == here.trait) & (alike | (known & ~here.known)), weight


def _gain(shared: mi.Float) -> mi.Float:
    """Return the factor by which the full filter reduces variance, given the similar pixels among 3 x 3.

    If few of these are similar, almost none of the more distant pixels are.
    """
    return dr.fma(GAIN - 1, dr.square((shared - 1) / (SMALL_FILTER_PIXELS - 1)), 1)


def _padded(count: int) -> int:
    return -(-count // 4) * 4


def packed(columns: list[mi.Float]) -> mi.Float:
    """Pack columns into one row of floats per pixel, padded to packets of four."""
    columns = [mi.Float(column) for column in columns]
    count, stride = max(dr.width(column) for column in columns), _padded(len(columns))
    rows = dr.empty(mi.Float, stride * count)
    dr.scatter(rows, mi.ArrayXf([*columns, *[mi.Float(0)] * (stride - len(columns))]), dr.arange(mi.UInt32, count))
    dr.eval(rows)
    return rows
