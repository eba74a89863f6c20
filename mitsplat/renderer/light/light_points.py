"""Light sample points: the pixel centre, or several points where the surface bends across the pixel.

A highlight on a bevel narrower than a pixel, or the dark root of a thread, covers a part of the pixel. With light at
the pixel centre only, one pixel would show all of it and the next pixel nothing. A pixel whose neighbours have another
normal or another instance therefore takes the mean over several points. The points share the shadow rays of the pixel,
so that only their unoccluded light costs extra time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.renderer.light.light_estimate import Estimate
from mitsplat.renderer.light.light_filter import UNTRACED
from mitsplat.renderer.light.lit_surface import LitSurface, VisibleSurfaces
from mitsplat.renderer.light.reflections import Reflections
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import concatenated, gathered, wrapped

OFFSETS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
"""Offsets of the points from the pixel centre [px]: a rotated grid without shared rows or columns."""

POINT_START, POINT_STEP = 50, 3
"""Step between the first ray numbers of the points of a pixel, and between the ray numbers of one point.

With point k taking every fourth number from k on, all rays of a point would sample almost the same part of the lamps:
the first coordinate of the shadow rays' sequence changes by 0.02 in four numbers. A thread below a lamp then shows
white and black points by chance. With these steps, the distance between 2, 4 and 8 rays of a point, and between the
rays of all points, is at least 0.39 of the largest possible distance, for shadow rays and reflection rays; no steps
below 64 reach more than 0.46. The first and the last point share ray numbers from the 51st ray of a point on, that is
above 200 rays of a pixel, which did not increase the error of 512 to 2048 rays.
"""

Sums = TypeVar("Sums", Estimate, Reflections)

Values = TypeVar("Values", "mi.Float", "mi.Color3f", "mi.Vector3f")

EVEN = 0.95
"""Cosine between the normals of neighbours above which light is sampled at the pixel centre only."""

EVEN_ROUGH, ROUGH = 0.985, 0.15
"""The same cosine for surfaces that mirror light with at least this roughness: that of 10 degrees.

The points of such pixels are at least 2.5 degrees apart. They show more detail than one wide lobe, and find the
highlights of all but the smoothest surfaces.
"""


@dataclass(frozen=True, eq=False)
class LightPoints:
    """Sample points of pixels.

    The rows hold all pixel centres first, then the first points of all bent pixels, their second points, and so on.

    Attributes:
        surface: The points, by row.
        owner: Index of the pixel, by row.
        slot: Index among bent pixels, by pixel; ``UNTRACED`` if the pixel is not bent.
        bent_pixels: Indices of the bent pixels.
        count, bent: Number of pixels, and number of bent pixels among them.
    """

    surface: LitSurface
    owner: mi.UInt32
    slot: mi.UInt32
    bent_pixels: mi.UInt32
    count: int
    bent: int

    @classmethod
    def of(
        cls, visible: VisibleSurfaces, here: LitSurface, bends: mi.Bool, index: mi.UInt32, order: mi.UInt32
    ) -> LightPoints:
        """Place the points of pixels.

        Args:
            visible: Surface points of the view.
            here: Points at the centres of the pixels ``index``.
            bends: Pixels that get several points, see :func:`bent_pixels`.
            index: Pixels of the image.
            order: Tracing order of the pixels.
        """
        count = dr.width(index)
        in_image = dr.compress(bends)
        bent = dr.width(in_image)
        slot = dr.full(mi.UInt32, UNTRACED, count)
        if not bent:
            return cls(here, dr.arange(mi.UInt32, count), slot, in_image, count, 0)
        among = dr.gather(mi.UInt32, order, dr.compress(dr.gather(mi.Bool, bends, order)))
        dr.scatter(slot, dr.arange(mi.UInt32, bent), among, mode=dr.ReduceMode.Permute)
        owner = concatenated([among] * len(OFFSETS))
        number = dr.arange(mi.UInt32, bent * len(OFFSETS)) // dr.opaque(mi.UInt32, bent)
        # Traced in image order: adjacent camera rays hit the same triangles, which takes 40 % of the time.
        offset = dr.gather(mi.Point2f, wrapped(mi.Float, np.array(OFFSETS, np.float32)), number)
        around = visible.at_offset(dr.gather(mi.UInt32, index, concatenated([in_image] * len(OFFSETS))), offset)
        rank = dr.empty(mi.UInt32, count)
        dr.scatter(rank, dr.arange(mi.UInt32, bent), in_image, mode=dr.ReduceMode.Permute)
        around = gathered(around, dr.gather(mi.UInt32, rank, owner) + number * dr.opaque(mi.UInt32, bent))
        # If all points of a pixel miss the instance at its centre, the centre is the only point.
        place_of, found = dr.gather(mi.UInt32, slot, owner), mi.Bool(False)
        for start in range(0, len(OFFSETS) * bent, bent):
            found |= dr.gather(mi.Bool, around.valid, place_of + dr.opaque(mi.UInt32, start))
        middle = (number == 0) & ~found
        own = gathered(here, owner)
        columns = [(getattr(here, f.name), getattr(around, f.name), getattr(own, f.name)) for f in fields(LitSurface)]
        surface = LitSurface(*[concatenated([a, dr.select(middle, c, b)]) for a, b, c in columns])
        owner = concatenated([dr.arange(mi.UInt32, count), owner])
        dr.eval(surface, owner, slot, among)
        return cls(surface, owner, slot, among, count, bent)

    @property
    def valid_share(self) -> mi.Float:
        """Share of the points of every pixel that lie on a surface."""
        valid = dr.select(self.surface.valid, mi.Float(1), 0)
        dr.eval(valid)
        return self._sums_by_pixel([valid])[0] / dr.select(self.slot != UNTRACED, mi.Float(len(OFFSETS)), 1)

    def rows(self, places: mi.UInt32) -> mi.UInt32:
        """Return the rows of the points of some pixels (possibly none)."""
        if not dr.width(places):
            return places
        slot = dr.gather(mi.UInt32, self.slot, places)
        is_bent, is_even = slot != UNTRACED, slot == UNTRACED
        dr.eval(slot, is_bent, is_even)
        even = dr.gather(mi.UInt32, places, dr.compress(is_even))
        slot = dr.gather(mi.UInt32, slot, dr.compress(is_bent))
        dr.eval(even, slot)  # keeps the kernels independent of which kinds occur
        rows = concatenated([even, *[slot + start for start in self._starts]]) if dr.width(slot) else even
        dr.eval(rows)
        return rows

    def ray_count(self, rays: mi.UInt32, rows: mi.UInt32) -> mi.UInt32:
        """Return the number of rays (at least 1) of the points ``rows``, given the ``rays`` (UInt32) of pixels."""
        return dr.select(rows < dr.opaque(mi.UInt32, self.count), rays, dr.maximum(rays // len(OFFSETS), 1))

    def steps(self, rows: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Return the first ray number of each point in the sequence of its pixel, and the step to its next ray."""
        count = dr.opaque(mi.UInt32, self.count)
        number = (rows - count) // dr.opaque(mi.UInt32, max(self.bent, 1))
        middle = rows < count
        return dr.select(middle, 0, number * POINT_START), dr.select(middle, mi.UInt32(1), POINT_STEP)

    def _sums_by_pixel(self, columns: Sequence[mi.Float | mi.Color3f]) -> list[mi.Float | mi.Color3f]:
        """Sum columns by row into columns by pixel, in a fixed order."""
        pixel, bend = dr.arange(mi.UInt32, self.count), dr.arange(mi.UInt32, self.bent)
        sums = [dr.gather(type(column), column, pixel) for column in columns]
        if self.bent:
            parts = [[dr.gather(type(column), column, bend + start) for start in self._starts] for column in columns]
            totals = [sum(part, type(column)(0)) for column, part in zip(columns, parts, strict=True)]
            dr.eval(sums, totals)
            for pixels, total in zip(sums, totals, strict=True):
                dr.scatter(pixels, total, self.bent_pixels, mode=dr.ReduceMode.Permute)
        dr.eval(sums)
        return sums

    def mean_by_pixel(self, values: Values, rows: mi.UInt32, valid: mi.Bool, places: mi.UInt32) -> Values:
        """Return means over the valid points of the pixels ``places``, whose rows are ``rows``."""
        columns = [dr.zeros(kind, dr.width(self.owner)) for kind in (type(values), mi.Float)]
        for column, value in zip(columns, (values, mi.Float(1)), strict=True):
            dr.scatter(column, dr.select(valid, value, 0), rows)
        dr.eval(columns)
        total, count = (dr.gather(type(sums), sums, places) for sums in self._sums_by_pixel(columns))
        mean = total / dr.maximum(count, 1)
        dr.eval(mean)
        return mean

    def sums_by_pixel(self, sums: Sums) -> Sums:
        """Sum a dataclass of values by row into values by pixel."""
        if not self.bent:
            return sums
        return type(sums)(*self._sums_by_pixel([getattr(sums, f.name) for f in fields(sums)]))

    @cached_property
    def _starts(self) -> list[mi.UInt32]:
        """First rows of the first points of all bent pixels, of their second points, and so on."""
        return [dr.opaque(mi.UInt32, self.count + number * self.bent) for number in range(len(OFFSETS))]


def bent_pixels(here: LitSurface, index: mi.UInt32, place: mi.UInt32, view: CameraView) -> mi.Bool:
    """Return for each pixel (Bool) if it borders on another shape or, on an instance, on another surface direction."""
    on_object, bends = here.instance > 0, mi.Bool(False)
    limit = dr.select(here.glossy & (here.roughness >= ROUGH), mi.Float(EVEN_ROUGH), mi.Float(EVEN))
    for dx, dy in np.ndindex(3, 3):
        inside, other, lit = _neighbour(index, place, view, (dx - 1, dy - 1))
        same = dr.gather(mi.Float, here.trait, other, lit) == here.trait
        even = dr.dot(dr.gather(mi.Vector3f, here.normal, other, lit), here.normal) > limit
        bends |= (lit & ~same) | (inside & on_object & ~(lit & even))
    bends &= here.known & here.valid
    dr.eval(bends)
    return bends


def filtered_lobes(here: LitSurface, index: mi.UInt32, place: mi.UInt32, view: CameraView) -> LitSurface:
    """Return the points with the lobes of whole pixels, whose normals vary on a curved surface.

    The filter is a Gaussian of variance 1/4 px^2 (Tokuyoshi and Kaplanyan 2019, "Improved Geometric Specular
    Antialiasing"). With the derivatives a and b of the normal along the axes of the image, the normals have the
    covariance (a a' + b b') / 4. The slopes of Beckmann's microfacets have the variance alpha^2 / 2 per axis, so that
    alpha^2 increases by m + r along the strongest curvature and by m - r across it, with m = (|a|^2 + |b|^2) / 4 and
    r^2 = ((|a|^2 - |b|^2) / 4)^2 + (a.b / 2)^2. A lobe that is also wider along a bevel loses light beyond its ends.

    Sharp edges do not count: bent pixels have several points. The change decreases with the fourth power of the cosine
    to the camera, because a wide lobe at a silhouette loses light below the surface. With the second power, the root
    mean square error of a mirroring sphere in a white furnace is 0.0301 instead of 0.0284.
    """
    normal, derivatives = here.normal, []
    for axis in ((1, 0), (0, 1)):
        total, count = mi.Vector3f(0), mi.Float(0)
        for sign in (1, -1):
            _, other, lit = _neighbour(index, place, view, (sign * axis[0], sign * axis[1]))
            near = lit & (dr.gather(mi.Float, here.trait, other, lit) == here.trait)
            beside = dr.gather(mi.Vector3f, normal, other, near)
            near &= dr.dot(beside, normal) > EVEN
            total += dr.select(near, sign * (beside - normal), 0)
            count += dr.select(near, 1.0, 0)
        total -= dr.dot(total, normal) * normal
        derivatives.append(total / dr.maximum(count, 1))
    a, b = derivatives
    share = dr.power(dr.dot(normal, here.to_camera), 4)
    difference, product = (dr.squared_norm(a) - dr.squared_norm(b)) / 4, dr.dot(a, b) / 2
    mean, radius = (dr.squared_norm(a) + dr.squared_norm(b)) / 4, dr.sqrt(dr.square(difference) + dr.square(product))
    angle = dr.atan2(product, difference) / 2
    along = a * dr.cos(angle) + b * dr.sin(angle)
    excess = 2 * radius * share
    length = dr.norm(along)
    bend = dr.select((excess > 0) & (length > 0), along * (dr.sqrt(excess) / length), 0)
    across = dr.maximum(mean - radius, 0) * share
    roughness = dr.select(across > 0, dr.sqrt(dr.sqrt(dr.power(here.roughness, 4) + across)), here.roughness)
    return replace(here, roughness=roughness, bend=bend)


def _neighbour(
    index: mi.UInt32, place: mi.UInt32, view: CameraView, step: tuple[int, int]
) -> tuple[mi.Bool, mi.UInt32, mi.Bool]:
    """Return if the pixels at an offset ``step`` lie inside the picture, their places, and if their light is traced."""
    x, y = mi.Int32(index % view.width) + step[0], mi.Int32(index // view.width) + step[1]
    inside = (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    other = dr.gather(mi.UInt32, place, mi.UInt32(y * view.width + x), inside)
    return inside, other, inside & (other != UNTRACED)
