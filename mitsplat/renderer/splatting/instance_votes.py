"""Instance votes: the instance with the largest share of a ray, for any number of instances.

The state of a ray has a fixed size, but a ray may meet any number of instances. The first walk of a ray sums the
weights of the environment and of the first instances that it meets. These sums are complete, because a slot is never
given to another instance. All other instances share one sum. The largest complete sum wins, unless the shared sum is
larger. In that case the ray is walked again: each walk sums the weights of the next instances in the order of ids,
until the remaining instances together weigh less than the best one.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Order, Quality
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.splatting.lanes import Lanes
from mitsplat.renderer.splatting.tiles import TileLists
from mitsplat.renderer.splatting.walk import TRANSMITTANCE, Pixel, Rays, walk

FIRST_SLOTS = 3
"""Number of instances with a slot in the first walk."""

NEXT_SLOTS = 8
"""Number of instances with a slot in each further walk."""

ENVIRONMENT, OTHERS, SLOTS = range(3)
"""Indices of a tally: weight of the environment, weight of all instances without a slot, and first entry of the slots.
Each slot holds id and weight, 0 if empty.
"""


def new_tally() -> list[mi.Float]:
    """Return the empty tally of a ray."""
    return [mi.Float(0.0) for _ in range(SLOTS + 2 * FIRST_SLOTS)]


def add_to_tally(tally: list[mi.Float], weight: mi.Float, instance: mi.Float) -> list[mi.Float]:
    """Return the tally after one more Gaussian."""
    placed = instance == 0
    result = [dr.select(placed, tally[ENVIRONMENT] + weight, tally[ENVIRONMENT]), tally[OTHERS]]
    placed |= weight <= 0
    for number, total in zip(tally[SLOTS::2], tally[SLOTS + 1 :: 2], strict=True):
        here = ~placed & ((number == instance) | (number == 0))
        placed |= here
        result += [dr.select(here, instance, number), dr.select(here, total + weight, total)]
    result[OTHERS] = dr.select(placed, tally[OTHERS], tally[OTHERS] + weight)
    return result


def winner_of_tally(tally: list[mi.Float], transmittance: mi.Float) -> tuple[mi.Float, mi.Bool]:
    """Return the instance (Float) with the largest share of a ray, and True if another one may have more.

    The remaining transmittance counts as environment.
    """
    instance, most = mi.Float(0), tally[ENVIRONMENT] + transmittance
    for number, total in zip(tally[SLOTS::2], tally[SLOTS + 1 :: 2], strict=True):
        instance, most = dr.select(total > most, number, instance), dr.maximum(total, most)
    return instance, tally[OTHERS] > most


def resolve_instances(
    instance: mi.UInt32,
    uncertain: mi.Bool,
    lists: TileLists,
    view: CameraView,
    quality: Quality,
    order: Order,
    z_max: mi.Float | None,
) -> mi.UInt32:
    """Return the instance image (UInt32, row-major) with exact ids where it is ``uncertain`` (Bool).

    Rays are walked in the ``order`` of the picture. Other rays are not walked, but their lanes are launched, which
    avoids a read-back from the device. The other arguments are those of
    :func:`mitsplat.renderer.splatting.march.march`.
    """
    lanes = Lanes(lists, view, rows=1)
    (pixel,), (inside,) = lanes.pixel, lanes.inside
    wanted = inside & dr.gather(mi.Bool, uncertain, pixel, inside)
    far = mi.Float(dr.inf) if z_max is None else dr.gather(mi.Float, z_max, pixel, wanted)
    slopes = lanes.slopes(*(dr.opaque(mi.Float, 0.5) for _ in range(2)))

    def body(
        last: mi.Float, best: mi.Float, most: mi.Float, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float, mi.Float, mi.Bool]:
        rays = Rays.through(
            lists, view, quality, slopes, [far], lanes.start, dr.select(active, lanes.stop, lanes.start)
        )
        ((transmittance, own, left, *slots),) = walk(
            rays,
            order,
            _initial_votes,
            lambda pixel, alpha, record, _: _add_vote(pixel, pixel[TRANSMITTANCE] * alpha, record.instance, last),
        )
        # This value is the same in every walk: the share of the environment.
        most = dr.maximum(most, own + transmittance)
        for number, total in zip(slots[0::2], slots[1::2], strict=True):
            best, most = dr.select(active & (total > most), number, best), dr.maximum(total, most)
        return slots[-2], best, most, active & (left > most)

    nothing = dr.zeros(mi.Float, dr.width(pixel))
    state = nothing, mi.Float(nothing), mi.Float(nothing), wanted
    _, best, _, _ = dr.while_loop(state, lambda *state: state[-1], body, label="settle instances")
    settled = dr.copy(instance)
    dr.scatter(settled, mi.UInt32(best), pixel, wanted, mode=dr.ReduceMode.Permute)
    return settled


def _initial_votes() -> Pixel:
    """Return the initial state of a ray of a further walk: a tally with slots in the order of ids."""
    slots = [mi.Float(value) for _ in range(NEXT_SLOTS) for value in (dr.inf, 0.0)]
    return [mi.Float(1.0), mi.Float(0.0), mi.Float(0.0), *slots]


def _add_vote(pixel: Pixel, weight: mi.Float, instance: mi.Float, last: mi.Float) -> Pixel:
    """Return the state after one more Gaussian: the smallest ids above ``last`` keep their slots.

    An id that is among them at the end always had a slot, so that its sum is complete.
    """
    transmittance, own, left, *slots = pixel
    own = dr.select(instance == 0, own + weight, own)
    counted = (weight > 0) & (instance > last)
    number, weight_left = dr.select(counted, instance, dr.inf), dr.select(counted, weight, 0)
    result = []
    for slot, total in zip(slots[0::2], slots[1::2], strict=True):
        same, before = number == slot, number < slot
        result += [
            dr.select(before, number, slot),
            dr.select(before, weight_left, dr.select(same, total + weight_left, total)),
        ]
        # A displaced entry moves on to the next slot; a weight that was added to a slot is settled.
        number = dr.select(before, slot, dr.select(same, dr.inf, number))
        weight_left = dr.select(before, total, dr.select(same, 0, weight_left))
    return [transmittance - weight, own, left + weight_left, *result]
