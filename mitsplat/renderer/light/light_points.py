"""Points that light is traced at: one in the middle of a pixel, or several where the surface bends across it.

A highlight on a bevel narrower than a pixel, or the dark bottom of a thread, belongs to a part of the pixel. Lit in its
middle alone, one pixel of a row would have all of it and the next one nothing. Where a pixel's neighbours have another
normal or show another thing, its light is therefore the mean over several points. They share its shadow rays, so that
they cost no more than their light without shadows.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.renderer.light.light_filter import NOWHERE, Estimate
from mitsplat.renderer.light.lit_surface import LitSurface, VisibleSurfaces
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import concatenated, gathered, wrapped

OFFSETS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
"""Where in the pixel they lie [px]: a turned grid, of which no two share a row or a column."""

EVEN = 0.95
"""Cosine of the angle between the normals of neighbours up to which light is that of the pixel's middle."""


@dataclass(frozen=True, eq=False)
class LightPoints:
    """The points of some pixels: in row i the middle of pixel i, then the first of those of bent ones, their second...

    Attributes:
        surface: The points.
        owner: Place of its pixel among them, by row.
        slot: By pixel, its place among bent ones, or ``NOWHERE``.
        count, bent: Number of pixels, and of bent ones among them.
    """

    surface: LitSurface
    owner: Any
    slot: Any
    count: int
    bent: int

    @classmethod
    def of(cls, visible: VisibleSurfaces, here: LitSurface, index: Any, place: Any, order: Any) -> LightPoints:
        """The points of the pixels ``index``, whose middles show ``here``.

        ``place`` says of all pixels where in ``index`` they are, ``order`` in which order to trace them.
        """
        count = dr.width(index)
        bends = _bends(here, index, place, visible.view)
        in_image = dr.compress(bends)
        bent = dr.width(in_image)
        slot = dr.full(mi.UInt32, NOWHERE, count)
        if not bent:
            return cls(here, dr.arange(mi.UInt32, count), slot, count, 0)
        among = dr.gather(mi.UInt32, order, dr.compress(dr.gather(mi.Bool, bends, order)))
        dr.scatter(slot, dr.arange(mi.UInt32, bent), among, mode=dr.ReduceMode.Permute)
        owner = concatenated([among] * len(OFFSETS))
        number = dr.arange(mi.UInt32, bent * len(OFFSETS)) // dr.opaque(mi.UInt32, bent)
        # Looked for in the order of the image: camera rays side by side meet the same triangles, which takes two fifths
        # of the time.
        offset = dr.gather(mi.Point2f, wrapped(mi.Float, np.array(OFFSETS, np.float32)), number)
        around = visible.beside(dr.gather(mi.UInt32, index, concatenated([in_image] * len(OFFSETS))), offset)
        rank = dr.empty(mi.UInt32, count)
        dr.scatter(rank, dr.arange(mi.UInt32, bent), in_image, mode=dr.ReduceMode.Permute)
        around = gathered(around, dr.gather(mi.UInt32, rank, owner) + number * dr.opaque(mi.UInt32, bent))
        # Where all of them miss what the middle shows, that is the only point.
        place_of, found = dr.gather(mi.UInt32, slot, owner), mi.Bool(False)
        for start in range(0, len(OFFSETS) * bent, bent):
            found |= dr.gather(mi.Bool, around.valid, place_of + dr.opaque(mi.UInt32, start))
        middle = (number == 0) & ~found
        own = gathered(here, owner)
        columns = [(getattr(here, f.name), getattr(around, f.name), getattr(own, f.name)) for f in fields(LitSurface)]
        surface = LitSurface(*[concatenated([a, dr.select(middle, c, b)]) for a, b, c in columns])
        owner = concatenated([dr.arange(mi.UInt32, count), owner])
        dr.eval(surface, owner, slot)
        return cls(surface, owner, slot, count, bent)

    def rows(self, places: Any) -> Any:
        """Rows of the points of some pixels, which may be none."""
        if not dr.width(places):
            return places
        slot = dr.gather(mi.UInt32, self.slot, places)
        even = dr.gather(mi.UInt32, places, dr.compress(slot == NOWHERE))
        slot = dr.gather(mi.UInt32, slot, dr.compress(slot != NOWHERE))
        dr.eval(even, slot)  # so that no kernel depends on which of them there are
        rows = concatenated([even, *[slot + start for start in self._starts()]]) if dr.width(slot) else even
        dr.eval(rows)
        return rows

    def shared(self, rays: Any, rows: Any) -> Any:
        """How many of the ``rays`` (UInt32) of their pixels start from the points ``rows``: one or more."""
        return dr.select(rows < dr.opaque(mi.UInt32, self.count), rays, dr.maximum(rays // len(OFFSETS), 1))

    def turn(self, rows: Any) -> tuple[Any, Any]:
        """Which of the rays of its pixel is the first of each point, and how many there are from one to the next."""
        count = dr.opaque(mi.UInt32, self.count)
        number = (rows - count) // dr.opaque(mi.UInt32, max(self.bent, 1))
        middle = rows < count
        return dr.select(middle, 0, number), dr.select(middle, mi.UInt32(1), len(OFFSETS))

    def total(self, values: Any) -> Any:
        """Sums by pixel of values by row, in a fixed order."""
        slot = dr.gather(mi.UInt32, self.slot, dr.arange(mi.UInt32, self.count))
        several, total = slot != NOWHERE, type(values)(0)
        for start in self._starts():
            total += dr.gather(type(values), values, slot + start, several)
        return dr.select(several, total, dr.gather(type(values), values, dr.arange(mi.UInt32, self.count)))

    def summed(self, estimate: Estimate) -> Estimate:
        """The estimate by pixel of one by row."""
        if not self.bent:
            return estimate
        result = Estimate(*[self.total(getattr(estimate, f.name)) for f in fields(Estimate)])
        dr.eval(result)
        return result

    def _starts(self) -> list[Any]:
        return [dr.opaque(mi.UInt32, self.count + number * self.bent) for number in range(len(OFFSETS))]


def _bends(here: LitSurface, index: Any, place: Any, view: CameraView) -> Any:
    """Whether pixels border on others that show another thing, or, of objects, one in another direction."""
    x, y = mi.Int32(index % view.width), mi.Int32(index // view.width)
    thing, bends = here.instance > 0, mi.Bool(False)
    for dx, dy in np.ndindex(3, 3):
        nx, ny = x + (dx - 1), y + (dy - 1)
        inside = (nx >= 0) & (nx < view.width) & (ny >= 0) & (ny < view.height)
        other = dr.gather(mi.UInt32, place, mi.UInt32(ny * view.width + nx), inside)
        lit = inside & (other != NOWHERE)
        same = dr.gather(mi.Float, here.trait, other, lit) == here.trait
        even = dr.dot(dr.gather(mi.Vector3f, here.normal, other, lit), here.normal) > EVEN
        bends |= (lit & ~same) | (inside & thing & ~(lit & even))
    # Of what does not move, only splats have proxies that further rays are sent to.
    bends &= here.known & here.valid & (thing | ~here.relit)
    dr.eval(bends)
    return bends
