"""Sort depths of Gaussians in an image tile, and their quantised levels in sort keys.

In the order per tile, the sort depth is the depth of the peak along the ray around which the tile sees most of the
Gaussian. In the order per ray, it is a lower bound over all rays of the tile, which tells when no later entry can come
first.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Quality
from mitsplat.renderer.projection.gaussian import LOG2_E_HALF
from mitsplat.renderer.projection.records import GaussianRecord, PlaneRecord
from mitsplat.renderer.rays.camera_rays import CameraView

DEPTH_BITS = 16
"""Bits of a depth in sort keys: 11 bits of its mantissa separate depths that differ by 0.05 %, and 5 bits of its
exponent cover depths up to 2^32 times the near plane. Equal levels stay in the order of the clouds.
"""

_BITS_OF_1 = 0x3F800000
"""Bit pattern of the float 1."""


def level_of(depth: mi.Float, view: CameraView) -> mi.UInt32:
    """Quantise a depth to its level: the leading bits of its ratio to the near plane, which increase with the ratio."""
    ratio = dr.clip(depth / view.near_plane, 1.0, 0.9999 * 2.0**32)
    return (dr.reinterpret_array(mi.UInt32, ratio) - _BITS_OF_1) >> (23 + 5 - DEPTH_BITS)


def depth_of_level(level: mi.UInt32, view: CameraView) -> mi.Float:
    """Return the least depth of a level; depths in front of the near plane have level 0."""
    ratio = dr.reinterpret_array(mi.Float, (level << (23 + 5 - DEPTH_BITS)) + _BITS_OF_1)
    return dr.select(level == 0, 0, (1 - 1e-6) * ratio * view.near_plane)


def depths_by_tile(
    record: GaussianRecord,
    plane_records: mi.Float | None,
    ellipsoid: mi.Float,
    first: mi.UInt32,
    view: CameraView,
    quality: Quality,
) -> Callable[[mi.UInt32], mi.Float]:
    """Return a function from a tile to the sort depth of a record in it.

    The tile must be in the same row of tiles as ``first``. In an undistorted view, most of the computation is the same
    for a whole row. ``plane_records`` are as in :class:`mitsplat.renderer.splatting.tiles.TileLists`.
    """
    if quality.order == "ray":
        return lambda tile: least_depth(record, ellipsoid, view.tile_slopes(tile))
    if view.distortion:

        def usual(tile: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float]:
            lo_u, hi_u, lo_v, hi_v = slopes = view.tile_slopes(tile)
            return 0.5 * (lo_u + hi_u), 0.5 * (lo_v + hi_v), depth_where_seen(record, slopes)
    else:
        (first_u, step_u, width), (first_v, step_v, height) = view.tile_grid()
        row = first // view.tiles_x
        depth_around, begin = _depths_where_seen(record, width, height), row * view.tiles_x
        v = dr.fma(mi.Float(row), step_v, first_v)

        def usual(tile: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float]:
            u = dr.fma(mi.Float(tile - begin), step_u, first_u)
            return u, v, depth_around(u - record.u0, v - record.v0)

    if plane_records is None:
        return lambda tile: usual(tile)[2]
    at_plane = record.at_plane
    plane_record = PlaneRecord.fetch(plane_records, dr.select(at_plane, mi.UInt32(record.u0), 0))

    def depth_of(tile: mi.UInt32) -> mi.Float:
        u, v, depth = usual(tile)
        # Gaussians that reach the camera's plane are large relative to a tile, so the depth at the tile's centre is
        # used.
        return dr.select(at_plane, dr.maximum(plane_record.depth(u, v), 0), depth)

    return depth_of


def depth_where_seen(record: GaussianRecord, slopes: tuple[mi.Float, mi.Float, mi.Float, mi.Float]) -> mi.Float:
    """Return the peak depth of a Gaussian along the ray around which a tile sees most of it.

    ``slopes`` are the limits of the tile (lo_u, hi_u, lo_v, hi_v).
    """
    lo_u, hi_u, lo_v, hi_v = slopes
    depth_around = _depths_where_seen(record, hi_u - lo_u, hi_v - lo_v)
    return depth_around(0.5 * (lo_u + hi_u) - record.u0, 0.5 * (lo_v + hi_v) - record.v0)


def _depths_where_seen(
    record: GaussianRecord, width: mi.Float, height: mi.Float
) -> Callable[[mi.Float, mi.Float], mi.Float]:
    """Return a function from a tile centre, relative to the footprint's centre, to :func:`depth_where_seen`.

    All tiles have the size ``width`` x ``height`` in slopes. Let M be the inverse covariance of the footprint, and V
    the covariance of the tile's pixels, modelled as a Gaussian around the tile centre m. The product of both Gaussians
    has its mean at (I + V M)^-1 m from the footprint's centre. This mean lies near the footprint's centre for small
    Gaussians, and at the tile centre for large ones.
    """
    a, b2, c = record.a, record.b2, record.c
    variance_u, variance_v = (dr.square(w) / (12 * LOG2_E_HALF) for w in (width, height))
    # The limits avoid overflow; a Gaussian so much smaller than the tile is seen at its own centre.
    p11, p22 = 1 + dr.minimum(variance_u * a, 1e15), 1 + dr.minimum(variance_v * c, 1e15)
    b = dr.clip(0.5 * b2, -1e15 / variance_u, 1e15 / variance_u)
    inverse = dr.rcp(dr.maximum(p11 * p22 - variance_u * b * (variance_v * b), 1))
    uu, uv = inverse * p22, inverse * (variance_u * b)
    vu, vv = inverse * (variance_v * b), inverse * p11
    half_u, half_v = 0.5 * width, 0.5 * height

    def depth_around(middle_u: mi.Float, middle_v: mi.Float) -> mi.Float:
        du, dv = uu * middle_u - uv * middle_v, vv * middle_v - vu * middle_u
        du = dr.clip(du, middle_u - half_u, middle_u + half_u)
        dv = dr.clip(dv, middle_v - half_v, middle_v + half_v)
        top, bottom = _depth_fraction(record, du, dv)
        return record.depth * dr.maximum(top, 0) / bottom

    return depth_around


def least_depth(
    record: GaussianRecord, ellipsoid: mi.Float, slopes: tuple[mi.Float, mi.Float, mi.Float, mi.Float]
) -> mi.Float:
    """Return a lower bound of the depth of a Gaussian's peak along all rays of a tile.

    The numerator of the depth is linear in the slopes and the denominator is convex, so that both are bounded at the
    corners. In addition, the peak cannot lie in front of the cut-off ellipsoid.
    """
    lo_u, hi_u, lo_v, hi_v = slopes
    least, largest = mi.Float(dr.inf), mi.Float(0)
    for u in (lo_u, hi_u):
        for v in (lo_v, hi_v):
            top, bottom = _depth_fraction(record, u - record.u0, v - record.v0)
            least, largest = dr.minimum(least, top), dr.maximum(largest, bottom)
    bound = dr.maximum(record.depth * dr.maximum(least, 0) / largest, ellipsoid)
    return dr.select(record.at_plane, 0, dr.maximum(bound, 0))


def _depth_fraction(record: GaussianRecord, du: mi.Float, dv: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return numerator and denominator of a peak's depth relative to the depth of the centre."""
    e, f, g, h, i = record.e, record.f, record.g, record.h, record.i
    top = dr.fma(0.5, dr.fma(du, e, dv * f), 1)
    return top, dr.fma(dv, dr.fma(dv, i, dr.fma(du, h, f)), dr.fma(du, dr.fma(du, g, e), 1))
