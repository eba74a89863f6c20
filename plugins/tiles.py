"""From clouds of Gaussians to depth-sorted lists per image tile, all on the device.

1. *Cull and bound* every Gaussian of every placement (one kernel): exact screen box of its cut-off ellipsoid.
2. *Sort* the visible ones by depth; compute view records in that order (one kernel).
3. *Pair* each with the tiles that its cut-off ellipse really meets, and sort the pairs by tile and by depth there. For
   the order per tile that is the peak's depth along the tile's ray nearest to the Gaussian's centre; for the order per
   ray it is a lower bound over all rays of the tile, which says when a ray has seen all that can come first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.plugins.gaussian import (
    LOG2_E_HALF,
    RECORD,
    Cloud,
    aligned,
    conic_touches_rectangle,
    ellipse_bounds,
    evaluate_sh,
    general_response,
    project_gaussian,
    rotation_axes,
    wrapped,
)
from mitsplat.plugins.rays import View
from mitsplat.quality import KERNELS, Quality

PLACEMENT = 32
"""Floats per placement: camera axes in the cloud's frame (9), scale, instance id, first Gaussian, camera centre in the
cloud's frame as a sum of two floats (3 + 3), padding. Two floats keep the difference exact far from the origin."""

BOUNDS = 12
"""Floats per visible Gaussian for pairing: u0, v0, cut-off conic about them, least depth of the ellipsoid, padding."""


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

CANDIDATES_MAX = 1 << 26
"""Most pairs of a Gaussian and a tile in its box that are held at once, about 40 bytes each."""


_OCTAVES = 20.0
"""Depths from the near plane to a million times as far are told apart in the order per tile."""


class CrowdedError(Exception):
    """A view has more pairs than :data:`CANDIDATES_MAX`: render a part of it."""


@dataclass(frozen=True, eq=False)
class TileLists:
    """Depth-sorted Gaussians of every tile.

    Attributes:
        records: View records in depth order, see :data:`mitsplat.plugins.gaussian.RECORD`.
        near: Coefficients of :func:`mitsplat.plugins.gaussian.general_response`, 16 floats each, of the Gaussians that
            reach the camera's plane, or None; their records hold -1 for A and the row's number for u0.
        entries: Record numbers, tile after tile.
        slots: Place of every entry if they were sorted by record number instead.
        nearest: Least depth [m] that an entry's peak can have in its tile, ascending per tile; for the order per ray.
        start, stop: Range of each tile in ``entries``.
        visible, pairs: Number of records and of entries.
    """

    records: Any
    near: Any | None
    entries: Any
    slots: Any
    nearest: Any
    start: Any
    stop: Any
    visible: int
    pairs: int


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

    depth, visible = source.cull(owner, local)
    index = dr.compress(visible)
    count = dr.width(index)
    if count == 0:
        return _empty(tiles)
    index = dr.gather(mi.UInt32, index, dr.argsort(dr.detach(dr.gather(mi.Float, depth, index))))
    owner, local = dr.gather(mi.UInt32, owner, index), dr.gather(mi.UInt32, local, index)
    dr.eval(owner, local)

    records, near, bounds, box, candidates = source.records(owner, local)
    # As floats, because a sum of integers would wrap.
    if dr.sum(mi.Float(candidates))[0] > CANDIDATES_MAX:
        raise CrowdedError
    entries, slots, nearest, start, stop = _pair(
        dr.detach(records), bounds, box, candidates, view, tiles, quality.order
    )
    return TileLists(records, near, entries, slots, nearest, start, stop, count, dr.width(entries))


def _empty(tiles: int) -> TileLists:
    zeros = dr.zeros(mi.UInt32, tiles)
    dr.eval(zeros)
    entry = dr.zeros(mi.UInt32, 1)
    return TileLists(dr.zeros(mi.Float, RECORD), None, entry, entry, dr.zeros(mi.Float, 1), zeros, zeros, 0, 0)


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
        return aligned(rows), dr.zeros(mi.UInt32, total), local
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
    return aligned(rows), owner, local


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
        g = self.load(owner, local)
        response, _, _, _, visible, box, _ = self.bounds(g)
        x0, x1, y0, y1 = self.view.tile_box(*box)
        visible &= (x1 > x0) & (y1 > y0)
        depth, visible = dr.detach(response.depth), dr.detach(visible)
        # Depth first as the sort key; Gaussians behind the camera that still reach in front of it come first.
        depth = dr.maximum(depth, 0.0)
        dr.eval(depth, visible)
        return depth, visible

    def records(self, owner: Any, local: Any) -> tuple[Any, ...]:
        count = dr.width(local)
        g = self.load(owner, local)
        response, opacity, k2, near, _, box, least = self.bounds(g)
        colour = self.colour(g["mean"], local)
        order = dr.arange(mi.UInt32, count)
        near_rows = None
        near_index = dr.compress(near)
        near_number = dr.zeros(mi.UInt32, count)
        conic = response.cutoff(k2)
        u0, v0 = response.u0, response.v0
        if dr.width(near_index) > 0:
            near_rows, near_cut = self.near_rows(near_index, owner, local)
            dr.scatter(near_number, dr.arange(mi.UInt32, dr.width(near_index)), near_index)
            u0, v0 = dr.select(near, 0.0, u0), dr.select(near, 0.0, v0)
            row = dr.gather(mi.ArrayXf, near_cut, near_number, near, shape=(8, count))
            conic = tuple(dr.select(near, row[i], c) for i, c in enumerate(conic))
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
        records, bounds = dr.empty(mi.Float, RECORD * count), dr.empty(mi.Float, BOUNDS * count)
        dr.scatter(records, mi.ArrayXf(record), order)
        dr.scatter(bounds, mi.ArrayXf([dr.detach(v) for v in (u0, v0, *conic, least, *[mi.Float(0)] * 3)]), order)
        x0, x1, y0, y1 = self.view.tile_box(*(dr.detach(side) for side in box))
        candidates = (x1 - x0) * (y1 - y0)
        tile_box = dr.empty(mi.UInt32, 4 * count)
        dr.scatter(tile_box, mi.ArrayXu([x0, y0, x1 - x0, y1 - y0]), order)
        dr.eval(records, bounds, tile_box, candidates)
        return records, near_rows, bounds, tile_box, candidates

    def near_rows(self, index: Any, owner: Any, local: Any) -> tuple[Any, Any]:
        """General responses of Gaussians at the camera's plane, and their cut-off conics padded to 8 floats."""
        count = dr.width(index)
        g = self.load(dr.gather(mi.UInt32, owner, index), dr.gather(mi.UInt32, local, index))
        k2 = 2 * dr.log(g.pop("opacity") / self.cut)
        g.pop("instance")
        c = [dr.detach(v) for v in general_response(**g)]
        k2 = dr.detach(k2)
        rows, cuts = dr.empty(mi.Float, RECORD * count), dr.empty(mi.Float, 8 * count)
        order = dr.arange(mi.UInt32, count)
        zero = dr.zeros(mi.Float, count)
        dr.scatter(rows, mi.ArrayXf([*[x * LOG2_E_HALF for x in c[:6]], *c[6:], zero]), order)
        dr.scatter(cuts, mi.ArrayXf([*[n - k2 * d for n, d in zip(c[:6], c[6:12], strict=True)], zero, zero]), order)
        dr.eval(rows, cuts)
        return rows, cuts

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


def _pair(
    records: Any, bounds: Any, box: Any, candidates: Any, view: View, tiles: int, order: str
) -> tuple[Any, Any, Any, Any, Any]:
    """Sorted (tile, Gaussian) pairs: record number, slot and least depth per entry, and each tile's range."""
    count = dr.width(candidates)
    offset = dr.prefix_sum(candidates)
    total = int((dr.gather(mi.UInt32, offset, count - 1) + dr.gather(mi.UInt32, candidates, count - 1))[0])
    marks = dr.zeros(mi.UInt32, total)
    dr.scatter(marks, mi.UInt32(1), offset, offset > 0)
    rank = dr.cumsum(marks)
    cell = dr.arange(mi.UInt32, total) - dr.gather(mi.UInt32, offset, rank)
    x0, y0, width, _ = dr.gather(mi.ArrayXu, box, rank, shape=(4, total))
    # Lanes past the end of the arrays compute too, on zeros: an integer division by zero would end the process.
    row = cell // dr.maximum(width, 1)
    tile = (y0 + row) * view.tiles_x + x0 + (cell - row * width)
    u0, v0, *conic, _, _, _, _ = dr.gather(mi.ArrayXf, bounds, rank, shape=(BOUNDS, total))
    lo_u, hi_u, lo_v, hi_v = view.tile_slopes(tile)
    meets = conic_touches_rectangle(tuple(conic), lo_u - u0, hi_u - u0, lo_v - v0, hi_v - v0)
    dr.eval(tile, rank, meets)
    kept = dr.compress(meets)
    pairs = dr.width(kept)
    start, stop = dr.zeros(mi.UInt32, tiles), dr.zeros(mi.UInt32, tiles)
    if pairs == 0:
        dr.eval(start, stop)
        entry = dr.zeros(mi.UInt32, 1)
        return entry, entry, dr.zeros(mi.Float, 1), start, stop
    tile, rank = dr.gather(mi.UInt32, tile, kept), dr.gather(mi.UInt32, rank, kept)
    record = dr.gather(mi.ArrayXf, records, rank, shape=(RECORD, pairs))
    if order == "ray":
        ellipsoid = dr.gather(mi.Float, bounds, rank * BOUNDS + 8)
        depth = _least_depth(record, ellipsoid, view.tile_slopes(tile))
        dr.eval(tile, rank, depth)
        by_depth = dr.argsort(depth)
        by_tile = dr.argsort(dr.gather(mi.UInt32, tile, by_depth))
        sorted_pairs = dr.gather(mi.UInt32, by_depth, by_tile)
        nearest = dr.gather(mi.Float, depth, sorted_pairs)
    else:
        depth = _depth_near_centre(record, view.tile_slopes(tile))
        key = _tile_key(tile, depth / view.near_plane, tiles)
        dr.eval(tile, rank, key)
        sorted_pairs = dr.argsort(key)
        nearest = dr.zeros(mi.Float, 1)
    tile, entries = dr.gather(mi.UInt32, tile, sorted_pairs), dr.gather(mi.UInt32, rank, sorted_pairs)
    dr.eval(tile, entries, nearest)
    i = dr.arange(mi.UInt32, pairs)
    last = dr.opaque(mi.UInt32, pairs - 1)
    first_of_tile = (i == 0) | (tile != dr.gather(mi.UInt32, tile, dr.maximum(i, 1) - 1))
    last_of_tile = (i == last) | (tile != dr.gather(mi.UInt32, tile, dr.minimum(i + 1, last)))
    dr.scatter(start, i, tile, first_of_tile)
    dr.scatter(stop, i + 1, tile, last_of_tile)
    dr.eval(start, stop)
    return entries, sorted_pairs, nearest, start, stop


def _tile_key(tile: Any, depth: Any, tiles: int) -> Any:
    """Sort key of a tile and, in the bits that are left, the logarithm of a depth in units of the near plane's.

    In 1280 x 720 pixels that tells depths apart that differ by 0.02 %; what is nearer together stays in the order of
    the centres, because the sort is stable. One sort takes half the time of two.
    """
    bits = min(24, 32 - (tiles - 1).bit_length())  # whole numbers that a float can hold
    step = float((1 << bits) - 1) / _OCTAVES
    level = dr.clip(dr.log2(dr.maximum(depth, 1.0)) * dr.opaque(mi.Float, step), 0.0, float((1 << bits) - 1))
    return tile * dr.opaque(mi.UInt32, 1 << bits) + mi.UInt32(level)


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
