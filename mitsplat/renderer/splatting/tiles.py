"""Depth-sorted lists of Gaussians per image tile, built on the device.

1. *Cull* every Gaussian of every placement by the exact screen box of its cut-off ellipsoid (one kernel).
2. *Project* the others to view records (one kernel), see :mod:`mitsplat.renderer.projection.projector`. On a GPU, one
   kernel does both.
3. *Pair* each record with the tiles that its cut-off ellipse intersects, see :mod:`mitsplat.renderer.splatting.pairs`.
4. *Sort* the pairs by tile and by depth there, see :mod:`mitsplat.renderer.splatting.tile_depths`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Quality
from mitsplat.renderer.projection.clouds import CloudSet, Placement, placement_table
from mitsplat.renderer.projection.projector import Projector
from mitsplat.renderer.projection.records import RECORD, GaussianRecord, ViewRecords
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import concatenated
from mitsplat.renderer.rays.tile_subset import TileBox, TileSubset
from mitsplat.renderer.splatting.pairs import NUMBER_BITS, Pairs, pair_records, prefix_ranges
from mitsplat.renderer.splatting.sorting import numpy_sorts_slowly, sort_in_threads, stable_order
from mitsplat.renderer.splatting.tile_depths import DEPTH_BITS, depth_of_level, least_depth, level_of

MAX_UNCULLED = 1 << 22
"""Largest number of Gaussians that are projected without prior culling; records take 84 bytes each."""


@dataclass(frozen=True, eq=False)
class TileLists:
    """Depth-sorted Gaussians of every tile.

    Attributes:
        records: One :class:`mitsplat.renderer.projection.records.GaussianRecord` per visible Gaussian.
        plane_records: One :class:`mitsplat.renderer.projection.records.PlaneRecord` per Gaussian that reaches the
            camera's plane; None if there are none.
        entries: Record numbers, tile after tile.
        slots: Position of every entry in the order by record number; for gradients only.
        first: First of those positions of each record, followed by the number of entries; for gradients only.
        nearest: Least depth [m] that an entry's peak can have in its tile, ascending per tile; for the order per ray.
        start, stop: Range of each tile in ``entries``.
        visible, pairs: Number of records and of entries.
        instance: Instance id of all entries; None if there are several.
        levels: Sort keys of entries within their tile.
        tiles: Numbers of the tiles that have ranges; None for all tiles of the view.
        least: Depth [m] in front of which the peak of a record cannot lie, for tiles that are sorted again.
    """

    records: mi.Float
    plane_records: mi.Float | None
    entries: mi.UInt32
    slots: mi.UInt32 | None
    first: mi.UInt32 | None
    nearest: mi.Float | None
    start: mi.UInt32
    stop: mi.UInt32
    visible: int
    pairs: int
    instance: int | None
    levels: mi.UInt32 | None
    tiles: mi.UInt32 | None = None
    least: mi.Float | None = None


def bin_gaussians(
    clouds: CloudSet,
    placements: Sequence[Placement],
    view: CameraView,
    quality: Quality,
    *,
    at_camera: bool = True,
    subset: TileSubset | None = None,
    fitted: bool = False,
    groups: mi.UInt32 | None = None,
    for_gradients: bool = False,
) -> TileLists:
    """Build the tile lists of all placements for a view from :meth:`CameraView.sampled`.

    Args:
        clouds: Gaussians on the device.
        placements: Poses of the clouds.
        view: The camera.
        quality: Order, cut-offs and kernel.
        at_camera: True if Gaussians that reach the camera's plane are visible.
        subset: Subset of tiles that have lists; None for all tiles of the view.
        fitted: True if only the tiles in a box around all visible Gaussians have lists.
        groups: A number below 2^DEPTH_BITS by instance id, which replaces the depth level of its entries.
        for_gradients: True if entries are also indexed by record.

    Raises:
        CrowdedError: If the view has too many pairs.
    """
    table, owner, local = placement_table(clouds, placements, view)
    if dr.width(local) == 0:
        return _empty(view, subset)
    changed = any(placement.appearance is not None for placement in placements)
    source = Projector(clouds, table, view, quality, at_camera, changed)

    if subset is None and not (fitted or for_gradients) and _skips_culling(dr.width(local)):
        records = source.records_unculled(owner, local)
    else:
        visible, at_plane = source.cull(owner, local, subset)
        index = dr.compress(visible)
        if dr.width(index) == 0:
            return _empty(view, subset)
        owner, local = dr.gather(mi.UInt32, owner, index), dr.gather(mi.UInt32, local, index)
        at_plane = dr.gather(mi.Bool, at_plane, index)
        dr.eval(owner, local, at_plane)
        records = source.records(owner, local, at_plane)
    ids = {placement.instance for placement in placements}
    only = ids.pop() if len(ids) == 1 else None
    listed: TileSubset | TileBox | None = TileBox.around(records.tile_boxes, view) if fitted else subset
    if groups is not None:
        place = dr.arange(mi.UInt32, dr.width(records.least)) * RECORD + GaussianRecord.place("instance")
        groups = dr.gather(mi.UInt32, groups, mi.UInt32(dr.gather(mi.Float, records.rows, place)))
    return bin_records(records, view, quality, only, listed, groups=groups, for_gradients=for_gradients)


def _skips_culling(count: int) -> bool:
    """Return True if ``count`` Gaussians are projected without prior culling.

    On a GPU, this takes less time than waiting for the number of visible Gaussians and tracing the next kernels.
    """
    return dr.backend_v(mi.Float) == dr.JitBackend.CUDA and count <= MAX_UNCULLED


def bin_records(
    records: ViewRecords,
    view: CameraView,
    quality: Quality,
    only: int | None,
    subset: TileSubset | TileBox | None = None,
    *,
    groups: mi.UInt32 | None = None,
    for_gradients: bool = False,
) -> TileLists:
    """Build tile lists from view records.

    Args:
        records: Gaussians projected to the view.
        view: The camera.
        quality: Order and cut-off.
        only: Instance id of all records; None if there are several.
        subset: Tiles that have lists; None for all tiles of the view.
        groups: As in :func:`mitsplat.renderer.splatting.pairs.pair_records`.
        for_gradients: True if entries are also indexed by record.

    Raises:
        CrowdedError: If there are too many pairs.
    """
    detached = records._replace(rows=dr.detach(records.rows))
    pairs = pair_records(detached, view, quality, subset, numbered=for_gradients, groups=groups)
    if pairs is None:
        return _empty(view, subset, records.rows)
    tiles, own = _tile_numbers(view, subset)
    rows, plane_rows, least, _ = records
    return _sorted_lists(rows, plane_rows, pairs, least, dr.width(least), tiles, view, only, own)


def _sorted_lists(
    records: mi.Float,
    plane_records: mi.Float | None,
    pairs: Pairs,
    least: mi.Float,
    visible: int,
    tiles: int,
    view: CameraView,
    only: int | None,
    own: mi.UInt32 | None = None,
) -> TileLists:
    """Sort pairs by tile and depth into lists. Levels and least depths are evaluated on use."""
    count = dr.width(pairs.key)
    # The number of bits is that of all tiles, so that lists of a subset reuse the kernels.
    key = _sort_keys(pairs.key, DEPTH_BITS + max(1, (view.tiles_x * view.tiles_y - 1).bit_length()))
    number, tile = mi.UInt32(key & ((1 << NUMBER_BITS) - 1)), dr.arange(mi.UInt32, tiles)
    slots, entries = (None, number) if pairs.record is None else (number, dr.gather(mi.UInt32, pairs.record, number))
    begins = _first_entries(key, tiles)
    start, stop = dr.gather(mi.UInt32, begins, tile), dr.gather(mi.UInt32, begins, tile + 1)
    dr.eval(entries, slots, start, stop)
    levels = mi.UInt32(key >> NUMBER_BITS) & ((1 << DEPTH_BITS) - 1)
    return TileLists(
        records=records,
        plane_records=plane_records,
        entries=entries,
        slots=slots,
        first=pairs.first,
        levels=levels,
        nearest=depth_of_level(levels, view),
        start=start,
        stop=stop,
        least=least,
        visible=visible,
        pairs=count,
        instance=only,
        tiles=own,
    )


def _tile_numbers(view: CameraView, subset: TileSubset | TileBox | None) -> tuple[int, mi.UInt32 | None]:
    """Return the number of tiles with lists, and their numbers in the view (None for all tiles)."""
    return (view.tiles_x * view.tiles_y, None) if subset is None else (subset.count, subset.number)


def _empty(view: CameraView, subset: TileSubset | TileBox | None, records: mi.Float | None = None) -> TileLists:
    tiles, own = _tile_numbers(view, subset)
    zeros = dr.zeros(mi.UInt32, tiles)
    dr.eval(zeros)
    entry = dr.zeros(mi.UInt32, 1)
    visible = 0 if records is None else dr.width(records) // RECORD
    records = dr.zeros(mi.Float, RECORD) if records is None else records
    none = dr.zeros(mi.Float, max(visible, 1))
    return TileLists(records, None, entry, entry, entry, none, zeros, zeros, visible, 0, None, entry, own, none)


def merge_lists(first: TileLists, second: TileLists, tiles: mi.UInt32, view: CameraView) -> TileLists:
    """Merge two lists in some tiles of a view, as if their Gaussians had been binned together.

    Args:
        first: Lists of all tiles of the view.
        second: Further lists of all tiles of the view.
        tiles: Numbers of the tiles that get lists.
        view: The camera.

    Raises:
        CrowdedError: If there are too many pairs.
    """
    visible = dr.width(first.records) // RECORD
    both = [p for p in (_pairs_in(first, tiles, 0), _pairs_in(second, tiles, visible)) if p is not None]
    pairs = Pairs(Pairs.key_of(*(concatenated(parts) for parts in zip(*both, strict=True))))
    dr.eval(pairs.key)
    records, plane_records = second.records, second.plane_records
    if plane_records is not None and first.plane_records is not None:
        # The plane records of the second list follow those of the first.
        row, before = dr.arange(mi.UInt32, second.visible) * RECORD, dr.width(first.plane_records) // RECORD
        number = row + GaussianRecord.place("u0")
        shifted, at_plane = dr.copy(records), dr.gather(mi.Float, records, row + GaussianRecord.place("a")) < 0
        dr.scatter(shifted, dr.gather(mi.Float, records, number) + dr.opaque(mi.Float, before), number, at_plane)
        records, plane_records = shifted, concatenated([first.plane_records, plane_records])
    records = concatenated([first.records, records])
    plane_records = first.plane_records if plane_records is None else plane_records
    least = concatenated([first.least, second.least])
    return _sorted_lists(
        records, plane_records, pairs, least, visible + second.visible, dr.width(tiles), view, None, tiles
    )


def select_tiles(lists: TileLists, places: mi.UInt32) -> TileLists:
    """Return the unchanged lists of some tiles, given by their places."""
    tiles = places if lists.tiles is None else dr.gather(mi.UInt32, lists.tiles, places)
    start, stop = dr.gather(mi.UInt32, lists.start, places), dr.gather(mi.UInt32, lists.stop, places)
    dr.eval(tiles, start, stop)
    return replace(lists, start=start, stop=stop, tiles=tiles)


def sort_by_ray(lists: TileLists, places: mi.UInt32, view: CameraView) -> TileLists:
    """Sort some non-empty tiles, given by their places in ``lists``, for the order per ray."""
    place, _, number = cast("tuple[mi.UInt32, mi.UInt32, mi.UInt32]", _pairs_in(lists, places, 0))
    tiles = places if lists.tiles is None else dr.gather(mi.UInt32, lists.tiles, places)
    record = GaussianRecord.fetch(dr.detach(lists.records), number)
    slopes = view.tile_slopes(dr.gather(mi.UInt32, tiles, place))
    level = level_of(least_depth(record, dr.gather(mi.Float, lists.least, number), slopes), view)
    again, count = Pairs(Pairs.key_of(place, level, number)), dr.width(tiles)
    dr.eval(again.key)
    return _sorted_lists(
        lists.records, lists.plane_records, again, lists.least, lists.visible, count, view, lists.instance, tiles
    )


def _pairs_in(lists: TileLists, tiles: mi.UInt32, shift: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32] | None:
    """Return the entries of some tiles as places in ``tiles``, levels, and record numbers plus ``shift``.

    Returns None if there are no entries.
    """
    start = dr.gather(mi.UInt32, lists.start, tiles)
    length = dr.gather(mi.UInt32, lists.stop, tiles) - start
    begin, size = prefix_ranges(length, lists.pairs)
    if size == 0:
        return None
    number, place, level = (dr.empty(mi.UInt32, size) for _ in range(3))
    offset, own = dr.opaque(mi.UInt32, shift), dr.arange(mi.UInt32, dr.width(tiles))

    def one_pair(k: mi.UInt32) -> tuple[mi.UInt32]:
        entry, at = start + k, begin + k
        dr.scatter(number, dr.gather(mi.UInt32, lists.entries, entry) + offset, at, mode=dr.ReduceMode.Permute)
        dr.scatter(place, own, at, mode=dr.ReduceMode.Permute)
        dr.scatter(level, dr.gather(mi.UInt32, lists.levels, entry), at, mode=dr.ReduceMode.Permute)
        return (k + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, dr.width(tiles)),), lambda k: k < length, one_pair, label="merge")
    dr.eval(place, level, number)
    return place, level, number


def _sort_keys(key: mi.UInt64, bits: int) -> mi.UInt64:
    """Sort the keys of pairs (UInt64, evaluated) by their leading ``bits``; the numbers below already ascend.

    On most CPUs, NumPy sorts them in place with vector instructions.
    """
    if dr.backend_v(key) == dr.JitBackend.LLVM and not numpy_sorts_slowly():
        sort_in_threads(key.numpy(), min(8, max(1, dr.thread_count() // 2)))
        return key
    in_order = dr.gather(mi.UInt64, key, stable_order(key >> NUMBER_BITS, bits))
    dr.eval(in_order)
    return in_order


def _first_entries(key: mi.UInt64, tiles: int) -> mi.UInt32:
    """Return the number of the first entry of every tile, and of all entries, by bisection of sorted keys."""
    wanted = Pairs.key_of(dr.arange(mi.UInt32, tiles + 1), mi.UInt32(0), mi.UInt32(0))
    pairs = dr.opaque(mi.UInt32, dr.width(key))

    def halve(low: mi.UInt32, high: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        middle = (low + high) // 2
        before = dr.gather(mi.UInt64, key, middle, low < high) < wanted
        return dr.select(before, middle + 1, low), dr.select(before, high, middle)

    state = dr.zeros(mi.UInt32, tiles + 1), pairs + dr.zeros(mi.UInt32, tiles + 1)
    first, _ = dr.while_loop(state, lambda low, high: low < high, halve, label="first entries")
    dr.eval(first)
    return first
