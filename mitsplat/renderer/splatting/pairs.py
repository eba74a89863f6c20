"""Pairs of Gaussians and the image tiles that their cut-off ellipses intersect, with sort keys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.errors import MissingResourceError
from mitsplat.quality import Quality
from mitsplat.renderer.projection.gaussian import conic_touches_rectangle, ellipse_spans
from mitsplat.renderer.projection.records import GaussianRecord, ViewRecords
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.tile_subset import TileBox, TileSubset
from mitsplat.renderer.splatting.tile_depths import DEPTH_BITS, depths_by_tile, level_of

NUMBER_BITS = 26
"""Bits of a record number or pair number in sort keys."""

PAIRS_MAX = 1 << NUMBER_BITS
"""Largest number of pairs that are stored at once, about 40 bytes each."""

TILES_MAX = 1 << (64 - DEPTH_BITS - NUMBER_BITS)
"""Largest number of tiles of a view."""


class CrowdedError(MissingResourceError):
    """Error of a view with more than :data:`PAIRS_MAX` pairs or :data:`TILES_MAX` tiles.

    Such a view must be rendered in parts.
    """

    def __init__(self) -> None:
        super().__init__(
            "the splats cover too much of the image for the memory: render a smaller image, or split the splats"
        )


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of a record and a tile, record after record.

    Attributes:
        key: Sort keys, see :meth:`key_of`.
        record: Record number of each pair; None unless the pairs themselves are numbered.
        first: First pair of each record, followed by the number of pairs; None unless the pairs are numbered.
    """

    key: mi.UInt64
    record: mi.UInt32 | None = None
    first: mi.UInt32 | None = None

    @staticmethod
    def key_of(tile: mi.UInt32, level: mi.UInt32, number: mi.UInt32) -> mi.UInt64:
        """Combine tile, depth level, and the number of the record or pair in one sort key."""
        return mi.UInt64(tile) << (DEPTH_BITS + NUMBER_BITS) | mi.UInt64(level) << NUMBER_BITS | mi.UInt64(number)


def pair_records(
    records: ViewRecords,
    view: CameraView,
    quality: Quality,
    subset: TileSubset | TileBox | None,
    *,
    numbered: bool,
    groups: mi.UInt32 | None = None,
) -> Pairs | None:
    """Pair every record with the tiles that it intersects; return None if there are no pairs.

    Args:
        records: Gaussians projected to the view.
        view: The camera.
        quality: Cut-off of the opacity.
        subset: Tiles that have lists, which are then given by their places in the subset; None for all tiles.
        numbered: True if sort keys hold the number of the pair instead of the record.
        groups: Numbers of the records below 2^DEPTH_BITS, which replace the depth level in sort keys.

    Raises:
        CrowdedError: If there are more than :data:`PAIRS_MAX` pairs, or more tiles or records than sort keys can hold.
    """
    count = dr.width(records.least)
    if count > 1 << NUMBER_BITS or view.tiles_x * view.tiles_y > TILES_MAX:
        raise CrowdedError
    # Rows first: one lane finds the spans of one record, then one lane fills one span.
    spans = _spans_of_rows(records, count, view, quality, subset)
    if spans is None:
        return None
    pair_of, pairs = prefix_ranges(spans.length, view.tiles_x)
    if pairs == 0:
        return None
    record = GaussianRecord.fetch(records.rows, spans.owner)
    ellipsoid = dr.gather(mi.Float, records.least, spans.owner)
    key, number = dr.empty(mi.UInt64, pairs), dr.empty(mi.UInt32, pairs) if numbered else None

    def in_view(tile: mi.UInt32, active: mi.Bool = True) -> mi.UInt32:
        return tile if subset is None else dr.gather(mi.UInt32, subset.number, tile, active)

    if groups is None:
        first_in_view = in_view(spans.first_tile, spans.length > 0)
        depth_of = depths_by_tile(record, records.plane_rows, ellipsoid, first_in_view, view, quality)
    else:
        group = dr.gather(mi.UInt32, groups, spans.owner)

    def one_tile(k: mi.UInt32) -> tuple[mi.UInt32]:
        tile, pair = spans.first_tile + k, pair_of + k
        level = level_of(depth_of(in_view(tile)), view) if groups is None else group
        own = Pairs.key_of(tile, level, pair if numbered else spans.owner)
        dr.scatter(key, own, pair, mode=dr.ReduceMode.Permute)
        if numbered:
            dr.scatter(number, spans.owner, pair, mode=dr.ReduceMode.Permute)
        return (k + 1,)

    rows = dr.width(spans.owner)
    dr.while_loop((dr.zeros(mi.UInt32, rows),), lambda k: k < spans.length, one_tile, label="pairs")
    if not numbered:
        dr.eval(key)
        return Pairs(key)
    first = _first_pairs(spans, pair_of, count, pairs)
    dr.eval(key, number, first)
    return Pairs(key, number, first)


def _first_pairs(spans: _Spans, pair_of: mi.UInt32, count: int, pairs: int) -> mi.UInt32:
    """Return the number of the first pair of each of ``count`` records, and then the number of pairs."""
    first = dr.empty(mi.UInt32, count + 1)
    end, inside = dr.opaque(mi.UInt32, pairs), spans.first_row < dr.opaque(mi.UInt32, dr.width(spans.owner))
    first_pair = dr.gather(mi.UInt32, pair_of, spans.first_row, inside)
    dr.scatter(first, dr.select(inside, first_pair, end), dr.arange(mi.UInt32, count))
    dr.scatter(first, end, dr.opaque(mi.UInt32, count))
    return first


@dataclass(frozen=True, eq=False)
class _Spans:
    """Consecutive tiles of one row that the ellipse of a record intersects, record after record.

    Attributes:
        owner: Record number of each span.
        first_tile: First tile of each span, as a place in the subset.
        length: Number of tiles of each span, 0 for none.
        first_row: First span of each record.
    """

    owner: mi.UInt32
    first_tile: mi.UInt32
    length: mi.UInt32
    first_row: mi.UInt32


def _spans_of_rows(
    records: ViewRecords, count: int, view: CameraView, quality: Quality, subset: TileSubset | TileBox | None
) -> _Spans | None:
    """Find the spans of ``count`` records in every row of their tile boxes; return None if there are no rows."""
    order = dr.arange(mi.UInt32, count)
    x0, x1, y0, y1 = dr.gather(mi.Array4u, records.tile_boxes, order)
    first_row, rows = prefix_ranges(dr.select(y1 > y0, y1 - y0, 0), view.tiles_y)
    if rows == 0:
        return None
    cut = dr.log2(dr.opaque(mi.Float, quality.alpha_min))
    owner, first_tile, length = (dr.empty(mi.UInt32, rows) for _ in range(3))
    span_of = _span_function(GaussianRecord.fetch(records.rows, order), cut, x0, x1, view)

    def one_row(y: mi.UInt32) -> tuple[mi.UInt32]:
        lo, hi = span_of(y)
        row = first_row + (y - y0)
        begin, size = y * view.tiles_x + lo, dr.select(hi > lo, hi - lo, 0)
        if subset is not None:
            begin, size = subset.among(begin, size)
        dr.scatter(owner, order, row, mode=dr.ReduceMode.Permute)
        dr.scatter(first_tile, begin, row, mode=dr.ReduceMode.Permute)
        dr.scatter(length, size, row, mode=dr.ReduceMode.Permute)
        return (y + 1,)

    dr.while_loop((mi.UInt32(y0),), lambda y: y < y1, one_row, label="spans of tiles")
    dr.eval(owner, first_tile, length)
    return _Spans(owner, first_tile, length, first_row)


def prefix_ranges(sizes: mi.UInt32, most: int) -> tuple[mi.UInt32, int]:
    """Return the start of each of consecutive ranges of size at most ``most``, and their total size.

    Raises:
        CrowdedError: If the total is more than :data:`PAIRS_MAX`.
    """
    count = dr.width(sizes)
    begin, last = dr.prefix_sum(sizes), count - 1
    sums = [dr.gather(mi.UInt32, begin, last) + dr.gather(mi.UInt32, sizes, last)]
    if count * most > 0xFFFFFFFF:  # also summed as floats, because the integer sum may wrap
        sums.append(mi.UInt32(dr.minimum(dr.sum(mi.Float(sizes)), 2.0 * PAIRS_MAX)))
    totals: list[int] = np.array(dr.concat(sums)).tolist()
    if max(totals) > PAIRS_MAX:
        raise CrowdedError
    return begin, totals[0]


def _span_function(
    record: GaussianRecord, cut: mi.Float, x0: mi.UInt32, x1: mi.UInt32, view: CameraView
) -> Callable[[mi.UInt32], tuple[mi.UInt32, mi.UInt32]]:
    """Return a function from a row of tiles to the half-open range that a record's ellipse intersects.

    Gaussians at the camera's plane take their whole box. Under lens distortion, rows of tiles are not bands of slopes,
    so that the tiles of the box are tested one by one.
    """
    u0, v0, k2 = record.u0, record.v0, record.log_opacity - cut
    squares = record.a - k2 * record.g, record.b2 - k2 * record.h, record.c - k2 * record.i
    conic = *squares, -k2 * record.e, -k2 * record.f, -k2
    whole = record.at_plane
    if not view.distortion:
        span_between = ellipse_spans(conic)
        _, (first_v, step_v, height) = view.tile_grid()

    def straight(y: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        dv = dr.fma(mi.Float(y), step_v, first_v) - v0
        lo_u, hi_u, meets = span_between(dv - 0.5 * height, dv + 0.5 * height)
        lo, hi = view.tile_columns(u0 + lo_u, u0 + hi_u)
        lo, hi = dr.maximum(lo, x0), dr.minimum(dr.select(meets, hi, 0), x1)
        return dr.select(whole, x0, lo), dr.select(whole, x1, hi)

    def distorted(y: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        def one_tile(x: mi.UInt32, lo: mi.UInt32, hi: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
            lo_u, hi_u, lo_v, hi_v = view.tile_slopes(y * view.tiles_x + x)
            meets = whole | conic_touches_rectangle(conic, lo_u - u0, hi_u - u0, lo_v - v0, hi_v - v0)
            return x + 1, dr.select(meets, dr.minimum(lo, x), lo), dr.select(meets, x + 1, hi)

        _, lo, hi = dr.while_loop(
            (mi.UInt32(x0), mi.UInt32(x1), mi.UInt32(x0)), lambda x, lo, hi: x < x1, one_tile, label="tiles of a row"
        )
        return lo, hi

    return distorted if view.distortion else straight
