"""From clouds of Gaussians to depth-sorted lists per image tile, all on the device.

1. *Cull* every Gaussian of every placement by the exact screen box of its cut-off ellipsoid (one kernel).
2. *Project* what is left to view records (one kernel), see :mod:`mitsplat.plugins.project`.
3. *Pair* each with the tiles that its cut-off ellipse really meets: the ellipse cuts a span out of every row of tiles.
4. *Sort* the pairs by tile and by depth there. For the order per tile that is the peak's depth along the ray
   around which the tile sees most of the Gaussian; for the order per ray it is a lower bound over all rays of the tile,
   which says when a ray has seen all that can come first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.errors import MissingResourceError
from mitsplat.plugins.chosen import ChosenTiles, TileBox
from mitsplat.plugins.device import concatenated
from mitsplat.plugins.gaussian import LOG2_E_HALF, RECORD, conic_touches_rectangle, ellipse_spans
from mitsplat.plugins.project import CloudSet, Placement, Projector, placement_table
from mitsplat.plugins.rays import View
from mitsplat.quality import Quality

NUMBER_BITS = 26
"""Bits of the number of a record or pair in what pairs are sorted by."""

PAIRS_MAX = 1 << NUMBER_BITS
"""Most pairs of a Gaussian and a tile that are held at once, about 40 bytes each."""

DEPTH_BITS = 16
"""Bits of a depth that pairs are sorted by: 11 of its mantissa tell depths apart that differ by 0.05 %, and 5 of its
exponent those up to 2^32 times the near plane. Equals stay in the order of the clouds."""

TILES_MAX = 1 << (64 - DEPTH_BITS - NUMBER_BITS)
"""Most tiles of a view."""


class CrowdedError(MissingResourceError):
    """A view has more pairs than :data:`PAIRS_MAX`, or tiles than :data:`TILES_MAX`: render a part of it."""

    def __init__(self) -> None:
        super().__init__(
            "the splats cover too much of the image for the memory: render a smaller image, or split the splats"
        )


@dataclass(frozen=True, eq=False)
class TileLists:
    """Depth-sorted Gaussians of every tile.

    Attributes:
        records: View records, see :data:`mitsplat.plugins.gaussian.RECORD`.
        near: Coefficients of :func:`mitsplat.plugins.gaussian.general_response`, 16 floats each, of the Gaussians that
            reach the camera's plane, or None; their records hold -1 for A and the row's number for u0.
        entries: Record numbers, tile after tile.
        slots: Place of every entry if they were sorted by record number instead; of lists that are for gradients.
        first: First of those places of each record, and the number of entries; of the same.
        nearest: Least depth [m] that an entry's peak can have in its tile, ascending per tile; for the order per ray.
        start, stop: Range of each tile in ``entries``.
        visible, pairs: Number of records and of entries.
        instance: Id of all of them, or None if they have several.
        levels: What entries are sorted by in their tile.
        tiles: Numbers of the tiles whose ranges these are; None for all of the view's.
        least: Depth [m] in front of which no peak of each record lies, for tiles that are sorted again.
    """

    records: Any
    near: Any | None
    entries: Any
    slots: Any
    first: Any
    nearest: Any
    start: Any
    stop: Any
    visible: int
    pairs: int
    instance: int | None
    levels: Any
    tiles: Any | None = None
    least: Any | None = None


def bin_gaussians(
    clouds: CloudSet,
    placements: Sequence[Placement],
    view: View,
    quality: Quality,
    *,
    at_camera: bool = True,
    chosen: ChosenTiles | TileBox | None = None,
    fitted: bool = False,
    for_gradients: bool = False,
) -> TileLists:
    """Tile lists of all placements seen by one camera, for a view from :meth:`View.sampled`.

    Args:
        clouds: Gaussians on the device.
        placements: Where they are.
        view: The camera.
        quality: Order, cut-offs and kernel.
        at_camera: Whether Gaussians that reach the camera's plane are seen.
        chosen: The only tiles that have lists; all of the view's if None.
        fitted: Whether only the tiles in a box around all that is seen have lists.
        for_gradients: Whether entries are to be known by record too.

    Raises:
        CrowdedError: If the view has too many pairs to hold.
    """
    table, owner, local = placement_table(clouds, placements, view)
    if dr.width(local) == 0:
        return _empty(view, chosen)
    changed = any(placement.appearance is not None for placement in placements)
    source = Projector(clouds, table, view, quality, at_camera, changed)

    visible, near = source.cull(owner, local, chosen)
    index = dr.compress(visible)
    if dr.width(index) == 0:
        return _empty(view, chosen)
    owner, local = dr.gather(mi.UInt32, owner, index), dr.gather(mi.UInt32, local, index)
    near = dr.gather(mi.Bool, near, index)
    dr.eval(owner, local, near)

    records, near_rows, least, box = source.records(owner, local, near)
    ids = {placement.instance for placement in placements}
    only = ids.pop() if len(ids) == 1 else None
    if fitted:
        chosen = TileBox.around(box, view)
    return bin_records(records, near_rows, least, box, view, quality, only, chosen, for_gradients=for_gradients)


def bin_records(
    records: Any,
    near: Any,
    least: Any,
    box: Any,
    view: View,
    quality: Quality,
    only: int | None,
    chosen: ChosenTiles | TileBox | None = None,
    *,
    for_gradients: bool = False,
) -> TileLists:
    """Tile lists of view records, from least depths and boxes of tiles; ``only`` is the id of all, if there is one.

    Raises:
        CrowdedError: If there are too many pairs to hold.
    """
    pairs = _pair(dr.detach(records), least, box, view, quality, chosen, for_gradients)
    if pairs is None:
        return _empty(view, chosen, records)
    tiles, own = _numbered(view, chosen)
    return _listed(records, near, pairs, least, dr.width(least), tiles, view, only, own)


def _listed(
    records: Any,
    near: Any,
    pairs: _Pairs,
    least: Any,
    visible: int,
    tiles: int,
    view: View,
    only: int | None,
    own: Any = None,
) -> TileLists:
    """Lists of pairs by tile and depth. Levels and least depths are evaluated where they are used."""
    count = dr.width(pairs.key)
    # As many bits as numbers of all tiles have, so that lists of a few need no kernels of their own.
    key = _sorted(pairs.key, DEPTH_BITS + max(1, (view.tiles_x * view.tiles_y - 1).bit_length()))
    number, tile = mi.UInt32(key & ((1 << NUMBER_BITS) - 1)), dr.arange(mi.UInt32, tiles)
    slots, entries = (None, number) if pairs.record is None else (number, dr.gather(mi.UInt32, pairs.record, number))
    begins = _first_entries(key, tiles)
    start, stop = dr.gather(mi.UInt32, begins, tile), dr.gather(mi.UInt32, begins, tile + 1)
    dr.eval(entries, slots, start, stop)
    levels = mi.UInt32(key >> NUMBER_BITS) & ((1 << DEPTH_BITS) - 1)
    return TileLists(
        records=records,
        near=near,
        entries=entries,
        slots=slots,
        first=pairs.first,
        levels=levels,
        nearest=_depth_of_level(levels, view),
        start=start,
        stop=stop,
        least=least,
        visible=visible,
        pairs=count,
        instance=only,
        tiles=own,
    )


def _numbered(view: View, chosen: ChosenTiles | TileBox | None) -> tuple[int, Any]:
    """How many tiles have lists, and their numbers in the view unless they are all of it."""
    return (view.tiles_x * view.tiles_y, None) if chosen is None else (chosen.count, chosen.number)


def _empty(view: View, chosen: ChosenTiles | TileBox | None, records: Any | None = None) -> TileLists:
    tiles, own = _numbered(view, chosen)
    zeros = dr.zeros(mi.UInt32, tiles)
    dr.eval(zeros)
    entry = dr.zeros(mi.UInt32, 1)
    visible = 0 if records is None else dr.width(records) // RECORD
    records = dr.zeros(mi.Float, RECORD) if records is None else records
    none = dr.zeros(mi.Float, max(visible, 1))
    return TileLists(records, None, entry, entry, entry, none, zeros, zeros, visible, 0, None, entry, own, none)


def merge_lists(first: TileLists, second: TileLists, tiles: Any, view: View) -> TileLists:
    """The lists of some tiles of a view with the Gaussians of both, as if they had been binned together.

    Raises:
        CrowdedError: If there are too many pairs to hold.
    """
    visible = dr.width(first.records) // RECORD
    both = [p for p in (_pairs_in(first, tiles, 0), _pairs_in(second, tiles, visible)) if p is not None]
    pairs = _Pairs(_Pairs.key_of(*(concatenated(parts) for parts in zip(*both, strict=True))))
    dr.eval(pairs.key)
    records, near = second.records, second.near
    if near is not None and first.near is not None:
        # The rows of the second follow those of the first.
        row, before = dr.arange(mi.UInt32, second.visible) * RECORD, dr.opaque(mi.Float, dr.width(first.near) // RECORD)
        shifted, at_camera = dr.copy(records), dr.gather(mi.Float, records, row + 2) < 0
        dr.scatter(shifted, dr.gather(mi.Float, records, row) + before, row, at_camera)
        records, near = shifted, concatenated([first.near, near])
    records = concatenated([first.records, records])
    near = first.near if near is None else near
    least = concatenated([first.least, second.least])
    return _listed(records, near, pairs, least, visible + second.visible, dr.width(tiles), view, None, tiles)


def some_tiles(lists: TileLists, chosen: Any) -> TileLists:
    """The lists of some tiles by their places, as they are."""
    tiles = chosen if lists.tiles is None else dr.gather(mi.UInt32, lists.tiles, chosen)
    start, stop = dr.gather(mi.UInt32, lists.start, chosen), dr.gather(mi.UInt32, lists.stop, chosen)
    dr.eval(tiles, start, stop)
    return replace(lists, start=start, stop=stop, tiles=tiles)


def in_ray_order(lists: TileLists, chosen: Any, view: View) -> TileLists:
    """Some tiles of a view by their places in ``lists``, none of them empty, sorted for the order per ray."""
    place, _, number = cast("tuple[Any, Any, Any]", _pairs_in(lists, chosen, 0))
    tiles = chosen if lists.tiles is None else dr.gather(mi.UInt32, lists.tiles, chosen)
    record = dr.gather(mi.ArrayXf, dr.detach(lists.records), number, shape=(RECORD, dr.width(number)))
    slopes = view.tile_slopes(dr.gather(mi.UInt32, tiles, place))
    level = _level(_least_depth(record, dr.gather(mi.Float, lists.least, number), slopes), view)
    again, count = _Pairs(_Pairs.key_of(place, level, number)), dr.width(tiles)
    dr.eval(again.key)
    return _listed(lists.records, lists.near, again, lists.least, lists.visible, count, view, lists.instance, tiles)


def _pairs_in(lists: TileLists, tiles: Any, shift: int) -> tuple[Any, Any, Any] | None:
    """Places in ``tiles``, levels, and records (from ``shift`` on) of the entries of some tiles; None if none."""
    start = dr.gather(mi.UInt32, lists.start, tiles)
    length = dr.gather(mi.UInt32, lists.stop, tiles) - start
    begin, size = prefix_ranges(length)
    if size == 0:
        return None
    number, place, level = (dr.empty(mi.UInt32, size) for _ in range(3))
    offset, own = dr.opaque(mi.UInt32, shift), dr.arange(mi.UInt32, dr.width(tiles))

    def one_pair(k: Any) -> tuple[Any]:
        entry, at = start + k, begin + k
        dr.scatter(number, dr.gather(mi.UInt32, lists.entries, entry) + offset, at, mode=dr.ReduceMode.Permute)
        dr.scatter(place, own, at, mode=dr.ReduceMode.Permute)
        dr.scatter(level, dr.gather(mi.UInt32, lists.levels, entry), at, mode=dr.ReduceMode.Permute)
        return (k + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, dr.width(tiles)),), lambda k: k < length, one_pair, label="merge")
    dr.eval(place, level, number)
    return place, level, number


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of a record and a tile, record after record.

    Attributes:
        key: What they are sorted by, see :meth:`key_of`.
        record: Number of each one's record, of pairs that are numbered themselves.
        first: First pair of each record, and the number of pairs; of the same.
    """

    key: Any
    record: Any | None = None
    first: Any | None = None

    @staticmethod
    def key_of(tile: Any, level: Any, number: Any) -> Any:
        """Tile, level of depth, and the number of the record, or of the pair, in one."""
        return mi.UInt64(tile) << (DEPTH_BITS + NUMBER_BITS) | mi.UInt64(level) << NUMBER_BITS | mi.UInt64(number)


def _pair(
    records: Any,
    least: Any,
    box: Any,
    view: View,
    quality: Quality,
    chosen: ChosenTiles | TileBox | None,
    numbered: bool,
) -> _Pairs | None:
    """Pairs of every record with the tiles it meets, by their places among the chosen ones; None if there are none.

    Raises:
        CrowdedError: If there are more than :data:`PAIRS_MAX`, or their keys have no room for tiles or records.
    """
    count = dr.width(least)
    if count > 1 << NUMBER_BITS or view.tiles_x * view.tiles_y > TILES_MAX:
        raise CrowdedError
    order = dr.arange(mi.UInt32, count)
    x0, x1, y0, y1 = dr.gather(mi.Array4u, box, order)
    row_of, rows = prefix_ranges(dr.select(y1 > y0, y1 - y0, 0))
    if rows == 0:
        return None
    # Rows first: one lane finds the spans of one record, and then one lane fills one span.
    record = dr.gather(mi.ArrayXf, records, order, shape=(RECORD, count))
    cut = dr.log2(dr.opaque(mi.Float, quality.alpha_min))
    owner, first_tile = dr.empty(mi.UInt32, rows), dr.empty(mi.UInt32, rows)
    length = dr.empty(mi.UInt32, rows)
    span_of = _spans(record, cut, x0, x1, view)

    def one_row(y: Any) -> tuple[Any]:
        lo, hi = span_of(y)
        row = row_of + (y - y0)
        begin, size = y * view.tiles_x + lo, dr.select(hi > lo, hi - lo, 0)
        if chosen is not None:
            begin, size = chosen.among(begin, size)
        dr.scatter(owner, order, row, mode=dr.ReduceMode.Permute)
        dr.scatter(first_tile, begin, row, mode=dr.ReduceMode.Permute)
        dr.scatter(length, size, row, mode=dr.ReduceMode.Permute)
        return (y + 1,)

    dr.while_loop((mi.UInt32(y0),), lambda y: y < y1, one_row, label="spans of tiles")
    dr.eval(owner, first_tile, length)
    pair_of, pairs = prefix_ranges(length)
    if pairs == 0:
        return None
    record = dr.gather(mi.ArrayXf, records, owner, shape=(RECORD, rows))
    ellipsoid = dr.gather(mi.Float, least, owner)
    key, number = dr.empty(mi.UInt64, pairs), dr.empty(mi.UInt32, pairs) if numbered else None

    def in_view(tile: Any, active: Any = True) -> Any:
        return tile if chosen is None else dr.gather(mi.UInt32, chosen.number, tile, active)

    depth_of = _depths(record, ellipsoid, in_view(first_tile, length > 0), view, quality)

    def one_tile(k: Any) -> tuple[Any]:
        tile, pair = first_tile + k, pair_of + k
        depth = depth_of(in_view(tile))
        own = _Pairs.key_of(tile, _level(depth, view), pair if numbered else owner)
        dr.scatter(key, own, pair, mode=dr.ReduceMode.Permute)
        if numbered:
            dr.scatter(number, owner, pair, mode=dr.ReduceMode.Permute)
        return (k + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, rows),), lambda k: k < length, one_tile, label="pairs")
    if not numbered:
        dr.eval(key)
        return _Pairs(key)
    first = dr.empty(mi.UInt32, count + 1)
    end, inside = dr.opaque(mi.UInt32, pairs), row_of < dr.opaque(mi.UInt32, rows)
    dr.scatter(first, dr.select(inside, dr.gather(mi.UInt32, pair_of, row_of, inside), end), order)
    dr.scatter(first, end, dr.opaque(mi.UInt32, count))
    dr.eval(key, number, first)
    return _Pairs(key, number, first)


def prefix_ranges(sizes: Any) -> tuple[Any, int]:
    """Where each of consecutive ranges begins, and their whole size.

    Raises:
        CrowdedError: If that is more than :data:`PAIRS_MAX`.
    """
    begin, last = dr.prefix_sum(sizes), dr.width(sizes) - 1
    whole = dr.gather(mi.UInt32, begin, last) + dr.gather(mi.UInt32, sizes, last)
    # Added as floats too, because a sum of integers would wrap.
    rough = mi.UInt32(dr.minimum(dr.sum(mi.Float(sizes)), 2.0 * PAIRS_MAX))
    total, rough = np.array(dr.concat([whole, rough])).tolist()
    if rough > PAIRS_MAX:
        raise CrowdedError
    return begin, total


def _spans(record: Any, cut: Any, x0: Any, x1: Any, view: View) -> Callable[[Any], tuple[Any, Any]]:
    """Function from a row of tiles to the half-open range of its tiles that a record's cut-off ellipse meets.

    Gaussians at the camera's plane take their whole box. Under lens distortion, rows are no bands of slopes: the tiles
    of the box are tried one by one.
    """
    u0, v0, a, b2, c, opacity, _, _, _, _, e, f, g, h, i, _ = record
    k2 = opacity - cut
    conic = a - k2 * g, b2 - k2 * h, c - k2 * i, -k2 * e, -k2 * f, -k2
    whole = a < 0
    if not view.distortion:
        span_between = ellipse_spans(conic)
        _, (first_v, step_v, height) = view.tile_grid()

    def straight(y: Any) -> tuple[Any, Any]:
        dv = dr.fma(mi.Float(y), step_v, first_v) - v0
        lo_u, hi_u, meets = span_between(dv - 0.5 * height, dv + 0.5 * height)
        lo, hi = view.tile_columns(u0 + lo_u, u0 + hi_u)
        lo, hi = dr.maximum(lo, x0), dr.minimum(dr.select(meets, hi, 0), x1)
        return dr.select(whole, x0, lo), dr.select(whole, x1, hi)

    def distorted(y: Any) -> tuple[Any, Any]:
        def one_tile(x: Any, lo: Any, hi: Any) -> tuple[Any, Any, Any]:
            lo_u, hi_u, lo_v, hi_v = view.tile_slopes(y * view.tiles_x + x)
            meets = whole | conic_touches_rectangle(conic, lo_u - u0, hi_u - u0, lo_v - v0, hi_v - v0)
            return x + 1, dr.select(meets, dr.minimum(lo, x), lo), dr.select(meets, x + 1, hi)

        _, lo, hi = dr.while_loop(
            (mi.UInt32(x0), mi.UInt32(x1), mi.UInt32(x0)), lambda x, lo, hi: x < x1, one_tile, label="tiles of a row"
        )
        return lo, hi

    return distorted if view.distortion else straight


def stable_order(key: Any, bits: int) -> Any:
    """Stable order of keys of so many bits: positions in ``key``.

    A radix sort like Dr.Jit's own, which knows no keys shorter than 32 bits.
    """
    count, order = dr.width(key), None
    radix = 16 if dr.backend_v(key) == dr.JitBackend.LLVM else 8
    passes = -(-bits // radix)
    width = -(-bits // passes)
    for shift in range(0, bits, width):
        digit = mi.UInt32((key if order is None else dr.gather(type(key), key, order)) >> shift) & ((1 << width) - 1)
        dr.eval(digit)
        permutation = dr.detail.block_mkperm(digit, count, 1 << width)
        order = permutation if order is None else dr.gather(mi.UInt32, order, permutation)
        dr.eval(order)
    return order


def _sorted(key: Any, bits: int) -> Any:
    """Keys (UInt64, evaluated) of pairs by their leading ``bits``, above their numbers, by which they ascend already.

    On a CPU, where NumPy sorts several of them with each instruction, in their own memory.
    """
    if dr.backend_v(key) == dr.JitBackend.LLVM:
        sort_in_threads(key.numpy(), min(8, max(1, dr.thread_count() // 2)))
        return key
    in_order = dr.gather(mi.UInt64, key, stable_order(key >> NUMBER_BITS, bits))
    dr.eval(in_order)
    return in_order


def sort_in_threads(values: np.ndarray, threads: int) -> None:
    """Sort in place, by halves in several threads where that is worth it: all of them take more time than one alone."""
    if threads == 1 or len(values) < 1 << 16:
        values.sort()
        return
    middle = len(values) // 2
    values.partition(middle)
    with ThreadPoolExecutor(1) as pool:
        half = pool.submit(sort_in_threads, values[:middle], threads // 2)
        sort_in_threads(values[middle:], threads - threads // 2)
        half.result()


def _first_entries(key: Any, tiles: int) -> Any:
    """Number of the first entry of every tile, and of all entries, by bisection of sorted keys."""
    wanted = _Pairs.key_of(dr.arange(mi.UInt32, tiles + 1), mi.UInt32(0), mi.UInt32(0))
    pairs = dr.opaque(mi.UInt32, dr.width(key))

    def halve(low: Any, high: Any) -> tuple[Any, Any]:
        middle = (low + high) // 2
        before = dr.gather(mi.UInt64, key, middle, low < high) < wanted
        return dr.select(before, middle + 1, low), dr.select(before, high, middle)

    state = dr.zeros(mi.UInt32, tiles + 1), pairs + dr.zeros(mi.UInt32, tiles + 1)
    first, _ = dr.while_loop(state, lambda low, high: low < high, halve, label="first entries")
    dr.eval(first)
    return first


def _level(depth: Any, view: View) -> Any:
    """Sort key of a depth: the leading bits of its ratio to the near plane, which grow with it."""
    ratio = dr.clip(depth / view.near_plane, 1.0, 0.9999 * 2.0**32)
    return (dr.reinterpret_array(mi.UInt32, ratio) - _BITS_OF_1) >> (23 + 5 - DEPTH_BITS)


_BITS_OF_1 = 0x3F800000


def _depth_of_level(level: Any, view: View) -> Any:
    """Least depth that has a level; what is nearer than the near plane has level 0."""
    ratio = dr.reinterpret_array(mi.Float, (level << (23 + 5 - DEPTH_BITS)) + _BITS_OF_1)
    return dr.select(level == 0, 0, (1 - 1e-6) * ratio * view.near_plane)


def _depths(record: Any, ellipsoid: Any, first: Any, view: View, quality: Quality) -> Callable[[Any], Any]:
    """Function from a tile in the row of tiles of the ``first`` one to a record's depth there, by which it is sorted.

    In an undistorted view, most of it is the same for a whole row.
    """
    if quality.order == "ray":
        return lambda tile: _least_depth(record, ellipsoid, view.tile_slopes(tile))
    if view.distortion:
        return lambda tile: _depth_where_seen(record, view.tile_slopes(tile))
    (first_u, step_u, width), (first_v, step_v, height) = view.tile_grid()
    row = first // view.tiles_x
    depth_around, begin = _depths_where_seen(record, width, height), row * view.tiles_x
    middle_u, middle_v = first_u - record[0], dr.fma(mi.Float(row), step_v, first_v) - record[1]
    return lambda tile: depth_around(dr.fma(mi.Float(tile - begin), step_u, middle_u), middle_v)


def _depth_where_seen(record: Any, slopes: tuple[Any, Any, Any, Any]) -> Any:
    """Depth of a Gaussian's peak along the ray around which a tile between some slopes sees most of it."""
    lo_u, hi_u, lo_v, hi_v = slopes
    depth_around = _depths_where_seen(record, hi_u - lo_u, hi_v - lo_v)
    return depth_around(0.5 * (lo_u + hi_u) - record[0], 0.5 * (lo_v + hi_v) - record[1])


def _depths_where_seen(record: Any, width: Any, height: Any) -> Callable[[Any, Any], Any]:
    """Function from the middle of a tile of such slopes, from the footprint's centre on, to :func:`_depth_where_seen`.

    With M the inverse covariance of the footprint and V that of a tile's pixels, taken for a Gaussian around its middle
    m, their product has its mean at (I + V M)^-1 m from the footprint's centre: near the centre of what is small
    against the tile, in the middle of the tile for what is large.
    """
    a, b2, c = (record[k] for k in (2, 3, 4))
    variance_u, variance_v = (dr.square(w) / (12 * LOG2_E_HALF) for w in (width, height))
    # What is smaller than the tile by more than this is seen at its centre, and would overflow.
    p11, p22 = 1 + dr.minimum(variance_u * a, 1e15), 1 + dr.minimum(variance_v * c, 1e15)
    b = dr.clip(0.5 * b2, -1e15 / variance_u, 1e15 / variance_u)
    inverse = dr.rcp(dr.maximum(p11 * p22 - variance_u * b * (variance_v * b), 1))
    uu, uv = inverse * p22, inverse * (variance_u * b)
    vu, vv = inverse * (variance_v * b), inverse * p11
    half_u, half_v = 0.5 * width, 0.5 * height

    def depth_around(middle_u: Any, middle_v: Any) -> Any:
        du, dv = uu * middle_u - uv * middle_v, vv * middle_v - vu * middle_u
        du = dr.clip(du, middle_u - half_u, middle_u + half_u)
        dv = dr.clip(dv, middle_v - half_v, middle_v + half_v)
        top, bottom = _depth_fraction(record, du, dv)
        return dr.select(a < 0, 0, record[9] * dr.maximum(top, 0) / bottom)

    return depth_around


def _least_depth(record: Any, ellipsoid: Any, slopes: tuple[Any, Any, Any, Any]) -> Any:
    """Lower bound of the depth of a Gaussian's peak along any ray of a tile.

    The numerator of the depth is linear and the denominator convex in the slopes: both are bounded at the corners. Nor
    can the peak lie in front of the cut-off ellipsoid.
    """
    lo_u, hi_u, lo_v, hi_v = slopes
    least, largest = mi.Float(dr.inf), mi.Float(0)
    for u in (lo_u, hi_u):
        for v in (lo_v, hi_v):
            top, bottom = _depth_fraction(record, u - record[0], v - record[1])
            least, largest = dr.minimum(least, top), dr.maximum(largest, bottom)
    bound = dr.maximum(record[9] * dr.maximum(least, 0) / largest, ellipsoid)
    return dr.select(record[2] < 0, 0, dr.maximum(bound, 0))


def _depth_fraction(record: Any, du: Any, dv: Any) -> tuple[Any, Any]:
    """Numerator and denominator of the depth of a peak, relative to the depth of the centre."""
    _, _, _, _, _, _, _, _, _, _, e, f, g, h, i, _ = record
    top = dr.fma(0.5, dr.fma(du, e, dv * f), 1)
    return top, dr.fma(dv, dr.fma(dv, i, dr.fma(du, h, f)), dr.fma(du, dr.fma(du, g, e), 1))
