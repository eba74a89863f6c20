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
from mitsplat.renderer.projection.records import RECORD, GaussianRecord, PlaneRecord
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.splatting.tiles import TileLists

SORT_SLOTS = 8
"""Number of Gaussians that the order per ray collects in one walk over a part of a list."""

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
        return respond_along(record, self.lists, self.us, self.vs, self.column, self.cap)


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


def min_log_opacity(quality: Quality) -> mi.Float:
    """Return log2 of the smallest opacity that counts, limited to the domain of :func:`exp2`."""
    return dr.maximum(dr.log2(dr.opaque(mi.Float, quality.alpha_min)), -126)


def exp2(x: mi.Float) -> mi.Float:
    """Compute 2^x for x in [-126, 126] with relative error below 2e-7; the result is undefined outside.

    On a CPU, the nearest integer is added to the exponent, and a polynomial that is 1 at 0 covers the remainder. This
    takes half of the instructions of Dr.Jit's own function, which has no limits. A GPU has one instruction for it.
    """
    if dr.backend_v(x) == dr.JitBackend.CUDA:
        return dr.exp2(x)
    rounded = x + _ROUNDS
    rest = x - (rounded - _ROUNDS)
    power = mi.Float(_EXP2[-1])
    for coefficient in reversed(_EXP2[:-1]):
        power = dr.fma(power, rest, coefficient)
    exponent = dr.reinterpret_array(mi.UInt32, rounded) << 23
    return dr.reinterpret_array(mi.Float, dr.reinterpret_array(mi.UInt32, power) + exponent)


_ROUNDS = 1.5 * 2.0**23
"""Float whose addition rounds a number to an integer, stored in the low bits of the sum."""

_EXP2 = 1.0, 0.69314700, 0.24022242, 0.055507336, 0.0096715130, 0.0013264727
"""Polynomial coefficients of 2^x on [-1/2, 1/2] with the smallest relative error."""


@dataclass(frozen=True, eq=False)
class FieldsOnAccess:
    """Fields of records that are fetched on access, because the rays of a lane blend different records."""

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


def respond_along(
    record: GaussianRecord,
    lists: TileLists,
    us: list[mi.Float],
    vs: list[mi.Float],
    shared_column: bool,
    cap: mi.Float | None,
) -> list[tuple[mi.Float, mi.Float]]:
    """Return (log2 of the opacity along the ray, peak depth) of a Gaussian on several rays, see `gaussian`."""
    u0, v0, a, b2, c, opacity, *_, depth, e, f, g, h, i, _ = record
    result: list[mi.Float] = []
    previous: tuple[mi.Float, ...] | None = None
    slant = 0.5 * depth * f
    for u, v in zip(us, vs, strict=True):
        if previous is None or not shared_column:
            du = u - u0
            ahead = depth * dr.fma(0.5 * du, e, 1)
            previous = a * du * du, b2 * du, dr.fma(du, dr.fma(du, g, e), 1), dr.fma(du, h, f), ahead
        top, top_v, bottom, bottom_v, ahead = previous
        dv = v - v0
        numerator = dr.fma(dv, dr.fma(dv, c, top_v), top)
        inverse = dr.rcp(dr.fma(dv, dr.fma(dv, i, bottom_v), bottom))
        result += [dr.fma(-numerator, inverse, opacity), dr.fma(dv, slant, ahead) * inverse]

    def at_the_camera(result: list[mi.Float], row: mi.Float) -> tuple[list[mi.Float], mi.Float]:
        plane_record = PlaneRecord.fetch(lists.plane_records, mi.UInt32(row))
        found: list[mi.Float] = []
        for u, v in zip(us, vs, strict=True):
            q, depth = plane_record.respond(u, v)
            found += [opacity - q, depth]
        return found, row

    if lists.plane_records is not None:
        result, _ = dr.if_stmt(
            (result, u0), a < 0, at_the_camera, lambda result, row: (result, row), label="gaussian at the camera"
        )
    # Rounding can raise the response of a needle-shaped Gaussian above its peak by any factor.
    most = opacity if cap is None else dr.minimum(opacity, cap)
    log_alphas = [dr.select(log_alpha > most, most, log_alpha) for log_alpha in result[0::2]]
    return list(zip(log_alphas, result[1::2], strict=True))


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
                0,
                (
                    dr.maximum(z, slot_z),
                    dr.select(deeper, alpha, slot_alpha),
                    dr.select(deeper, number, slot_number),
                ),
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

    Each walk collects the next :data:`SORT_SLOTS` peaks behind the last one blended. It ends where no later entry can
    have a peak in front of those. The next walk begins at the first entry that found no slot. Each walk therefore
    covers a short part of the list, and any number of Gaussians in any order is blended correctly. Equal depths keep
    the list's order.
    """
    lists, start, stop, far = rays.lists, rays.start, rays.stop, rays.far
    near, cut, end = rays.near, rays.cut, rays.end
    none = 0xFFFFFFFF

    def insert(slots: _Slots, left: mi.UInt32, z: mi.Float, alpha: mi.Float, i: mi.UInt32) -> tuple[_Slots, mi.UInt32]:
        """Return the depth-sorted slots with one more peak, and the first entry that found no slot."""
        result: _Slots = []
        behind = mi.Bool(False)
        for slot_z, slot_alpha, slot_i in slots:
            # Peaks behind the new one move back by one slot; equal depths keep their order.
            behind |= z < slot_z
            result.append((dr.minimum(z, slot_z), dr.select(behind, alpha, slot_alpha), dr.select(behind, i, slot_i)))
            z, alpha, i = dr.maximum(z, slot_z), dr.select(behind, slot_alpha, alpha), dr.select(behind, slot_i, i)
        return result, dr.select(z < dr.inf, dr.minimum(left, i), left)

    def collect(
        begin: mi.UInt32, limit: mi.UInt32, seen: mi.UInt32, last: list[tuple[mi.Float, mi.UInt32]]
    ) -> tuple[mi.UInt32, list[_Slots], list[mi.UInt32]]:
        def unfilled(i: mi.UInt32, slots: list[_Slots], left: list[mi.UInt32]) -> mi.Bool:
            nearest = dr.gather(mi.Float, lists.nearest, i, i < limit)
            wanted = mi.Bool(False)
            for own in slots:
                wanted |= nearest <= own[-1][0]
            return (i < limit) & wanted

        def body(
            i: mi.UInt32, slots: list[_Slots], left: list[mi.UInt32]
        ) -> tuple[mi.UInt32, list[_Slots], list[mi.UInt32]]:
            record = GaussianRecord.fetch(lists.records, dr.gather(mi.UInt32, lists.entries, i))
            new_slots, new_left = [], []
            responses = rays.respond(record)
            for (log_alpha, z), own, first_left, z_far, (last_z, last_i) in zip(
                responses, slots, left, far, last, strict=True
            ):
                # An entry not visited before always counts, because rounding may put its peak in front of its bound.
                new = (z > last_z) | ((z == last_z) & (i > last_i)) | (i >= seen)
                hit = (log_alpha > cut) & (z > near) & (z < z_far) & new
                own, first_left = dr.if_stmt(
                    (own, first_left, z, exp2(log_alpha), mi.UInt32(i)),
                    hit,
                    insert,
                    lambda own, first_left, *_: (own, first_left),
                    label="insert",
                )
                new_slots.append(own)
                new_left.append(first_left)
            return i + 1, new_slots, new_left

        def empty() -> _Slots:
            return [(mi.Float(dr.inf), mi.Float(0), mi.UInt32(0)) for _ in range(SORT_SLOTS)]

        state = mi.UInt32(begin), [empty() for _ in far], [mi.UInt32(none) for _ in far]
        i, slots, left = dr.while_loop(state, unfilled, body, label="collect")
        return i, slots, left

    def body(
        pixels: list[Pixel], last: list[tuple[mi.Float, mi.UInt32]], begin: mi.UInt32, seen: mi.UInt32, active: mi.Bool
    ) -> tuple[list[Pixel], list[tuple[mi.Float, mi.UInt32]], mi.UInt32, mi.UInt32, mi.Bool]:
        reached, slots, left = collect(begin, dr.select(active, stop, begin), seen, last)
        blended, new_last, unfinished, next_begin = [], [], mi.Bool(False), mi.UInt32(reached)
        for pixel, own, first_left, (last_z, last_i) in zip(pixels, slots, left, last, strict=True):
            for z, alpha, i in own:
                found = active & (z < dr.inf) & (pixel[TRANSMITTANCE] > end)
                number = dr.gather(mi.UInt32, lists.entries, i, found)
                record = FieldsOnAccess(lists.records, number, found)
                z = dr.select(found, z, 0.0)  # an empty slot lies at infinity, and 0 * inf is NaN
                pixel = blend(pixel, dr.select(found, alpha, 0.0), record, z)
            # A ray that has ended gets infinity as its last depth, behind which no peak lies.
            open_ray = pixel[TRANSMITTANCE] > end
            z, _, i = own[-1]
            last_i = dr.select(z < last_z, last_i, i)
            blended.append(pixel)
            new_last.append((dr.select(open_ray, dr.maximum(z, last_z), dr.inf), last_i))
            next_begin = dr.select(open_ray, dr.minimum(next_begin, first_left), next_begin)
            unfinished |= open_ray & ((first_left != none) | (reached < stop))
        return blended, new_last, next_begin, dr.maximum(seen, reached), active & unfinished

    state = (
        [fresh() for _ in far],
        [(mi.Float(-dr.inf), mi.UInt32(0)) for _ in far],
        mi.UInt32(start),
        mi.UInt32(start),
        start < stop,
    )
    pixels, *_ = dr.while_loop(state, lambda *state: state[-1], body, label="march by ray")
    return pixels


_Slots = list[tuple["mi.Float", "mi.Float", "mi.UInt32"]]
"""Depth-sorted peaks: depth, opacity and entry."""
