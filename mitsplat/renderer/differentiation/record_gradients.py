"""Gradients of view records from gradients of a picture: a second march over the same tile lists.

Front-to-back blending computes ``C = sum_i T_i a_i c_i`` with ``T_i = prod_{j<i} (1 - a_j)``. Let S_i be the partial
sum including i. The light behind i is ``C - S_i``, so that no list is walked backwards:

    dC / da_i = T_i c_i - (C - S_i) / (1 - a_i),     dC / dc_i = T_i a_i,     dA / da_i = T_end / (1 - a_i)

With ``a = exp2(log2 o - q)`` and ``q = N / D`` as in module `gaussian`, the chain rule gives the derivatives of the
view records. Dr.Jit's automatic differentiation continues through the projection to the Gaussians.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.quality import Quality
from mitsplat.renderer.projection.records import RECORD, GaussianRecord
from mitsplat.renderer.rays.camera_rays import TILE_WIDTH, CameraView
from mitsplat.renderer.splatting.lanes import Lanes
from mitsplat.renderer.splatting.tiles import TileLists
from mitsplat.renderer.splatting.walk import max_of

LN_2 = 0.6931471805599453

PAIRS_AT_ONCE = 1 << 20
"""Number of pairs of a Gaussian and a tile whose gradients are stored at once, 512 bytes each."""


def march_backward(
    lists: TileLists,
    view: CameraView,
    quality: Quality,
    seen: list[mi.Float],
    gradient: list[mi.Float],
    slopes: tuple[list[mi.Float], list[mi.Float]] | None,
) -> mi.Float:
    """Return the gradient of the flat view records from gradients of red, green, blue and alpha.

    Args:
        lists: Records per tile.
        view: Camera.
        quality: Cut-offs.
        seen: Rendered red, green, blue and alpha.
        gradient: Gradients of these.
        slopes: Slopes of the rays if already known.
    """
    if lists.pairs == 0:
        return dr.zeros(mi.Float, RECORD * max(1, lists.visible))
    slopes = slopes or Lanes(lists, view).centre_slopes()
    if lists.pairs <= PAIRS_AT_ONCE:
        return tile_gradient(lists, view, quality, seen, gradient, slopes)
    total = dr.zeros(mi.Float, RECORD * lists.visible)
    for part, lane in _parts(lists):
        us, vs = ([dr.gather(mi.Float, values, lane) for values in axis] for axis in slopes)
        total += tile_gradient(part, view, quality, seen, gradient, (us, vs))
        dr.eval(total)
    return total


def _parts(lists: TileLists) -> Iterator[tuple[TileLists, mi.UInt32]]:
    """Yield lists of consecutive tiles with at most :data:`PAIRS_AT_ONCE` pairs, and their lane numbers.

    A single tile may have more pairs. Positions by record are counted within each part.
    """
    begins = np.append(np.array(lists.start), lists.pairs).astype(np.int64)
    first = 0
    while first < len(begins) - 1:
        last = int(np.searchsorted(begins, begins[first] + PAIRS_AT_ONCE, side="right")) - 1
        last = min(max(last, first + 1), len(begins) - 1)
        begin, pairs = int(begins[first]), int(begins[last] - begins[first])
        if pairs:
            entry = dr.arange(mi.UInt32, pairs) + dr.opaque(mi.UInt32, begin)
            mine = dr.zeros(mi.UInt32, lists.pairs + 1)
            dr.scatter(mine, mi.UInt32(1), dr.gather(mi.UInt32, lists.slots, entry))
            place = dr.prefix_sum(mine)
            tile = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
            part = replace(
                lists,
                slots=dr.gather(mi.UInt32, place, lists.slots),
                first=dr.gather(mi.UInt32, place, lists.first),
                start=dr.gather(mi.UInt32, lists.start, tile),
                stop=dr.gather(mi.UInt32, lists.stop, tile),
                pairs=pairs,
                tiles=tile,
            )
            dr.eval(part.slots, part.first, part.start, part.stop, tile)
            yield part, dr.arange(mi.UInt32, (last - first) * TILE_WIDTH) + dr.opaque(mi.UInt32, first * TILE_WIDTH)
        first = last


def tile_gradient(
    lists: TileLists,
    view: CameraView,
    quality: Quality,
    seen: list[mi.Float],
    gradient: list[mi.Float],
    slopes: tuple[list[mi.Float], list[mi.Float]],
) -> mi.Float:
    """Return the gradient of the flat view records from some tiles; arguments as in :func:`march_backward`.

    ``lists.pairs`` is an upper bound of the pairs in these tiles, and ``slopes`` are those of their lanes.
    """
    lanes = Lanes(lists, view)
    column = dr.arange(mi.UInt32, dr.width(lanes.start)) % TILE_WIDTH
    shares = dr.zeros(mi.Float, RECORD * TILE_WIDTH * lists.pairs)
    cut = dr.log2(dr.opaque(mi.Float, quality.alpha_min))
    end, near = dr.opaque(mi.Float, quality.transmittance_min), view.near_plane
    d_colour, behind = _pixel_gradients(lanes, seen, gradient)

    def one_entry(
        i: mi.UInt32, light: list[mi.Float], rest: list[mi.Float]
    ) -> tuple[mi.UInt32, list[mi.Float], list[mi.Float]]:
        record = GaussianRecord.fetch(lists.records, dr.gather(mi.UInt32, lists.entries, i))
        sums = [mi.Float(0) for _ in range(RECORD)]
        new_light, new_rest = [], []
        for u, v, t, r, d_pixel in zip(*slopes, light, rest, d_colour, strict=True):
            parts, weight, r = _ray_gradient(record, u, v, t, r, d_pixel, cut=cut, near=near, end=end)
            sums = [total + part for total, part in zip(sums, parts, strict=True)]
            new_light.append(t - weight)
            new_rest.append(r)
        dr.scatter(shares, mi.ArrayXf(sums), dr.gather(mi.UInt32, lists.slots, i) * TILE_WIDTH + column)
        return i + 1, new_light, new_rest

    def alive(i: mi.UInt32, light: list[mi.Float], rest: list[mi.Float]) -> mi.Bool:
        return (i < lanes.stop) & (max_of(light) > end)

    state = lanes.start, [mi.Float(1) for _ in behind], behind
    dr.while_loop(state, alive, one_entry, label="march backward")
    dr.eval(shares)
    return _sum_shares(shares, lists)


def _pixel_gradients(
    lanes: Lanes, seen: list[mi.Float], gradient: list[mi.Float]
) -> tuple[list[tuple[mi.Float, ...]], list[mi.Float]]:
    """Return the gradient of the colour of each of a lane's pixels, and the start value of the light behind.

    The light behind is weighted with the gradient. The gradient of alpha, through the final transmittance, is
    subtracted from it.
    """

    def load(values: mi.Float) -> list[mi.Float]:
        return [dr.gather(mi.Float, values, p, m) for p, m in zip(lanes.pixel, lanes.inside, strict=True)]

    d_colour = list(zip(*(load(g) for g in gradient[:3]), strict=True))
    whole = list(zip(*(load(c) for c in seen[:3]), strict=True))
    behind = [
        sum(c * d for c, d in zip(cs, ds, strict=True)) - (1 - a) * d_alpha
        for cs, ds, a, d_alpha in zip(whole, d_colour, load(seen[3]), load(gradient[3]), strict=True)
    ]
    return d_colour, behind


def _ray_gradient(
    record: GaussianRecord,
    u: mi.Float,
    v: mi.Float,
    light: mi.Float,
    rest: mi.Float,
    d_colour: tuple[mi.Float, ...],
    *,
    cut: mi.Float,
    near: mi.Float,
    end: mi.Float,
) -> tuple[GaussianRecord, mi.Float, mi.Float]:
    """Differentiate the blending of one Gaussian on a ray, by the chain rule of the module docstring.

    Args:
        record: Gaussian.
        u: Slope of the ray.
        v: Slope of the ray.
        light: Transmittance T_i in front of the Gaussian.
        rest: Light behind the last Gaussian, weighted with the gradient, minus the gradient of alpha.
        d_colour: Gradients of the pixel's red, green and blue.
        cut: log2 of the smallest opacity that counts.
        near: Smallest visible depth [m].
        end: Transmittance at which a ray ends.

    Returns:
        Gradient of the record, its weight T_i a_i in the pixel, and ``rest`` behind this Gaussian.
    """
    u0, v0, a, b2, c, log_opacity, red, green, blue, depth, e, f, g, h, k, _ = record
    d_red, d_green, d_blue = d_colour
    du, dv = u - u0, v - v0
    inverse = dr.rcp(1 + du * (e + g * du + h * dv) + dv * (f + k * dv))
    q = (du * (a * du + b2 * dv) + dv * dv * c) * inverse
    z = depth * (1 + 0.5 * (e * du + f * dv)) * inverse
    hit = (log_opacity - q > cut) & (z > near) & (light > end)
    # A response that overflows beyond the cut-off, or that rounding raises above the peak, has no gradient.
    inverse, q = dr.select(hit & (q > 0), inverse, 0), dr.select(hit & (q > 0), q, 0)
    alpha = dr.select(hit, dr.exp2(log_opacity - q), 0)
    weight = light * alpha
    d_own = red * d_red + green * d_green + blue * d_blue
    rest = rest - weight * d_own
    d_alpha = light * d_own - rest / dr.maximum(1 - alpha, 1e-5)
    d_log = d_alpha * alpha * LN_2
    d_top, d_bottom = -d_log * inverse, d_log * q * inverse
    gradient = GaussianRecord(
        u0=-(d_top * (2 * a * du + b2 * dv) + d_bottom * (e + 2 * g * du + h * dv)),
        v0=-(d_top * (2 * c * dv + b2 * du) + d_bottom * (f + 2 * k * dv + h * du)),
        a=d_top * du * du,
        b2=d_top * du * dv,
        c=d_top * dv * dv,
        log_opacity=d_log,
        red=weight * d_red,
        green=weight * d_green,
        blue=weight * d_blue,
        depth=0,
        e=d_bottom * du,
        f=d_bottom * dv,
        g=d_bottom * du * du,
        h=d_bottom * du * dv,
        i=d_bottom * dv * dv,
        instance=0,
    )
    return gradient, weight, rest


def _sum_shares(shares: mi.Float, lists: TileLists) -> mi.Float:
    """Sum the gradients of each record over the columns of its tiles.

    The order of additions is fixed, so that every run is bit-identical; atomic additions are not. A record that covers
    many tiles is summed by several lanes, so that other lanes do not wait for it.
    """
    record = dr.arange(mi.UInt32, lists.visible)
    first = dr.gather(mi.UInt32, lists.first, record)
    pairs = dr.gather(mi.UInt32, lists.first, record + 1) - first
    runs = dr.maximum((pairs + (_TILES_PER_LANE - 1)) // _TILES_PER_LANE, 1)
    begin = dr.prefix_sum(runs)
    lanes = lists.visible + lists.pairs // _TILES_PER_LANE  # upper bound of the number of runs; spare lanes add nothing
    marks = dr.zeros(mi.UInt32, lanes)
    dr.scatter(marks, mi.UInt32(1), begin, begin > 0)
    owner = dr.cumsum(marks)
    run = dr.arange(mi.UInt32, lanes) - dr.gather(mi.UInt32, begin, owner)
    start = dr.gather(mi.UInt32, first, owner) + run * _TILES_PER_LANE
    stop = dr.minimum(start + _TILES_PER_LANE, dr.gather(mi.UInt32, lists.first, owner + 1))
    partial = _sum_rows(shares, start * TILE_WIDTH, stop * TILE_WIDTH)
    return _sum_rows(partial, begin, begin + runs)


_TILES_PER_LANE = 32
"""Number of tiles whose gradients one lane adds."""


def _sum_rows(rows: mi.Float, start: mi.UInt32, stop: mi.UInt32) -> mi.Float:
    """Sum the rows of :data:`RECORD` floats from ``start`` to ``stop`` (exclusive); return one row per range."""
    width = dr.width(start)

    def add(i: mi.UInt32, sums: list[mi.Float]) -> tuple[mi.UInt32, list[mi.Float]]:
        row = dr.gather(mi.ArrayXf, rows, i, shape=(RECORD, dr.width(i)))
        return i + 1, [total + own for total, own in zip(sums, row, strict=True)]

    zeros = [mi.Float(0) for _ in range(RECORD)]
    _, sums = dr.while_loop((start, zeros), lambda i, sums: i < stop, add, label="sum rows")
    result = dr.empty(mi.Float, RECORD * width)
    dr.scatter(result, mi.ArrayXf(sums), dr.arange(mi.UInt32, width))
    dr.eval(result)
    return result
