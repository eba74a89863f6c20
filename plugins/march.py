"""The march: every ray walks its tile's list front to back and blends what it meets.

One lane carries a column of one tile's pixels, because fetching a record costs several times more than evaluating it
for a packet of rays: the more pixels share a fetch, the better, until registers run out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.plugins.gaussian import RECORD
from mitsplat.plugins.project import CloudSet, Placement
from mitsplat.plugins.rays import TILE, View
from mitsplat.plugins.tiles import CrowdedError, TileLists, bin_gaussians
from mitsplat.quality import KERNELS, Quality

SORT_SLOTS = 8
"""Gaussians that the per-ray order collects in one walk over a part of a list."""


@dataclass(eq=False)
class Image:
    """What the rays of one view saw, flat and row-major over height x width pixels.

    Attributes:
        rgb: Display-encoded colour, not divided by alpha, three arrays.
        alpha: Opacity.
        depth: Depth along z [m] at which a ray has lost half its light, or, where it keeps more, the mean depth of what
            it met; 0 where it met nothing.
        instance: Id with the largest share of the ray; 0 is the environment, which has what is left of the ray as well.
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

    @classmethod
    def joined(cls, parts: Sequence[Image]) -> Image:
        """The image whose rows are those of the parts, one after the other."""
        rgb = [dr.concat([part.rgb[c] for part in parts]) for c in range(3)]
        rest = [dr.concat([getattr(p, name) for p in parts]) for name in ("alpha", "depth", "instance", "share")]
        return cls(rgb, *rest)


Pixel = list[Any]
"""State of a ray: transmittance, red, green, blue, sum of weighted depths, depth at half transmittance, weight of the
environment, id and weight of two instances. Two are enough to find the largest of the environment and any two objects;
a third one evicts the lighter if it weighs more (Misra and Gries' frequent-elements summary)."""

T, RED, GREEN, BLUE, SUM_Z, HALF_Z, W_ENV, ID_1, W_1, ID_2, W_2 = range(11)


def _new_pixel(several: bool) -> Pixel:
    """A ray that has met nothing yet; weights of instances are kept only where there are ``several``."""
    return [mi.Float(1.0), *(mi.Float(0.0) for _ in range(10 if several else HALF_Z))]


def _blend(pixel: Pixel, weight: Any, transmittance: Any, colour: list[Any], z: Any, instance: Any) -> Pixel:
    """The pixel after one more Gaussian in front-to-back order; a weight of 0 changes nothing."""
    half = dr.select((pixel[T] >= 0.5) & (transmittance < 0.5), z, pixel[HALF_Z])
    seen = [
        transmittance,
        dr.fma(weight, colour[0], pixel[RED]),
        dr.fma(weight, colour[1], pixel[GREEN]),
        dr.fma(weight, colour[2], pixel[BLUE]),
        dr.fma(weight, z, pixel[SUM_Z]),
        half,
    ]
    if len(pixel) == len(seen):
        return seen
    first, second = instance == pixel[ID_1], instance == pixel[ID_2]
    environment = instance == 0
    other = ~(first | second | environment)
    lighter = pixel[W_2] < pixel[W_1]
    into_2 = other & lighter & (weight > pixel[W_2])
    into_1 = other & ~lighter & (weight > pixel[W_1])
    first &= ~environment
    second &= ~environment
    return [
        *seen,
        dr.select(environment, pixel[W_ENV] + weight, pixel[W_ENV]),
        dr.select(into_1, instance, pixel[ID_1]),
        dr.select(into_1, weight, dr.select(first, pixel[W_1] + weight, pixel[W_1])),
        dr.select(into_2, instance, pixel[ID_2]),
        dr.select(into_2, weight, dr.select(second, pixel[W_2] + weight, pixel[W_2])),
    ]


def respond_along(
    record: Any, lists: TileLists, us: list[Any], vs: list[Any], shared_column: bool, cap: Any | None
) -> list[tuple[Any, Any]]:
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
    # Rounding can lift the response of a needle over its peak, by any factor.
    most = opacity if cap is None else dr.minimum(opacity, cap)
    log_alphas = [dr.select(log_alpha > most, most, log_alpha) for log_alpha in result[0::2]]
    return list(zip(log_alphas, result[1::2], strict=True))


class Lanes:
    """Which pixels each lane carries: one column of a tile.

    Attributes:
        pixel: Number of each of the lane's pixels, row-major.
        inside: Whether it is in the image.
        start, stop: Range of the tile's list.
    """

    def __init__(self, lists: TileLists, view: View) -> None:
        count = view.tiles_x * view.tiles_y if lists.tiles is None else dr.width(lists.tiles)
        lane = dr.arange(mi.UInt32, count * TILE)
        own = lane // TILE
        tile = own if lists.tiles is None else dr.gather(mi.UInt32, lists.tiles, own)
        tile_y = tile // view.tiles_x
        self.view = view
        self.x = (tile - tile_y * view.tiles_x) * TILE + lane % TILE
        self.y = tile_y * TILE
        self.pixel = [(self.y + k) * view.width + self.x for k in range(TILE)]
        self.inside = [(self.x < view.width) & (self.y + k < view.height) for k in range(TILE)]
        self.start = dr.gather(mi.UInt32, lists.start, own)
        self.stop = dr.select(self.inside[0], dr.gather(mi.UInt32, lists.stop, own), self.start)

    def centre_slopes(self) -> tuple[list[Any], list[Any]]:
        """Slopes u and v of the rays through the pixels' centres; those of a distorted view are in memory."""
        if not self.view.distortion:
            return self.slopes(0.5, 0.5)
        number = dr.arange(mi.UInt32, self.view.width * self.view.height)
        row = number // self.view.width
        u, v = self.view.slopes(mi.Float(number - row * self.view.width) + 0.5, mi.Float(row) + 0.5)
        dr.eval(u, v)
        places = list(zip(self.pixel, self.inside, strict=True))
        return [dr.gather(mi.Float, u, p, m) for p, m in places], [dr.gather(mi.Float, v, p, m) for p, m in places]

    def slopes(self, dx: Any, dy: Any) -> tuple[list[Any], list[Any]]:
        """Slopes u and v of the rays at (dx, dy) in the lane's pixels."""
        pairs = [self.view.slopes(mi.Float(self.x) + dx, mi.Float(self.y + k) + dy) for k in range(TILE)]
        return [u for u, _ in pairs], [v for _, v in pairs]


def trace(
    clouds: CloudSet, placements: Sequence[Placement], view: View, quality: Quality, *, z_max: Any | None = None
) -> Image:
    """Image of all placements; one that is too crowded for the memory is made in parts.

    Args:
        clouds: Gaussians on the device.
        placements: Where they are.
        view: The camera, from :meth:`View.sampled`.
        quality: Order, cut-offs and kernel.
        z_max: Depth along z [m] of the nearest visible surface per pixel, beyond which nothing is seen.

    Raises:
        CrowdedError: If even one row of tiles is too crowded.
    """
    try:
        return march(bin_gaussians(clouds, placements, view, quality), view, quality, z_max=z_max)
    except CrowdedError:
        if view.tiles_y == 1:
            raise
    middle = view.tiles_y // 2 * TILE
    parts = []
    for start, stop in ((0, middle), (middle, view.height)):
        pixels = dr.arange(mi.UInt32, (stop - start) * view.width) + start * view.width
        part_z = None if z_max is None else dr.gather(mi.Float, z_max, pixels)
        parts.append(trace(clouds, placements, view.rows(start, stop), quality, z_max=part_z))
        dr.eval(parts[-1])
    return Image.joined(parts)


def march(
    lists: TileLists,
    view: View,
    quality: Quality,
    *,
    z_max: Any | None = None,
    slopes: tuple[list[Any], list[Any]] | None = None,
) -> Image:
    """Blend every ray of a view front to back, and average the rays of each pixel.

    Args:
        lists: Depth-sorted Gaussians per tile.
        view: Camera.
        quality: Order, cut-off and early end.
        z_max: Depth along z [m] of the nearest visible surface per pixel, beyond which nothing is seen.
        slopes: Those of the rays, where they are known already; for one sample per pixel.
    """
    n = view.samples
    lanes = Lanes(lists, view)
    far = [
        dr.gather(mi.Float, z_max, p, m) if z_max is not None else mi.Float(dr.inf)
        for p, m in zip(lanes.pixel, lanes.inside, strict=True)
    ]
    walk = _walk_in_tile_order if quality.order == "tile" else _walk_in_ray_order
    if quality.order == "ray":
        dr.eval(lists.nearest)
    cut = dr.log2(dr.opaque(mi.Float, quality.alpha_min))
    end = dr.opaque(mi.Float, quality.transmittance_min)
    alpha_max = KERNELS[quality.kernel].alpha_max
    cap = dr.log2(dr.opaque(mi.Float, alpha_max)) if alpha_max < 1 else None
    passes = []
    for i in range(n * n):
        dx, dy = dr.opaque(mi.Float, (i % n + 0.5) / n), dr.opaque(mi.Float, (i // n + 0.5) / n)
        us, vs = lanes.slopes(dx, dy) if slopes is None else slopes
        respond = partial(respond_along, lists=lists, us=us, vs=vs, shared_column=not view.distortion, cap=cap)
        pixels = walk(lists, lanes.start, lanes.stop, respond, far, view.near_plane, cut, end)
        passes.append(_collect(pixels, lanes, lists.instance))
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
    respond: Callable[[Any], list[tuple[Any, Any]]],
    far: list[Any],
    near: Any,
    cut: Any,
    end: Any,
) -> list[Pixel]:
    """Blend in the order of the tile's list: that of the peaks along one of its rays."""

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
        responses = respond(record)
        for pixel, (log_alpha, z), z_far in zip(pixels, responses, far, strict=True):
            hit = (log_alpha > cut) & (z > near) & (z < z_far) & (pixel[T] > end)
            weight = dr.select(hit, pixel[T] * dr.exp2(log_alpha), 0.0)
            z = dr.select(hit, z, 0.0)
            blended.append(_blend(pixel, weight, pixel[T] - weight, [record[6], record[7], record[8]], z, record[15]))
        return i + 1, blended

    _, pixels = dr.while_loop(
        (start, [_new_pixel(lists.instance is None) for _ in far]),
        lambda i, pixels: (i < stop) & alive(pixels),
        body,
        label="march",
    )
    return pixels


def _walk_in_ray_order(
    lists: TileLists,
    start: Any,
    stop: Any,
    respond: Callable[[Any], list[tuple[Any, Any]]],
    far: list[Any],
    near: Any,
    cut: Any,
    end: Any,
) -> list[Pixel]:
    """Blend in the exact order of the peaks along each ray.

    Every walk collects the next :data:`SORT_SLOTS` peaks behind the last one blended. It ends where no later entry can
    have a peak in front of those, and the next one begins at the first entry that found no slot: a walk sees a short
    part of the list, and any number of Gaussians in any order comes out right. Equal depths keep the list's order.
    """
    width = dr.width(start)
    none = 0xFFFFFFFF

    def insert(slots: _Slots, left: Any, z: Any, alpha: Any, i: Any) -> tuple[_Slots, Any]:
        """Slots in order of depth with one more peak, and the first entry that was left without."""
        result: _Slots = []
        behind = mi.Bool(False)
        for slot_z, slot_alpha, slot_i in slots:
            # Whatever lies behind the new peak moves on by one, also among equals: they keep their order.
            behind |= z < slot_z
            result.append((dr.minimum(z, slot_z), dr.select(behind, alpha, slot_alpha), dr.select(behind, i, slot_i)))
            z, alpha, i = dr.maximum(z, slot_z), dr.select(behind, slot_alpha, alpha), dr.select(behind, slot_i, i)
        return result, dr.select(z < dr.inf, dr.minimum(left, i), left)

    def collect(begin: Any, limit: Any, seen: Any, last: list[tuple[Any, Any]]) -> tuple[Any, list[_Slots], list[Any]]:
        def unfilled(i: Any, slots: list[_Slots], left: list[Any]) -> Any:
            nearest = dr.gather(mi.Float, lists.nearest, i, i < limit)
            wanted = mi.Bool(False)
            for own in slots:
                wanted |= nearest <= own[-1][0]
            return (i < limit) & wanted

        def body(i: Any, slots: list[_Slots], left: list[Any]) -> tuple[Any, list[_Slots], list[Any]]:
            record = dr.gather(mi.ArrayXf, lists.records, dr.gather(mi.UInt32, lists.entries, i), shape=(RECORD, width))
            new_slots, new_left = [], []
            responses = respond(record)
            for (log_alpha, z), own, first_left, z_far, (last_z, last_i) in zip(
                responses, slots, left, far, last, strict=True
            ):
                # An entry that no walk has seen counts wherever it lies: rounding may put it in front of its bound.
                new = (z > last_z) | ((z == last_z) & (i > last_i)) | (i >= seen)
                hit = (log_alpha > cut) & (z > near) & (z < z_far) & new
                own, first_left = dr.if_stmt(
                    (own, first_left, z, dr.exp2(log_alpha), mi.UInt32(i)),
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
        pixels: list[Pixel], last: list[tuple[Any, Any]], begin: Any, seen: Any, active: Any
    ) -> tuple[list[Pixel], list[tuple[Any, Any]], Any, Any, Any]:
        reached, slots, left = collect(begin, dr.select(active, stop, begin), seen, last)
        blended, new_last, unfinished, next_begin = [], [], mi.Bool(False), mi.UInt32(reached)
        for pixel, own, first_left, (last_z, last_i) in zip(pixels, slots, left, last, strict=True):
            for z, alpha, i in own:
                found = active & (z < dr.inf) & (pixel[T] > end)
                number = dr.gather(mi.UInt32, lists.entries, i, found)
                record = dr.gather(mi.ArrayXf, lists.records, number, found, shape=(RECORD, width))
                weight = dr.select(found, pixel[T] * alpha, 0.0)
                z = dr.select(found, z, 0.0)  # an empty slot lies at infinity, which no weight makes 0
                pixel = _blend(pixel, weight, pixel[T] - weight, [record[6], record[7], record[8]], z, record[15])
            # A ray that has ended takes nothing more: no peak lies behind infinity.
            open_ray = pixel[T] > end
            z, _, i = own[-1]
            last_i = dr.select(z < last_z, last_i, i)
            blended.append(pixel)
            new_last.append((dr.select(open_ray, dr.maximum(z, last_z), dr.inf), last_i))
            next_begin = dr.select(open_ray, dr.minimum(next_begin, first_left), next_begin)
            unfinished |= open_ray & ((first_left != none) | (reached < stop))
        return blended, new_last, next_begin, dr.maximum(seen, reached), active & unfinished

    state = (
        [_new_pixel(lists.instance is None) for _ in far],
        [(mi.Float(-dr.inf), mi.UInt32(0)) for _ in far],
        mi.UInt32(start),
        mi.UInt32(start),
        start < stop,
    )
    pixels, *_ = dr.while_loop(state, lambda *state: state[-1], body, label="march by ray")
    return pixels


_Slots = list[tuple[Any, Any, Any]]
"""Peaks in order of depth: depth, opacity and entry."""


def _collect(pixels: list[Pixel], lanes: Lanes, only: int | None) -> Image:
    """Scatter the lanes' pixels to row-major arrays; ``only`` is the id of all Gaussians if there is but one."""
    count = lanes.view.width * lanes.view.height
    everything = None if only is None else dr.opaque(mi.Float, only)

    def image(dtype: Any, values: list[Any]) -> Any:
        target = dr.empty(dtype, count)
        for value, number, mask in zip(values, lanes.pixel, lanes.inside, strict=True):
            dr.scatter(target, dtype(value), number, mask, mode=dr.ReduceMode.Permute)
        return target

    def winner(pixel: Pixel) -> tuple[Any, Any]:
        if everything is not None:
            alpha = 1.0 - pixel[T]
            shown = (everything != 0) & (alpha > pixel[T])
            return dr.select(shown, everything, 0.0), dr.select(shown | (everything == 0), alpha, 0.0)
        second = pixel[W_2] > pixel[W_1]
        weight = dr.select(second, pixel[W_2], pixel[W_1])
        environment = pixel[W_ENV] + pixel[T] >= weight  # what is left of the ray shows what lies behind
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
