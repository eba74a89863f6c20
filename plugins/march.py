"""The march: every ray walks its tile's list front to back and blends what it meets.

One lane carries a column of pixels of one tile, because fetching a record costs several times more than evaluating it
for a packet of rays: the more pixels share a fetch, the better, until registers run out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.plugins.gaussian import RECORD
from mitsplat.plugins.rays import TILE, View
from mitsplat.plugins.tiles import TileLists
from mitsplat.quality import Quality

PIXELS_PER_LANE = 8
"""Pixels of one column that a lane carries, a divisor of the tile's edge."""

SORT_SLOTS = 8
"""Gaussians that the per-ray order collects in one walk over a list."""


@dataclass(eq=False)
class Image:
    """What the rays of one view saw, flat and row-major over height x width pixels.

    Attributes:
        rgb: Display-encoded colour, not divided by alpha, three arrays.
        alpha: Opacity.
        depth: Depth along z [m] at which a ray has lost half its light, or, where it keeps more, the mean depth of what
            it met; 0 where it met nothing.
        instance: Id with the largest share of the ray's opacity; 0 is the environment or nothing.
        share: That share of the ray, in [0, alpha].
    """

    rgb: list[Any]
    alpha: Any
    depth: Any
    instance: Any
    share: Any

    @classmethod
    def empty(cls, count: int) -> Image:
        """Rays that met nothing."""
        nothing = dr.zeros(mi.Float, count)
        return cls([nothing] * 3, nothing, nothing, dr.zeros(mi.UInt32, count), nothing)


Pixel = list[Any]
"""State of a ray: transmittance, red, green, blue, sum of weighted depths, depth at half transmittance, weight of the
environment, id and weight of two instances. Two are enough to find the largest of the environment and any two objects;
a third one evicts the lighter if it weighs more (Misra and Gries' frequent-elements summary)."""

T, RED, GREEN, BLUE, SUM_Z, HALF_Z, W_ENV, ID_1, W_1, ID_2, W_2 = range(11)


def _new_pixel() -> Pixel:
    return [mi.Float(1.0), *(mi.Float(0.0) for _ in range(10))]


def _blend(pixel: Pixel, weight: Any, transmittance: Any, colour: list[Any], z: Any, instance: Any) -> Pixel:
    """The pixel after one more Gaussian in front-to-back order; a weight of 0 changes nothing."""
    half = dr.select((pixel[T] >= 0.5) & (transmittance < 0.5), z, pixel[HALF_Z])
    first, second = instance == pixel[ID_1], instance == pixel[ID_2]
    environment = instance == 0
    other = ~(first | second | environment)
    lighter = pixel[W_2] < pixel[W_1]
    into_2 = other & lighter & (weight > pixel[W_2])
    into_1 = other & ~lighter & (weight > pixel[W_1])
    first &= ~environment
    second &= ~environment
    return [
        transmittance,
        dr.fma(weight, colour[0], pixel[RED]),
        dr.fma(weight, colour[1], pixel[GREEN]),
        dr.fma(weight, colour[2], pixel[BLUE]),
        dr.fma(weight, z, pixel[SUM_Z]),
        half,
        dr.select(environment, pixel[W_ENV] + weight, pixel[W_ENV]),
        dr.select(into_1, instance, pixel[ID_1]),
        dr.select(into_1, weight, dr.select(first, pixel[W_1] + weight, pixel[W_1])),
        dr.select(into_2, instance, pixel[ID_2]),
        dr.select(into_2, weight, dr.select(second, pixel[W_2] + weight, pixel[W_2])),
    ]


def _respond(record: Any, lists: TileLists, us: list[Any], vs: list[Any], shared_column: bool) -> list[tuple[Any, Any]]:
    """(log2 of opacity along the ray, depth of the peak) of one Gaussian on several rays, as in module `gaussian`."""
    u0, v0, a, b2, c, opacity, _, _, _, depth, e, f, g, h, i, _ = record
    result: list[Any] = []
    previous: Any = None
    for u, v in zip(us, vs, strict=True):
        if previous is None or not shared_column:
            du = u - u0
            previous = a * du * du, b2 * du, dr.fma(du, dr.fma(du, g, e), 1), dr.fma(du, h, f), dr.fma(0.5 * du, e, 1)
        top, top_v, bottom, bottom_v, ahead = previous
        dv = v - v0
        numerator = dr.fma(dv, dr.fma(dv, c, top_v), top)
        inverse = dr.rcp(dr.fma(dv, dr.fma(dv, i, bottom_v), bottom))
        result += [opacity - numerator * inverse, depth * dr.fma(0.5 * dv, f, ahead) * inverse]

    def at_the_camera(result: list[Any], row: Any) -> tuple[list[Any], Any]:
        k = dr.gather(mi.ArrayXf, lists.near, mi.UInt32(row), shape=(RECORD, dr.width(row)))
        found: list[Any] = []
        for u, v in zip(us, vs, strict=True):
            inverse = dr.rcp((k[6] * u + k[7] * v + k[9]) * u + (k[8] * v + k[10]) * v + k[11])
            numerator = (k[0] * u + k[1] * v + k[3]) * u + (k[2] * v + k[4]) * v + k[5]
            found += [opacity - numerator * inverse, (k[12] * u + k[13] * v + k[14]) * inverse]
        return found, row

    if lists.near is not None:
        result, _ = dr.if_stmt(
            (result, u0), a < 0, at_the_camera, lambda result, row: (result, row), label="gaussian at the camera"
        )
    return list(zip(result[0::2], result[1::2], strict=True))


class Lanes:
    """Which pixels each lane carries: a column of one tile, so that a packet of lanes is a whole tile.

    Attributes:
        pixel: Number of each of the lane's pixels, row-major.
        inside: Whether it is in the image.
        start, stop: Range of the tile's list.
    """

    def __init__(self, lists: TileLists, view: View, per_lane: int) -> None:
        lanes_per_tile = TILE * TILE // per_lane
        lane = dr.arange(mi.UInt32, view.tiles_x * view.tiles_y * lanes_per_tile)
        within, tile = lane % lanes_per_tile, lane // lanes_per_tile
        tile_y = tile // view.tiles_x
        self.view, self.per_lane = view, per_lane
        self.x = (tile - tile_y * view.tiles_x) * TILE + within % TILE
        self.y = tile_y * TILE + within // TILE * per_lane
        self.pixel = [(self.y + k) * view.width + self.x for k in range(per_lane)]
        self.inside = [(self.x < view.width) & (self.y + k < view.height) for k in range(per_lane)]
        self.start = dr.gather(mi.UInt32, lists.start, tile)
        self.stop = dr.select(self.inside[0], dr.gather(mi.UInt32, lists.stop, tile), self.start)

    def slopes(self, dx: Any, dy: Any) -> tuple[list[Any], list[Any]]:
        """Slopes u and v of the rays at (dx, dy) in the lane's pixels."""
        pairs = [self.view.slopes(mi.Float(self.x) + dx, mi.Float(self.y + k) + dy) for k in range(self.per_lane)]
        return [u for u, _ in pairs], [v for _, v in pairs]


def march(lists: TileLists, view: View, quality: Quality, *, z_max: Any | None = None) -> Image:
    """Blend every ray of a view front to back, and average the rays of each pixel.

    Args:
        lists: Depth-sorted Gaussians per tile.
        view: Camera.
        quality: Order, cut-off and early end.
        z_max: Depth along z [m] of the nearest visible surface per pixel, beyond which nothing is seen.
    """
    n = view.samples
    lanes = Lanes(lists, view, PIXELS_PER_LANE if quality.order == "tile" else 1)
    far = [
        dr.gather(mi.Float, z_max, p, m) if z_max is not None else mi.Float(dr.inf)
        for p, m in zip(lanes.pixel, lanes.inside, strict=True)
    ]
    walk = _walk_in_tile_order if quality.order == "tile" else _walk_in_ray_order
    cut = dr.log2(dr.opaque(mi.Float, quality.alpha_min))
    end = dr.opaque(mi.Float, quality.transmittance_min)
    passes = []
    for i in range(n * n):
        dx, dy = dr.opaque(mi.Float, (i % n + 0.5) / n), dr.opaque(mi.Float, (i // n + 0.5) / n)
        us, vs = lanes.slopes(dx, dy)
        pixels = walk(lists, lanes.start, lanes.stop, us, vs, far, view, cut, end)
        passes.append(_collect(pixels, lanes.pixel, lanes.inside, view.width * view.height))
        if n > 1:
            dr.eval(passes[-1])
    return passes[0] if n == 1 else _average(passes)


def _average(passes: list[Image]) -> Image:
    """Mean of several samples of every pixel; depth and instance are those of the middle sample."""
    share = 1.0 / len(passes)
    middle = passes[len(passes) // 2]

    def mean(values: list[Any]) -> Any:
        total = values[0]
        for value in values[1:]:
            total = total + value
        return total * share

    return Image(
        rgb=[mean([p.rgb[c] for p in passes]) for c in range(3)],
        alpha=mean([p.alpha for p in passes]),
        depth=middle.depth,
        instance=middle.instance,
        share=middle.share,
    )


def _walk_in_tile_order(
    lists: TileLists,
    start: Any,
    stop: Any,
    us: list[Any],
    vs: list[Any],
    far: list[Any],
    view: View,
    cut: Any,
    end: Any,
) -> list[Pixel]:
    """Blend in the order of the tile's list: by depth of the Gaussians' centres."""
    near = view.near_plane
    shared_column = not view.distortion

    def alive(pixels: list[Pixel]) -> Any:
        brightest = pixels[0][T]
        for pixel in pixels[1:]:
            brightest = dr.maximum(brightest, pixel[T])
        return brightest > end

    def body(i: Any, pixels: list[Pixel]) -> tuple[Any, list[Pixel]]:
        record = dr.gather(
            mi.ArrayXf, lists.records, dr.gather(mi.UInt32, lists.entries, i), shape=(RECORD, dr.width(i))
        )
        blended = []
        responses = _respond(record, lists, us, vs, shared_column)
        for pixel, (log_alpha, z), z_far in zip(pixels, responses, far, strict=True):
            hit = (log_alpha > cut) & (z > near) & (z < z_far) & (pixel[T] > end)
            weight = dr.select(hit, pixel[T] * dr.exp2(log_alpha), 0.0)
            blended.append(_blend(pixel, weight, pixel[T] - weight, [record[6], record[7], record[8]], z, record[15]))
        return i + 1, blended

    _, pixels = dr.while_loop(
        (start, [_new_pixel() for _ in us]), lambda i, pixels: (i < stop) & alive(pixels), body, label="march"
    )
    return pixels


def _walk_in_ray_order(
    lists: TileLists,
    start: Any,
    stop: Any,
    us: list[Any],
    vs: list[Any],
    far: list[Any],
    view: View,
    cut: Any,
    end: Any,
) -> list[Pixel]:
    """Blend in the exact order of the peaks along each ray.

    Every walk over the list collects the next :data:`SORT_SLOTS` peaks behind the last one blended, so any number of
    Gaussians in any order comes out right; equal depths keep the list's order.
    """
    near, shared_column = view.near_plane, not view.distortion
    width = dr.width(start)

    def fetch(number: Any, active: Any) -> Any:
        return dr.gather(mi.ArrayXf, lists.records, number, active, shape=(RECORD, width))

    def collect(last_z: Any, last_i: Any, limit: Any) -> tuple[list[Any], list[Any]]:
        def body(i: Any, zs: list[Any], entries: list[Any]) -> tuple[Any, list[Any], list[Any]]:
            ((log_alpha, z),) = _respond(
                fetch(dr.gather(mi.UInt32, lists.entries, i), True), lists, us, vs, shared_column
            )
            behind = (z > last_z) | ((z == last_z) & (i > last_i))
            hit = (log_alpha > cut) & (z > near) & (z < far[0]) & behind
            moving_z, moving_i = dr.select(hit, z, dr.inf), mi.UInt32(i)
            sorted_z, sorted_i = [], []
            for slot_z, slot_i in zip(zs, entries, strict=True):
                first = moving_z < slot_z
                sorted_z.append(dr.minimum(moving_z, slot_z))
                sorted_i.append(dr.select(first, moving_i, slot_i))
                moving_z, moving_i = dr.maximum(moving_z, slot_z), dr.select(first, slot_i, moving_i)
            return i + 1, sorted_z, sorted_i

        empty = [mi.Float(dr.inf) for _ in range(SORT_SLOTS)], [mi.UInt32(0) for _ in range(SORT_SLOTS)]
        _, zs, entries = dr.while_loop((mi.UInt32(start), *empty), lambda i, *_: i < limit, body, label="collect")
        return zs, entries

    def body(pixel: Pixel, last_z: Any, last_i: Any, active: Any) -> tuple[Pixel, Any, Any, Any]:
        zs, entries = collect(last_z, last_i, dr.select(active, stop, start))
        for z, i in zip(zs, entries, strict=True):
            found = active & (z < dr.inf) & (pixel[T] > end)
            record = fetch(dr.gather(mi.UInt32, lists.entries, i, found), found)
            ((log_alpha, _),) = _respond(record, lists, us, vs, shared_column)
            weight = dr.select(found, pixel[T] * dr.exp2(log_alpha), 0.0)
            pixel = _blend(pixel, weight, pixel[T] - weight, [record[6], record[7], record[8]], z, record[15])
        active = active & (zs[-1] < dr.inf) & (pixel[T] > end)
        return pixel, zs[-1], entries[-1], active

    state = _new_pixel(), mi.Float(-dr.inf), mi.UInt32(0), start < stop
    pixel, *_ = dr.while_loop(state, lambda pixel, z, i, active: active, body, label="march by ray")
    return [pixel]


def _collect(pixels: list[Pixel], rays: list[Any], inside: list[Any], count: int) -> Image:
    """Scatter the lanes' pixels to row-major arrays."""

    def image(dtype: Any, values: list[Any]) -> Any:
        target = dr.empty(dtype, count)
        for value, ray, mask in zip(values, rays, inside, strict=True):
            dr.scatter(target, dtype(value), ray, mask, mode=dr.ReduceMode.Permute)
        return target

    def winner(pixel: Pixel) -> tuple[Any, Any]:
        second = pixel[W_2] > pixel[W_1]
        weight = dr.select(second, pixel[W_2], pixel[W_1])
        environment = pixel[W_ENV] >= weight
        number = dr.select(second, pixel[ID_2], pixel[ID_1])
        return dr.select(environment, 0.0, number), dr.select(environment, pixel[W_ENV], weight)

    alphas = [1.0 - p[T] for p in pixels]
    means = [dr.select(a > 0, p[SUM_Z] / a, 0.0) for p, a in zip(pixels, alphas, strict=True)]
    winners = [winner(p) for p in pixels]
    return Image(
        rgb=[image(mi.Float, [p[c] for p in pixels]) for c in (RED, GREEN, BLUE)],
        alpha=image(mi.Float, alphas),
        depth=image(mi.Float, [dr.select(p[T] < 0.5, p[HALF_Z], m) for p, m in zip(pixels, means, strict=True)]),
        instance=image(mi.UInt32, [w[0] for w in winners]),
        share=image(mi.Float, [w[1] for w in winners]),
    )
