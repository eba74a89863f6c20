"""Depths that the Gaussians of an image tile are sorted by, and the levels that stand for them in sort keys.

For the order per tile that is the peak's depth along the ray around which the tile sees most of the Gaussian; for the
order per ray it is a lower bound over all rays of the tile, which says when a ray has seen all that can come first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Quality
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.splatting.gaussian import LOG2_E_HALF, RECORD, general_depth

DEPTH_BITS = 16
"""Bits of a depth that pairs are sorted by: 11 of its mantissa tell depths apart that differ by 0.05 %, and 5 of its
exponent those up to 2^32 times the near plane. Equals stay in the order of the clouds."""

_BITS_OF_1 = 0x3F800000
"""The float 1 as an integer."""


def level_of(depth: Any, view: CameraView) -> Any:
    """Sort key of a depth: the leading bits of its ratio to the near plane, which grow with it."""
    ratio = dr.clip(depth / view.near_plane, 1.0, 0.9999 * 2.0**32)
    return (dr.reinterpret_array(mi.UInt32, ratio) - _BITS_OF_1) >> (23 + 5 - DEPTH_BITS)


def depth_of_level(level: Any, view: CameraView) -> Any:
    """Least depth that has a level; what is nearer than the near plane has level 0."""
    ratio = dr.reinterpret_array(mi.Float, (level << (23 + 5 - DEPTH_BITS)) + _BITS_OF_1)
    return dr.select(level == 0, 0, (1 - 1e-6) * ratio * view.near_plane)


def depths_by_tile(
    record: Any, near: Any | None, ellipsoid: Any, first: Any, view: CameraView, quality: Quality
) -> Callable[[Any], Any]:
    """Function from a tile in the row of tiles of the ``first`` one to a record's depth there, by which it is sorted.

    In an undistorted view, most of it is the same for a whole row. ``near`` is as in
    :class:`mitsplat.renderer.splatting.tiles.TileLists`.
    """
    if quality.order == "ray":
        return lambda tile: least_depth(record, ellipsoid, view.tile_slopes(tile))
    if view.distortion:

        def usual(tile: Any) -> tuple[Any, Any, Any]:
            lo_u, hi_u, lo_v, hi_v = slopes = view.tile_slopes(tile)
            return 0.5 * (lo_u + hi_u), 0.5 * (lo_v + hi_v), depth_where_seen(record, slopes)
    else:
        (first_u, step_u, width), (first_v, step_v, height) = view.tile_grid()
        row = first // view.tiles_x
        depth_around, begin = _depths_where_seen(record, width, height), row * view.tiles_x
        v = dr.fma(mi.Float(row), step_v, first_v)

        def usual(tile: Any) -> tuple[Any, Any, Any]:
            u = dr.fma(mi.Float(tile - begin), step_u, first_u)
            return u, v, depth_around(u - record[0], v - record[1])

    if near is None:
        return lambda tile: usual(tile)[2]
    at_camera = record[2] < 0
    number = dr.select(at_camera, mi.UInt32(record[0]), 0)
    general = dr.gather(mi.ArrayXf, near, number, shape=(RECORD, dr.width(number)))

    def depth_of(tile: Any) -> Any:
        u, v, depth = usual(tile)
        # Those that reach the camera's plane are large against a tile: its middle stands for it.
        return dr.select(at_camera, dr.maximum(general_depth(general, u, v)[1], 0), depth)

    return depth_of


def depth_where_seen(record: Any, slopes: tuple[Any, Any, Any, Any]) -> Any:
    """Depth of a Gaussian's peak along the ray around which a tile between some slopes sees most of it."""
    lo_u, hi_u, lo_v, hi_v = slopes
    depth_around = _depths_where_seen(record, hi_u - lo_u, hi_v - lo_v)
    return depth_around(0.5 * (lo_u + hi_u) - record[0], 0.5 * (lo_v + hi_v) - record[1])


def _depths_where_seen(record: Any, width: Any, height: Any) -> Callable[[Any, Any], Any]:
    """Function from the middle of a tile of such slopes, from the footprint's centre on, to :func:`depth_where_seen`.

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
        return record[9] * dr.maximum(top, 0) / bottom

    return depth_around


def least_depth(record: Any, ellipsoid: Any, slopes: tuple[Any, Any, Any, Any]) -> Any:
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
