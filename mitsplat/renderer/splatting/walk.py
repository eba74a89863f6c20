"""Traversal of tile lists: rays visit Gaussians front to back and blend them.

The caller defines the state of a ray: a list of numbers, the first of which is the transmittance. A function returns
the next state from a state and a Gaussian. One lane may carry several rays of a tile, because fetching a record costs
several times more than evaluating it for a packet of rays. More rays per fetch are faster until registers run out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import drjit as dr
import mitsuba as mi

from mitsplat.quality import KERNELS, Order, Quality
from mitsplat.renderer.projection.records import RECORD, GaussianRecord
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.splatting.response import exp2, min_log_opacity, respond_along
from mitsplat.renderer.splatting.tiles import TileLists

SORT_SLOTS = 8
"""Number of Gaussians that the order per ray collects in one pass over a part of a list."""

WINDOW_SLOTS = 8
"""Number of Gaussians of a list that a ray holds back for sorting."""

Pixel = list["mi.Float"]
"""State of a ray, the transmittance first."""

TRANSMITTANCE = 0
"""Index of the transmittance in the state of a ray."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of lanes, several per lane, that share a tile list.

    Attributes:
        lists: Depth-sorted Gaussians per tile.
        us, vs: Slopes of a lane's rays.
        far: Depths along z [m] behind which Gaussians are not visible.
        start, stop: Range of the lane's list.
        near: Smallest visible depth [m].
        cut, cap: Smallest and largest opacity that counts (log2); None for no largest.
        end: Transmittance at which a ray ends.
        column: True if all rays of a lane have the same slope ``us``.
    """

    lists: TileLists
    us: list[mi.Float]
    vs: list[mi.Float]
    far: list[mi.Float]
    start: mi.UInt32
    stop: mi.UInt32
    near: mi.Float
    cut: mi.Float
    cap: mi.Float | None
    end: mi.Float
    column: bool

    @classmethod
    def through(
        cls,
        lists: TileLists,
        view: CameraView,
        quality: Quality,
        slopes: tuple[list[mi.Float], list[mi.Float]],
        far: list[mi.Float],
        start: mi.UInt32,
        stop: mi.UInt32,
    ) -> Rays:
        """Create the rays of a view with the limits of a quality."""
        highest = KERNELS[quality.kernel].alpha_max
        return cls(
            lists,
            *slopes,
            far,
            start,
            stop,
            near=view.near_plane,
            cut=min_log_opacity(quality),
            cap=dr.log2(dr.opaque(mi.Float, highest)) if highest < 1 else None,
            end=dr.opaque(mi.Float, quality.transmittance_min),
            column=not view.distortion,
        )

    def respond(self, record: GaussianRecord) -> list[tuple[mi.Float, mi.Float]]:
        """Return (log2 of the opacity along the ray, depth of the peak) of one Gaussian per lane, for each ray."""
        return respond_along(record, self.lists.plane_records, self.us, self.vs, self.column, self.cap)


def walk(
    rays: Rays,
    order: Order,
    fresh: Callable[[], Pixel],
    blend: Blend,
    continues: Callable[[list[Pixel]], mi.Bool] | None = None,
) -> list[Pixel]:
    """Return the final states of rays: in the order of the tile's list, of their own peaks, or with a window.

    Args:
        rays: The rays.
        order: As in :class:`mitsplat.quality.Quality`.
        fresh: Function that returns the initial state of a ray.
        blend: Function that blends one Gaussian.
        continues: Function from the states of a lane's rays to True if the lane continues; for the order per tile.
    """
    if order == "tile":
        return _walk_in_tile_order(rays, fresh, blend, continues)
    return (_walk_in_window if order == "window" else _walk_in_ray_order)(rays, fresh, blend)


def max_of(values: Sequence[mi.Float]) -> mi.Float:
    """Return the maximum over the values of a lane's rays, none of which is NaN."""
    return reduce(lambda a, b: dr.select(a > b, a, b), values)


@dataclass(frozen=True, eq=False)
class FieldsOnAccess:
    """Fields of records that are fetched on access, because the rays of a lane blend different records.

    Attributes:
        records: View records, flat.
        number: Number of the record of each lane.
        mask: True for lanes that fetch a record.
    """

    records: mi.Float
    number: mi.UInt32
    mask: mi.Bool

    @property
    def colour(self) -> list[mi.Float]:
        """Red, green and blue."""
        return [self._field(name) for name in ("red", "green", "blue")]

    @property
    def instance(self) -> mi.Float:
        """Instance id."""
        return self._field("instance")

    def _field(self, name: str) -> mi.Float:
        return dr.gather(mi.Float, self.records, self.number * RECORD + GaussianRecord.place(name), self.mask)


Blend = Callable[[Pixel, "mi.Float", GaussianRecord | FieldsOnAccess, "mi.Float"], Pixel]
"""Function that returns the state of a ray after one more Gaussian in front-to-back order. Arguments: state, opacity of
the Gaussian on the ray, its record (for colour and instance), and depth of its peak. An opacity of 0 leaves the state
unchanged.
"""


def _walk_in_tile_order(
    rays: Rays, fresh: Callable[[], Pixel], blend: Blend, continues: Callable[[list[Pixel]], mi.Bool] | None
) -> list[Pixel]:
    """Blend in the order of the tile's list, which is that of the peaks along one of the tile's rays."""
    lists, far, near, cut, end = rays.lists, rays.far, rays.near, rays.cut, rays.end

    def body(i: mi.UInt32, pixels: list[Pixel]) -> tuple[mi.UInt32, list[Pixel]]:
        record = GaussianRecord.fetch(lists.records, dr.gather(mi.UInt32, lists.entries, i))
        blended = []
        responses = rays.respond(record)
        for pixel, (log_alpha, z), z_far in zip(pixels, responses, far, strict=True):
            hit = (log_alpha > cut) & (z > near) & (z < z_far) & (pixel[TRANSMITTANCE] > end)
            alpha, z = dr.select(hit, exp2(log_alpha), 0.0), dr.select(hit, z, 0.0)
            blended.append(blend(pixel, alpha, record, z))
        return i + 1, blended

    def alive(i: mi.UInt32, pixels: list[Pixel]) -> mi.Bool:
        unfinished = (i < rays.stop) & (max_of([pixel[TRANSMITTANCE] for pixel in pixels]) > end)
        return unfinished if continues is None else unfinished & continues(pixels)

    _, pixels = dr.while_loop((rays.start, [fresh() for _ in far]), alive, body, label="march")
    return pixels


def _walk_in_window(rays: Rays, fresh: Callable[[], Pixel], blend: Blend) -> list[Pixel]:
    """Blend in the order of the tile's list, corrected by a sorting window.

    A ray holds back its last :data:`WINDOW_SLOTS` Gaussians, sorted by their peaks along the ray. It blends the first
    one when another arrives. A Gaussian that is more places too late in the list is blended late.
    """
    lists, far, near, cut, end = rays.lists, rays.far, rays.near, rays.cut, rays.end

    def push(pixel: Pixel, window: _Slots, z: mi.Float, alpha: mi.Float, number: mi.UInt32) -> tuple[Pixel, _Slots]:
        result: _Slots = []
        for slot_z, slot_alpha, slot_number in reversed(window):
            # Peaks in front of the new one, or equal to it, move forward by one slot.
            deeper = z >= slot_z
            result.insert(
                0, (dr.maximum(z, slot_z), dr.select(deeper, alpha, slot_alpha), dr.select(deeper, number, slot_number))
            )
            alpha, number = dr.select(deeper, slot_alpha, alpha), dr.select(deeper, slot_number, number)
            z = dr.minimum(z, slot_z)
        return blend(pixel, alpha, FieldsOnAccess(lists.records, number, mi.Bool(True)), z), result

    def alive(i: mi.UInt32, pixels: list[Pixel], windows: list[_Slots]) -> mi.Bool:
        return (i < rays.stop) & (max_of([pixel[TRANSMITTANCE] for pixel in pixels]) > end)

    def body(i: mi.UInt32, pixels: list[Pixel], windows: list[_Slots]) -> tuple[mi.UInt32, list[Pixel], list[_Slots]]:
        number = dr.gather(mi.UInt32, lists.entries, i)
        record = GaussianRecord.fetch(lists.records, number)
        states = []
        for pixel, window, (log_alpha, z), z_far in zip(pixels, windows, rays.respond(record), far, strict=True):
            hit = (log_alpha > cut) & (z > near) & (z < z_far) & (pixel[TRANSMITTANCE] > end)
            state = pixel, window, z, exp2(log_alpha), number
            states.append(dr.if_stmt(state, hit, push, lambda pixel, window, *_: (pixel, window), label="push"))
        return i + 1, [pixel for pixel, _ in states], [window for _, window in states]

    # An empty slot has depth 0, in front of all peaks, and opacity 0.
    empty = [[(mi.Float(0), mi.Float(0), mi.UInt32(0)) for _ in range(WINDOW_SLOTS)] for _ in far]
    state = mi.UInt32(rays.start), [fresh() for _ in far], empty
    _, pixels, windows = dr.while_loop(state, alive, body, label="march in a window")
    ends = []
    for pixel, window in zip(pixels, windows, strict=True):
        for z, alpha, number in window:
            seen = (alpha > 0) & (pixel[TRANSMITTANCE] > end)
            pixel = blend(pixel, dr.select(seen, alpha, 0.0), FieldsOnAccess(lists.records, number, seen), z)
        ends.append(pixel)
    return ends


def _walk_in_ray_order(rays: Rays, fresh: Callable[[], Pixel], blend: Blend) -> list[Pixel]:
    """Blend in the exact order of the peaks along each ray.

    Each pass collects the next :data:`SORT_SLOTS` peaks behind the last one blended. It ends where no later entry can
    have a peak in front of those. The next pass begins at the first entry that found no slot. Each pass therefore
    covers a short part of the list, and any number of Gaussians in any order is blended correctly. Equal depths keep
    the list's order.
    """

    def one_pass(
        pixels: list[Pixel], last: list[_Peak], begin: mi.UInt32, seen: mi.UInt32, active: mi.Bool
    ) -> tuple[list[Pixel], list[_Peak], mi.UInt32, mi.UInt32, mi.Bool]:
        limit = dr.select(active, rays.stop, begin)
        reached, slots, left = _collect_peaks(rays, begin, limit, seen, last)
        blended, new_last, unfinished, next_begin = [], [], mi.Bool(False), mi.UInt32(reached)
        for pixel, own, first_left, (last_z, last_i) in zip(pixels, slots, left, last, strict=True):
            pixel = _blend_slots(rays, pixel, own, active, blend)
            # A ray that has ended gets infinity as its last depth, behind which no peak lies.
            open_ray = pixel[TRANSMITTANCE] > rays.end
            z, _, i = own[-1]
            last_i = dr.select(z < last_z, last_i, i)
            blended.append(pixel)
            new_last.append((dr.select(open_ray, dr.maximum(z, last_z), dr.inf), last_i))
            next_begin = dr.select(open_ray, dr.minimum(next_begin, first_left), next_begin)
            unfinished |= open_ray & ((first_left != _NO_ENTRY) | (reached < rays.stop))
        return blended, new_last, next_begin, dr.maximum(seen, reached), active & unfinished

    state = (
        [fresh() for _ in rays.far],
        [(mi.Float(-dr.inf), mi.UInt32(0)) for _ in rays.far],
        mi.UInt32(rays.start),
        mi.UInt32(rays.start),
        rays.start < rays.stop,
    )
    pixels, *_ = dr.while_loop(state, lambda *state: state[-1], one_pass, label="march by ray")
    return pixels


def _collect_peaks(
    rays: Rays, begin: mi.UInt32, limit: mi.UInt32, seen: mi.UInt32, last: list[_Peak]
) -> tuple[mi.UInt32, list[_Slots], list[mi.UInt32]]:
    """Collect the next peaks of each ray from the entries ``begin`` to ``limit`` (exclusive).

    Args:
        rays: The rays.
        begin: First entry of each lane.
        limit: End of each lane's entries.
        seen: First entry that no earlier pass has visited.
        last: Last peak blended on each ray.

    Returns:
        The entry at which the lane stopped; and for each ray, its filled slots and the first entry that found no slot
        (:data:`_NO_ENTRY` if all did).
    """
    lists = rays.lists

    def unfilled(i: mi.UInt32, slots: list[_Slots], left: list[mi.UInt32]) -> mi.Bool:
        nearest = dr.gather(mi.Float, lists.nearest, i, i < limit)
        wanted = mi.Bool(False)
        for own in slots:
            wanted |= nearest <= own[-1][0]
        return (i < limit) & wanted

    def one_entry(
        i: mi.UInt32, slots: list[_Slots], left: list[mi.UInt32]
    ) -> tuple[mi.UInt32, list[_Slots], list[mi.UInt32]]:
        record = GaussianRecord.fetch(lists.records, dr.gather(mi.UInt32, lists.entries, i))
        new_slots, new_left = [], []
        responses = rays.respond(record)
        for (log_alpha, z), own, first_left, z_far, (last_z, last_i) in zip(
            responses, slots, left, rays.far, last, strict=True
        ):
            # An entry not visited before always counts, because rounding may put its peak in front of its bound.
            new = (z > last_z) | ((z == last_z) & (i > last_i)) | (i >= seen)
            hit = (log_alpha > rays.cut) & (z > rays.near) & (z < z_far) & new
            own, first_left = dr.if_stmt(
                (own, first_left, z, exp2(log_alpha), mi.UInt32(i)),
                hit,
                _insert_peak,
                lambda own, first_left, *_: (own, first_left),
                label="insert",
            )
            new_slots.append(own)
            new_left.append(first_left)
        return i + 1, new_slots, new_left

    empty = [[(mi.Float(dr.inf), mi.Float(0), mi.UInt32(0)) for _ in range(SORT_SLOTS)] for _ in rays.far]
    state = mi.UInt32(begin), empty, [mi.UInt32(_NO_ENTRY) for _ in rays.far]
    i, slots, left = dr.while_loop(state, unfilled, one_entry, label="collect")
    return i, slots, left


def _insert_peak(
    slots: _Slots, left: mi.UInt32, z: mi.Float, alpha: mi.Float, i: mi.UInt32
) -> tuple[_Slots, mi.UInt32]:
    """Insert the peak of entry ``i`` into depth-sorted slots; ``left`` is the first entry that found no slot."""
    result: _Slots = []
    behind = mi.Bool(False)
    for slot_z, slot_alpha, slot_i in slots:
        # Peaks behind the new one move back by one slot; equal depths keep their order.
        behind |= z < slot_z
        result.append((dr.minimum(z, slot_z), dr.select(behind, alpha, slot_alpha), dr.select(behind, i, slot_i)))
        z, alpha, i = dr.maximum(z, slot_z), dr.select(behind, slot_alpha, alpha), dr.select(behind, slot_i, i)
    return result, dr.select(z < dr.inf, dr.minimum(left, i), left)


def _blend_slots(rays: Rays, pixel: Pixel, slots: _Slots, active: mi.Bool, blend: Blend) -> Pixel:
    """Blend the collected peaks of an ``active`` ray until it ends."""
    for z, alpha, i in slots:
        found = active & (z < dr.inf) & (pixel[TRANSMITTANCE] > rays.end)
        number = dr.gather(mi.UInt32, rays.lists.entries, i, found)
        record = FieldsOnAccess(rays.lists.records, number, found)
        z = dr.select(found, z, 0.0)  # an empty slot lies at infinity, and 0 * inf is NaN
        pixel = blend(pixel, dr.select(found, alpha, 0.0), record, z)
    return pixel


_NO_ENTRY = 0xFFFFFFFF
"""Number that stands for no entry of a list."""

_Peak = tuple["mi.Float", "mi.UInt32"]
"""Depth and entry of a peak."""

_Slots = list[tuple["mi.Float", "mi.Float", "mi.UInt32"]]
"""Depth-sorted peaks: depth, opacity and entry."""
