"""From clouds of Gaussians to depth-sorted lists per image tile, all on the device.

1. *Cull* every Gaussian of every placement by the exact screen box of its cut-off ellipsoid (one kernel).
2. *Project* what is left to view records (one kernel).
3. *Pair* each with the tiles that its cut-off ellipse really meets: the ellipse cuts a span out of every row of tiles.
4. *Sort* the pairs by tile and by depth there. For the order per tile that is the peak's depth along the tile's ray
   nearest to the Gaussian's centre; for the order per ray it is a lower bound over all rays of the tile, which says
   when a ray has seen all that can come first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.errors import MissingResourceError
from mitsplat.plugins.device import wrapped
from mitsplat.plugins.gaussian import (
    LOG2_E_HALF,
    RECORD,
    Cloud,
    conic_touches_rectangle,
    ellipse_bounds,
    ellipse_span,
    evaluate_sh,
    general_response,
    project_gaussian,
    rotation_axes,
)
from mitsplat.plugins.rays import View
from mitsplat.quality import KERNELS, Quality

PLACEMENT = 32
"""Floats per placement: camera axes in the cloud's frame (9), scale, instance id, first Gaussian, camera centre in the
cloud's frame as a sum of two floats (3 + 3), padding. Two floats keep the difference exact far from the origin."""


@dataclass(frozen=True, eq=False)
class Placement:
    """A cloud in the world.

    Attributes:
        cloud: Index of the cloud.
        world_from_cloud: Rotation, translation and uniform scale, shape (4, 4).
        instance: Instance id; 0 is the environment.
    """

    cloud: int
    world_from_cloud: np.ndarray
    instance: int


@dataclass(frozen=True, eq=False)
class CloudSet:
    """Several clouds in one set of device arrays, so that one kernel serves every placement of a scene."""

    counts: tuple[int, ...]
    first: tuple[int, ...]
    geometry: Any
    scales: Any
    sh: Any
    sh_count: int
    sh_stride: int


def merge_clouds(clouds: Sequence[Cloud]) -> CloudSet:
    """Concatenate clouds on the device; SH are padded with zeros to the largest degree present."""
    counts = tuple(c.count for c in clouds)
    first = tuple(int(i) for i in np.concatenate([[0], np.cumsum(counts)[:-1]]))
    if len(clouds) == 1:
        (c,) = clouds
        return CloudSet(counts, first, c.geometry, c.scales, c.sh, c.sh_count, c.sh_stride)
    total = sum(counts)
    stride = max(c.sh_stride for c in clouds)
    geometry, scales = dr.empty(mi.Float, 8 * total), dr.empty(mi.Float, 4 * total)
    sh = dr.zeros(mi.Float, stride * total)
    for start, c in zip(first, clouds, strict=True):
        if c.count == 0:
            continue
        for target, source, width in ((geometry, c.geometry, 8), (scales, c.scales, 4)):
            dr.scatter(target, source, dr.arange(mi.UInt32, c.count * width) + start * width)
        i = dr.arange(mi.UInt32, c.count * c.sh_stride)
        dr.scatter(sh, c.sh, (i // c.sh_stride + start) * stride + i % c.sh_stride)
    dr.eval(geometry, scales, sh)
    return CloudSet(counts, first, geometry, scales, sh, max(c.sh_count for c in clouds), stride)


_ADJOINT = dr.ReduceMode.NoConflicts
"""How gradients are added to a cloud: they are asked for where it is placed once, so each Gaussian has but one sum. The
default would write the number of Gaussians into the kernels, and compile them anew whenever it changes."""

PAIRS_MAX = 1 << 26
"""Most pairs of a Gaussian and a tile that are held at once, about 40 bytes each."""

DEPTH_BITS = 16
"""Bits of a depth that pairs are sorted by: 11 of its mantissa tell depths apart that differ by 0.05 %, and 5 of its
exponent those up to 2^32 times the near plane. Equals stay in the order of the clouds."""


class CrowdedError(MissingResourceError):
    """A view has more pairs than :data:`PAIRS_MAX`: render a part of it."""

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
        slots: Place of every entry if they were sorted by record number instead.
        first: First of those places of each record, and the number of entries.
        nearest: Least depth [m] that an entry's peak can have in its tile, ascending per tile; for the order per ray.
        start, stop: Range of each tile in ``entries``.
        visible, pairs: Number of records and of entries.
        instance: Id of all of them, or None if they have several.
        levels: What entries are sorted by in their tile.
        tiles: Numbers of the tiles whose ranges these are; None for all of the view's.
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


def bin_gaussians(
    clouds: CloudSet, placements: Sequence[Placement], view: View, quality: Quality, *, at_camera: bool = True
) -> TileLists:
    """Tile lists of all placements seen by one camera, for a view from :meth:`View.sampled`.

    Args:
        clouds: Gaussians on the device.
        placements: Where they are.
        view: The camera.
        quality: Order, cut-offs and kernel.
        at_camera: Whether Gaussians that reach the camera's plane are seen.

    Raises:
        CrowdedError: If the view has too many pairs to hold.
    """
    tiles = view.tiles_x * view.tiles_y
    table, owner, local = _placement_table(clouds, placements, view)
    total = dr.width(local)
    if total == 0:
        return _empty(tiles)
    source = _Source(clouds, table, view, quality, at_camera)

    visible, near = source.cull(owner, local)
    index = dr.compress(visible)
    count = dr.width(index)
    if count == 0:
        return _empty(tiles)
    owner, local = dr.gather(mi.UInt32, owner, index), dr.gather(mi.UInt32, local, index)
    near = dr.gather(mi.Bool, near, index)
    dr.eval(owner, local, near)

    records, near_rows, least, box = source.records(owner, local, near)
    pairs = _pair(dr.detach(records), least, box, view, quality)
    if pairs is None:
        return _empty(tiles, records)
    ids = {placement.instance for placement in placements}
    only = ids.pop() if len(ids) == 1 else None
    return _listed(records, near_rows, pairs, count, tiles, view, only)


def _listed(
    records: Any, near: Any, pairs: _Pairs, visible: int, tiles: int, view: View, only: int | None, own: Any = None
) -> TileLists:
    """Lists of pairs by tile and depth. Levels and least depths are evaluated where they are used."""
    slots = _sorted(pairs.level, DEPTH_BITS)
    slots = _sorted(pairs.tile, max(1, (tiles - 1).bit_length()), slots)
    entries, levels = dr.gather(mi.UInt32, pairs.record, slots), dr.gather(mi.UInt32, pairs.level, slots)
    begins, tile = _first_entries(pairs.tile, slots, tiles), dr.arange(mi.UInt32, tiles)
    start, stop = dr.gather(mi.UInt32, begins, tile), dr.gather(mi.UInt32, begins, tile + 1)
    dr.eval(entries, start, stop)
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
        visible=visible,
        pairs=dr.width(entries),
        instance=only,
        tiles=own,
    )


def _empty(tiles: int, records: Any | None = None) -> TileLists:
    zeros = dr.zeros(mi.UInt32, tiles)
    dr.eval(zeros)
    entry = dr.zeros(mi.UInt32, 1)
    visible = 0 if records is None else dr.width(records) // RECORD
    records = dr.zeros(mi.Float, RECORD) if records is None else records
    none = dr.zeros(mi.Float, 1)
    return TileLists(records, None, entry, entry, entry, none, zeros, zeros, visible, 0, None, entry)


def merge_lists(first: TileLists, second: TileLists, tiles: Any, view: View) -> TileLists:
    """The lists of some tiles of a view with the Gaussians of both, as if they had been binned together.

    Raises:
        CrowdedError: If there are too many pairs to hold.
    """
    count = dr.width(tiles)
    record: list[Any] = []
    tile: list[Any] = []
    level: list[Any] = []
    visible = dr.width(first.records) // RECORD
    for lists, shift in ((first, 0), (second, visible)):
        start = dr.gather(mi.UInt32, lists.start, tiles)
        length = dr.gather(mi.UInt32, lists.stop, tiles) - start
        begin, size = _ranges(length)
        if size == 0:
            continue
        parts = [dr.empty(mi.UInt32, size) for _ in range(3)]
        offset = dr.opaque(mi.UInt32, shift)

        def one_pair(
            k: Any, start: Any = start, begin: Any = begin, parts: Any = parts, lists: Any = lists, offset: Any = offset
        ) -> tuple[Any]:
            entry, at = start + k, begin + k
            dr.scatter(parts[0], dr.gather(mi.UInt32, lists.entries, entry) + offset, at, mode=dr.ReduceMode.Permute)
            dr.scatter(parts[1], dr.arange(mi.UInt32, count), at, mode=dr.ReduceMode.Permute)
            dr.scatter(parts[2], dr.gather(mi.UInt32, lists.levels, entry), at, mode=dr.ReduceMode.Permute)
            return (k + 1,)

        dr.while_loop((dr.zeros(mi.UInt32, count),), lambda k, length=length: k < length, one_pair, label="merge")
        dr.eval(parts)
        for whole, part in zip((record, tile, level), parts, strict=True):
            whole.append(part)
    pairs = _Pairs(dr.concat(record), dr.concat(tile), dr.concat(level), None)
    records, near = second.records, second.near
    if near is not None and first.near is not None:
        # The rows of the second follow those of the first.
        row, a = dr.arange(mi.UInt32, second.visible) * RECORD, mi.Float(dr.width(first.near) // RECORD)
        shifted = dr.copy(records)
        dr.scatter(shifted, dr.gather(mi.Float, records, row) + a, row, dr.gather(mi.Float, records, row + 2) < 0)
        records, near = shifted, dr.concat([first.near, near])
    records = dr.concat([first.records, records])
    near = first.near if near is None else near
    return _listed(records, near, pairs, visible + second.visible, count, view, None, tiles)


def _placement_table(clouds: CloudSet, placements: Sequence[Placement], view: View) -> tuple[Any, Any, Any]:
    """Placement rows on the device, and for every Gaussian of every placement its row and its number in the clouds."""
    rows = np.zeros((max(1, len(placements)), PLACEMENT), np.float32)
    counts = [clouds.counts[p.cloud] for p in placements]
    for row, placement in zip(rows, placements, strict=False):
        matrix = np.asarray(placement.world_from_cloud, dtype=np.float64)
        scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
        camera_from_cloud = view.world_from_camera[:3, :3].T @ (matrix[:3, :3] / scale)
        centre = np.linalg.solve(matrix[:3, :3], view.world_from_camera[:3, 3] - matrix[:3, 3])
        coarse = centre.astype(np.float32)
        row[:9] = camera_from_cloud.ravel()
        row[9] = scale
        row[10] = placement.instance
        row[12:15] = coarse
        row[16:19] = centre - coarse
    total = int(sum(counts))
    if len(placements) == 1:
        local = dr.arange(mi.UInt32, total) + dr.opaque(mi.UInt32, clouds.first[placements[0].cloud])
        return wrapped(mi.Float, rows), dr.zeros(mi.UInt32, total), local
    ends = np.cumsum(counts)
    begins = ends - counts
    number = dr.arange(mi.UInt32, total)
    owner = dr.zeros(mi.UInt32, total)
    shift = np.array([clouds.first[p.cloud] for p in placements], dtype=np.int64) - begins
    marks = dr.zeros(mi.UInt32, total)
    inner = [int(b) for b, n in zip(begins, counts, strict=True) if 0 < b < total and n]
    if inner:
        # Placements without Gaussians share a start with the next one: count each start as often as it occurs.
        starts, repeats = np.unique(begins[(begins > 0) & (begins < total)], return_counts=True)
        dr.scatter(marks, mi.UInt32(repeats.astype(np.uint32)), mi.UInt32(starts.astype(np.uint32)))
        owner = dr.cumsum(marks)
    offsets = wrapped(mi.Int32, shift.astype(np.int32))
    local = mi.UInt32(mi.Int32(number) + dr.gather(mi.Int32, offsets, owner))
    dr.eval(owner, local)
    return wrapped(mi.Float, rows), owner, local


class _Source:
    """Gaussians of placements as the projection kernels read them."""

    def __init__(self, clouds: CloudSet, table: Any, view: View, quality: Quality, at_camera: bool) -> None:
        self.clouds, self.table, self.view, self.quality, self.at_camera = clouds, table, view, quality, at_camera
        self.cut = dr.opaque(mi.Float, quality.alpha_min)

    def load(self, owner: Any, local: Any) -> dict[str, Any]:
        row = dr.gather(mi.ArrayXf, self.table, owner, shape=(PLACEMENT, dr.width(owner)))
        packet = dr.gather(mi.ArrayXf, self.clouds.geometry, local, mode=_ADJOINT, shape=(8, dr.width(local)))
        sigma = dr.gather(mi.ArrayXf, self.clouds.scales, local, mode=_ADJOINT, shape=(4, dr.width(local)))
        mean = mi.Vector3f(*[packet[i] - row[12 + i] - row[16 + i] for i in range(3)])
        return {
            "mean": mean,
            "axes": rotation_axes([packet[4 + i] for i in range(4)]),
            "sigma": [sigma[i] for i in range(3)],
            "right": mi.Vector3f(row[0], row[1], row[2]),
            "down": mi.Vector3f(row[3], row[4], row[5]),
            "forward": mi.Vector3f(row[6], row[7], row[8]),
            "scale": row[9],
        } | {"opacity": packet[3], "instance": row[10]}

    def bounds(self, g: dict[str, Any]) -> tuple[Any, ...]:
        """Response, opacity, squared cut-off, whether the plane z = 0 is near, visibility, slope box and least depth.

        Gaussians near the plane keep the exact response: a pixel is small against them, and no line of sight central.
        """
        view, kernel = self.view, KERNELS[self.quality.kernel]
        shape = {k: g[k] for k in ("mean", "axes", "sigma", "right", "down", "forward", "scale")}
        k = dr.safe_sqrt(2 * dr.log(g["opacity"] / self.cut))
        reach = [
            g["scale"]
            * k
            * dr.norm(mi.Vector3f(*[dr.dot(a, v) * s for a, s in zip(g["axes"], g["sigma"], strict=True)]))
            for v in (g["right"], g["down"], g["forward"])
        ]
        centre = [g["scale"] * dr.dot(g[axis], g["mean"]) for axis in ("right", "down", "forward")]
        response, opacity = project_gaussian(**shape), g["opacity"]
        if kernel.variance > 0:
            covariance = view.pixel_covariance(response.u0, response.v0, kernel.variance)
            response, det = response.filtered(*covariance)
            if kernel.keeps_light:
                opacity = opacity * dr.rsqrt(det)
        if self.quality.response == "ewa":
            response = response.parallel()
        k2 = 2 * dr.log(opacity / self.cut)
        du0, du1, dv0, dv1, ellipse = ellipse_bounds(response.cutoff(k2))
        near = ~ellipse | (centre[2] - reach[2] < view.near_plane)
        opacity, k2 = dr.select(near, g["opacity"], opacity), dr.select(near, k * k, k2)
        farthest = dr.maximum(centre[2] + reach[2], view.near_plane)

        # Slopes of the part of the ellipsoid's box beyond the near plane: loose, but only few Gaussians need it.
        def slopes(axis: int) -> tuple[Any, Any]:
            lo, hi = centre[axis] - reach[axis], centre[axis] + reach[axis]
            return (
                lo / dr.select(lo < 0, view.near_plane, farthest),
                hi / dr.select(hi > 0, view.near_plane, farthest),
            )

        (near_u0, near_u1), (near_v0, near_v1) = slopes(0), slopes(1)
        box = (
            dr.select(near, near_u0, response.u0 + du0),
            dr.select(near, near_u1, response.u0 + du1),
            dr.select(near, near_v0, response.v0 + dv0),
            dr.select(near, near_v1, response.v0 + dv1),
        )
        visible = (k2 > 0) & (centre[2] + reach[2] > view.near_plane)
        if not self.at_camera:
            visible &= ~near
        return response, opacity, k2, near, visible, box, centre[2] - reach[2]

    def cull(self, owner: Any, local: Any) -> tuple[Any, Any]:
        """Whether Gaussians are in view, and whether they reach the camera's plane."""
        g = self.load(owner, local)
        _, _, _, near, visible, box, _ = self.bounds(g)
        x0, x1, y0, y1 = self.view.tile_box(*box)
        visible, near = dr.detach(visible & (x1 > x0) & (y1 > y0)), dr.detach(near)
        dr.eval(visible, near)
        return visible, near

    def records(self, owner: Any, local: Any, near: Any) -> tuple[Any, Any, Any, Any]:
        """View records, rows of those at the camera, least depths of the ellipsoids, and boxes of tiles."""
        count = dr.width(local)
        g = self.load(owner, local)
        response, opacity, _, _, _, box, least = self.bounds(g)
        colour = self.colour(g["mean"], local)
        order = dr.arange(mi.UInt32, count)
        near_rows = None
        near_index = dr.compress(near)
        near_number = dr.zeros(mi.UInt32, count)
        if dr.width(near_index) > 0:
            near_rows = self.near_rows(near_index, owner, local)
            dr.scatter(near_number, dr.arange(mi.UInt32, dr.width(near_index)), near_index)
        scaled = LOG2_E_HALF
        record = [
            dr.select(near, mi.Float(near_number), response.u0),
            response.v0,
            dr.select(near, -1.0, response.a * scaled),
            response.b2 * scaled,
            response.c * scaled,
            dr.log2(opacity),
            *colour,
            response.depth,
            response.e,
            response.f,
            response.g,
            response.h,
            response.i,
            g["instance"],
        ]
        records, tile_box = dr.empty(mi.Float, RECORD * count), dr.empty(mi.UInt32, 4 * count)
        dr.scatter(records, mi.ArrayXf(record), order)
        x0, x1, y0, y1 = self.view.tile_box(*(dr.detach(side) for side in box))
        dr.scatter(tile_box, mi.ArrayXu([x0, x1, y0, y1]), order)
        least = dr.detach(least)
        dr.eval(records, tile_box, least)
        return records, near_rows, least, tile_box

    def near_rows(self, index: Any, owner: Any, local: Any) -> Any:
        """General responses of Gaussians at the camera's plane."""
        count = dr.width(index)
        g = self.load(dr.gather(mi.UInt32, owner, index), dr.gather(mi.UInt32, local, index))
        shape = {k: g[k] for k in ("mean", "axes", "sigma", "right", "down", "forward", "scale")}
        c = [dr.detach(v) for v in general_response(**shape)]
        rows = dr.empty(mi.Float, RECORD * count)
        row = [*[x * LOG2_E_HALF for x in c[:6]], *c[6:], mi.Float(0)]
        dr.scatter(rows, mi.ArrayXf(row), dr.arange(mi.UInt32, count))
        dr.eval(rows)
        return rows

    def colour(self, mean: Any, local: Any) -> list[Any]:
        clouds = self.clouds
        bands = min(clouds.sh_count, (self.quality.sh_degree + 1) ** 2)
        floats = -(-3 * bands // 4) * 4
        base = local * (clouds.sh_stride // 4)
        packets = [dr.gather(mi.Array4f, clouds.sh, base + j, mode=_ADJOINT) for j in range(floats // 4)]

        def coefficient(k: int) -> list[Any]:
            return [packets[(3 * k + c) // 4][(3 * k + c) % 4] for c in range(3)]

        # A Gaussian centred on the camera is seen along no direction: only its constant band counts.
        direction = mean * dr.rsqrt(dr.maximum(dr.squared_norm(mean), 1e-30))
        return evaluate_sh(direction, coefficient, bands)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of a record and a tile, record after record: record, tile, level of depth; and where each record starts."""

    record: Any
    tile: Any
    level: Any
    first: Any


def _pair(records: Any, least: Any, box: Any, view: View, quality: Quality) -> _Pairs | None:
    """Pairs of every record with the tiles it meets, or None if there are none.

    Raises:
        CrowdedError: If there are more than :data:`PAIRS_MAX`.
    """
    count = dr.width(least)
    order = dr.arange(mi.UInt32, count)
    x0, x1, y0, y1 = dr.gather(mi.Array4u, box, order)
    row_of, rows = _ranges(dr.select(y1 > y0, y1 - y0, 0))
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
        dr.scatter(owner, order, row, mode=dr.ReduceMode.Permute)
        dr.scatter(first_tile, y * view.tiles_x + lo, row, mode=dr.ReduceMode.Permute)
        dr.scatter(length, dr.select(hi > lo, hi - lo, 0), row, mode=dr.ReduceMode.Permute)
        return (y + 1,)

    dr.while_loop((mi.UInt32(y0),), lambda y: y < y1, one_row, label="spans of tiles")
    dr.eval(owner, first_tile, length)
    pair_of, pairs = _ranges(length)
    if pairs == 0:
        return None
    record = dr.gather(mi.ArrayXf, records, owner, shape=(RECORD, rows))
    ellipsoid = dr.gather(mi.Float, least, owner)
    number, tile_of, level_of = (dr.empty(mi.UInt32, pairs) for _ in range(3))
    first = dr.empty(mi.UInt32, count + 1)

    def one_tile(k: Any) -> tuple[Any]:
        tile, pair = first_tile + k, pair_of + k
        slopes = view.tile_slopes(tile)
        if quality.order == "ray":
            depth = _least_depth(record, ellipsoid, slopes)
        else:
            depth = _depth_near_centre(record, slopes)
        for target, value in ((number, owner), (tile_of, tile), (level_of, _level(depth, view))):
            dr.scatter(target, value, pair, mode=dr.ReduceMode.Permute)
        return (k + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, rows),), lambda k: k < length, one_tile, label="pairs")
    end, inside = dr.opaque(mi.UInt32, pairs), row_of < dr.opaque(mi.UInt32, rows)
    dr.scatter(first, dr.select(inside, dr.gather(mi.UInt32, pair_of, row_of, inside), end), order)
    dr.scatter(first, end, dr.opaque(mi.UInt32, count))
    dr.eval(number, tile_of, level_of, first)
    return _Pairs(number, tile_of, level_of, first)


def _ranges(sizes: Any) -> tuple[Any, int]:
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

    def straight(y: Any) -> tuple[Any, Any]:
        _, _, lo_v, hi_v = view.tile_slopes(y * view.tiles_x)
        lo_u, hi_u, meets = ellipse_span(conic, lo_v - v0, hi_v - v0)
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


def _sorted(key: Any, bits: int, order: Any | None = None) -> Any:
    """Stable order of keys of so many bits: positions in ``key``, which is taken in ``order`` if that is given.

    A radix sort like Dr.Jit's own, which knows no keys shorter than 32 bits.
    """
    count = dr.width(key)
    radix = 16 if dr.backend_v(key) == dr.JitBackend.LLVM else 8
    passes = -(-bits // radix)
    width = -(-bits // passes)
    for shift in range(0, bits, width):
        digit = (key if order is None else dr.gather(mi.UInt32, key, order)) >> shift & ((1 << width) - 1)
        dr.eval(digit)
        permutation = dr.detail.block_mkperm(digit, count, 1 << width)
        order = permutation if order is None else dr.gather(mi.UInt32, order, permutation)
        dr.eval(order)
    return order


def _first_entries(tile: Any, order: Any, tiles: int) -> Any:
    """Number of the first entry of every tile, and of all entries, by bisection."""
    wanted = dr.arange(mi.UInt32, tiles + 1)
    pairs = dr.opaque(mi.UInt32, dr.width(order))

    def halve(low: Any, high: Any) -> tuple[Any, Any]:
        middle = (low + high) // 2
        before = dr.gather(mi.UInt32, tile, dr.gather(mi.UInt32, order, middle, low < high), low < high) < wanted
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


def _depth_near_centre(record: Any, slopes: tuple[Any, Any, Any, Any]) -> Any:
    """Depth of a Gaussian's peak along that ray of a tile which passes its centre most closely."""
    lo_u, hi_u, lo_v, hi_v = slopes
    du, dv = dr.clip(record[0], lo_u, hi_u) - record[0], dr.clip(record[1], lo_v, hi_v) - record[1]
    top, bottom = _depth_fraction(record, du, dv)
    return dr.select(record[2] < 0, 0, record[9] * dr.maximum(top, 0) / bottom)


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
