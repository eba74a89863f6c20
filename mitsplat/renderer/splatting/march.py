"""Ray march: rays of all pixels traverse the lists of their tiles (see module `walk`) and form an image.

Blending order and colour error. Suppose that Gaussians were blended in the order of their peaks, with weights w_i and
colours c_i. One more Gaussian with opacity a and colour c follows, whose peak lies in front of some of them, the set B.
In its correct place it takes the share a of the light of B and is attenuated only by the Gaussians in front of B.
Blended last, it is attenuated by B as well:

    in its place   sum_front w_i c_i + a (T + W) c + (1 - a) C
    at the end     sum_front w_i c_i + C + a T c

W and C are the sums of w_i and of w_i c_i over B, and T is the transmittance behind all. The difference is

    a (W c - C),

which for one neighbour is the well-known a_i a_j T (c_j - c_i). The sum over all Gaussians is the exact error of a ray,
and the sum of absolute values is a bound of it. Finding B exactly would need a search through all blended Gaussians. A
late Gaussian mostly lies just in front of the deepest ones. W and C are therefore estimated from decaying sums of w_i,
w_i c_i and w_i z_i: a new deepest Gaussian of weight w scales them by S / (S + 2 w), where S is the sum of weights. The
share of these sums behind the late peak counts. It assumes that they extend evenly from the deepest peak to the same
distance in front of their mean. The state of a ray grows by seven numbers for this. A Gaussian so late that its ray has
already ended is not detected.

`fast` adds the difference to the colour instead (`correct_late_gaussians`), so that a late Gaussian takes light from
those it occludes. Its weight and theirs change by the same amount, so that a uniform colour stays uniform. Here the
sums decay faster, by S / (S + 8 w).

Most tiles need only the order per tile. One walk in that order, with several rays per lane, finds the others: it ends
where the estimate exceeds the tolerance. Such tiles are walked with a window. Tiles whose estimate still exceeds the
tolerance are walked in the order of each ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial, reduce
from operator import or_
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.quality import Order, Quality
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_PIXELS, CameraView
from mitsplat.renderer.splatting.instance_votes import add_to_tally, new_tally, resolve_instances, winner_of_tally
from mitsplat.renderer.splatting.pairs import CrowdedError
from mitsplat.renderer.splatting.projection import CloudSet, Placement
from mitsplat.renderer.splatting.records import GaussianRecord
from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians, select_tiles, sort_by_ray
from mitsplat.renderer.splatting.walk import (
    TRANSMITTANCE,
    FieldsOnAccess,
    Lanes,
    Pixel,
    Rays,
    max_of,
    rows_together,
    walk,
)


@dataclass(eq=False)
class Image:
    """Rendered image of one view, flat and row-major over height x width pixels.

    Attributes:
        rgb: Display-encoded colour, not divided by alpha, three arrays.
        alpha: Opacity.
        depth: Depth along z [m] at which the ray's transmittance falls below one half. If it stays above, the mean
            depth of the Gaussians; 0 without Gaussians.
        instance: Id with the largest share of the ray. Id 0 is the environment, which also gets the remaining
            transmittance.
        centre_alpha: Opacity of the ray through the pixel's centre, to which depth and instance belong.
        error: Estimated error of ``rgb`` due to the blending order, see the module; None without an estimate.
    """

    rgb: list[mi.Float]
    alpha: mi.Float
    depth: mi.Float
    instance: mi.UInt32
    centre_alpha: mi.Float
    error: mi.Float | None

    @classmethod
    def empty(cls, count: int) -> Image:
        """Return an image of rays without Gaussians."""
        nothing = dr.zeros(mi.Float, count)
        return cls([nothing] * 3, nothing, nothing, dr.zeros(mi.UInt32, count), nothing, nothing)

    @classmethod
    def joined(cls, parts: Sequence[Image]) -> Image:
        """Concatenate the rows of images."""
        rgb = [dr.concat([part.rgb[c] for part in parts]) for c in range(3)]
        rest = [dr.concat([getattr(p, name) for p in parts]) for name in ("alpha", "depth", "instance", "centre_alpha")]
        known = all(part.error is not None for part in parts)
        rest.append(dr.concat([part.error for part in parts]) if known else None)
        return cls(rgb, *rest)

    def with_tiles(self, part: Image, lists: TileLists, view: CameraView) -> Image:
        """Return this image with the tiles of ``lists`` replaced by those of ``part``."""
        changed = dr.zeros(mi.Bool, view.width * view.height)
        lanes = Lanes(lists, view)
        for pixel, inside in zip(lanes.pixel, lanes.inside, strict=True):
            dr.scatter(changed, mi.Bool(True), pixel, inside)
        dr.eval(changed, part)
        values: dict[str, Any] = {
            f.name: _select(changed, getattr(part, f.name), getattr(self, f.name)) for f in fields(Image)
        }
        return Image(**values)


def _select(
    changed: mi.Bool, new: list[mi.Float] | dr.ArrayBase | None, old: list[mi.Float] | dr.ArrayBase | None
) -> list[mi.Float] | dr.ArrayBase | None:
    if new is None or old is None:
        return None
    if isinstance(new, list):
        return [dr.select(changed, a, b) for a, b in zip(new, old, strict=True)]
    return dr.select(changed, new, old)


def largest_and_mean(error: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return maximum and mean of the pixels' errors, each clamped to 1.

    The mean uses integers, whose sum does not depend on the order.
    """
    unit = 1 << 24
    total = dr.sum(mi.UInt64(dr.minimum(error, 1.0) * unit))
    return dr.minimum(dr.max(error), 1.0), mi.Float(total) / (unit * dr.width(error))


RED, GREEN, BLUE, SUM_Z, HALF_Z, TALLY = range(1, 7)
"""Indices of a ray's state after the transmittance: red, green, blue, sum of weighted depths, depth at half
transmittance, and first entry of the instance tally (if there are several instances). The state of late peaks comes
last, see :data:`_EXTRA_STATE`.
"""

OutOfOrder = Literal["ignored", "estimated", "corrected"]
"""Treatment of out-of-order Gaussians: ignored, blended with an error estimate, or with a colour correction."""

_EXTRA_STATE: dict[OutOfOrder, int] = {"ignored": 0, "estimated": 7, "corrected": 6}
"""Numbers in a ray's state for late peaks."""

ERROR, DEEPEST, SUMS = -7, -6, slice(-5, None)
"""Indices of the state of late peaks: error estimate; deepest peak; and decaying sums of weights and of weights times
depth, red, green, blue.
"""

_DECAY = 8
"""Decay rate of the sums where late peaks are corrected, in weights of a new deepest Gaussian. From 2 on, larger values
are better for solid walls and worse for solid objects: between 2 and 16 the PSNR of captures changes by up to 1.4 dB.
"""


def _fresh(several: bool, late: OutOfOrder) -> Pixel:
    """Return the initial state of a ray."""
    nothing = [mi.Float(0.0) for _ in range(TALLY - 1)]
    tally, extra = new_tally() if several else [], [mi.Float(0.0) for _ in range(_EXTRA_STATE[late])]
    return [mi.Float(1.0), *nothing, *tally, *extra]


def _blend(
    pixel: Pixel, alpha: mi.Float, record: GaussianRecord | FieldsOnAccess, z: mi.Float, several: bool, late: OutOfOrder
) -> Pixel:
    """Return the state of a ray after one more Gaussian."""
    weight = pixel[TRANSMITTANCE] * alpha
    transmittance = pixel[TRANSMITTANCE] - weight
    colour = record.colour
    sums = [dr.fma(weight, c, sum_c) for c, sum_c in zip(colour, pixel[RED : BLUE + 1], strict=True)]
    extra: list[mi.Float] = []
    if late == "estimated":
        extra = _add_to_error(pixel, alpha, weight, colour, z)
    elif late == "corrected":
        change, extra = _corrected(pixel, alpha, weight, colour, z)
        sums = [a + b for a, b in zip(sums, change, strict=True)]
    return [
        transmittance,
        *sums,
        dr.fma(weight, z, pixel[SUM_Z]),
        dr.select((pixel[TRANSMITTANCE] >= 0.5) & (transmittance < 0.5), z, pixel[HALF_Z]),
        *(add_to_tally(pixel[TALLY : len(pixel) - len(extra)], weight, record.instance) if several else []),
        *extra,
    ]


def _shares(pixel: Pixel, weight: mi.Float, late: mi.Bool, z: mi.Float, decay: int) -> tuple[mi.Float, mi.Float]:
    """Return the share of the sums behind a late peak, and the share kept after a new deepest peak.

    See the module. Both cases use the same division.
    """
    total, moment, *_ = pixel[SUMS]
    gap, reach = (pixel[DEEPEST] - z) * total, 2 * dr.fma(pixel[DEEPEST], total, -moment)
    ratio = dr.select(late, gap, total) / dr.select(late, reach, dr.fma(decay, weight, total))
    return dr.select(gap < reach, ratio, 1.0), ratio


def _add_to_error(
    pixel: Pixel, alpha: mi.Float, weight: mi.Float, colour: list[mi.Float], z: mi.Float
) -> list[mi.Float]:
    """Return the state of late peaks with the error estimate after one more Gaussian, see the module."""
    total, _, *colours = pixel[SUMS]
    deepest, met = pixel[DEEPEST], weight > 0
    late = met & (z < deepest)
    change = mi.Float(0.0)
    for c, sum_c in zip(colour, colours, strict=True):
        change = dr.maximum(change, dr.abs(dr.fma(total, c, -sum_c)))
    behind, kept = _shares(pixel, weight, late, z, 2)
    keep = dr.select(met & ~late, kept, 1.0)
    return [
        dr.select(late, dr.fma(alpha * behind, change, pixel[ERROR]), pixel[ERROR]),
        dr.select(met, dr.maximum(z, deepest), deepest),
        *(dr.fma(keep, old, weight * f) for old, f in zip(pixel[SUMS], [1.0, z, *colour], strict=True)),
    ]


def _corrected(
    pixel: Pixel, alpha: mi.Float, weight: mi.Float, colour: list[mi.Float], z: mi.Float
) -> tuple[list[mi.Float], list[mi.Float]]:
    """Return the colour correction for a late Gaussian, and the state of late peaks after it."""
    total, _, *colours = pixel[SUMS]
    deepest, met = pixel[DEEPEST], weight > 0
    late = met & (z < deepest)
    behind, kept = _shares(pixel, weight, late, z, _DECAY)
    taken = dr.select(late, alpha * behind, 0.0)
    change = [taken * dr.fma(total, c, -sum_c) for c, sum_c in zip(colour, colours, strict=True)]
    keep = dr.select(met & ~late, kept, 1.0 - taken)
    own = dr.fma(taken, total, weight)
    return change, [
        dr.select(met, dr.maximum(z, deepest), deepest),
        *(dr.fma(keep, old, own * f) for old, f in zip(pixel[SUMS], [1.0, z, *colour], strict=True)),
    ]


def trace(
    clouds: CloudSet,
    placements: Sequence[Placement],
    view: CameraView,
    quality: Quality,
    *,
    z_max: mi.Float | None = None,
) -> Image:
    """Render all placements; an image with too many pairs for the memory is rendered in parts.

    Args:
        clouds: Gaussians on the device.
        placements: Poses of the clouds.
        view: The camera, from :meth:`View.sampled`.
        quality: Order, cut-offs and kernel.
        z_max: Depth along z [m] of the nearest visible surface per pixel; Gaussians behind it are not visible.

    Raises:
        CrowdedError: If one row of tiles alone has too many pairs.
    """
    try:
        return march(bin_gaussians(clouds, placements, view, quality), view, quality, z_max=z_max)
    except CrowdedError:
        if view.tiles_y == 1:
            raise
    middle = view.tiles_y // 2 * TILE_HEIGHT
    parts = []
    for start, stop in ((0, middle), (middle, view.height)):
        pixels = dr.arange(mi.UInt32, (stop - start) * view.width) + start * view.width
        part_z = None if z_max is None else dr.gather(mi.Float, z_max, pixels)
        parts.append(trace(clouds, placements, view.rows(start, stop), quality, z_max=part_z))
        dr.eval(parts[-1])
    return Image.joined(parts)


def march(
    lists: TileLists,
    view: CameraView,
    quality: Quality,
    *,
    z_max: mi.Float | None = None,
    slopes: tuple[list[mi.Float], list[mi.Float]] | None = None,
) -> Image:
    """Blend every ray of a view front to back, and average the colours of each pixel.

    Label data (depth, instance, centre opacity) come from a ray through the pixel's centre, whatever the number of
    samples.

    Args:
        lists: Depth-sorted Gaussians per tile.
        view: Camera.
        quality: Order, cut-off and early termination.
        z_max: Depth along z [m] of the nearest visible surface per pixel; Gaussians behind it are not visible.
        slopes: Slopes of the rays if already known; for one sample per pixel.
    """
    if quality.order != "window" or not lists.pairs:
        return _march(lists, view, quality, quality.order, z_max, slopes)[0]
    image, places = _march(lists, view, quality, "tile", z_max, estimated=True)
    if dr.width(places) == 0:
        return image
    some = select_tiles(lists, places)
    part, places = _march(some, view, quality, "window", z_max, estimated=True)
    if dr.width(places):
        again = sort_by_ray(some, places, view)
        part = part.with_tiles(march(again, view, replace(quality, tolerance=0.0), z_max=z_max), again, view)
    return image.with_tiles(part, some, view)


def _march(
    lists: TileLists,
    view: CameraView,
    quality: Quality,
    order: Order,
    z_max: mi.Float | None,
    slopes: tuple[list[mi.Float], list[mi.Float]] | None = None,
    estimated: bool = False,
) -> tuple[Image, mi.UInt32 | None]:
    """Return the image of one march, and the places of tiles whose estimated error exceeds the tolerance.

    The places are None unless ``estimated`` is True.
    """
    lanes = Lanes(lists, view, len(slopes[0]) if slopes else rows_together(order))
    far = [
        dr.gather(mi.Float, z_max, p, m) if z_max is not None else mi.Float(dr.inf)
        for p, m in zip(lanes.pixel, lanes.inside, strict=True)
    ]
    if order == "ray":
        dr.eval(lists.nearest)
    several = lists.instance is None
    tolerance = dr.opaque(mi.Float, quality.tolerance) if estimated else None
    stops_early = estimated and order == "tile"
    late: OutOfOrder = "estimated" if estimated else _out_of_order(quality)

    def within_tolerance(pixels: list[Pixel]) -> mi.Bool:
        """Return True for lanes in which no ray's error exceeds the tolerance."""
        return ~_exceeds_tolerance([pixel[ERROR] for pixel in pixels], lanes.inside, tolerance)

    def pixels(dx: float, dy: float, labelled: bool) -> tuple[list[Pixel], list[mi.Float]]:
        """Return the states of the rays at an offset in the pixels, and their error estimates."""
        state: dict[str, Any] = {"several": labelled and several, "late": late}
        where = slopes or lanes.slopes(dr.opaque(mi.Float, dx), dr.opaque(mi.Float, dy))
        rays = Rays.through(lists, view, quality, where, far, lanes.start, lanes.stop)
        found = walk(
            rays, order, partial(_fresh, **state), partial(_blend, **state), within_tolerance if stops_early else None
        )
        return _without_extra(found, late), [pixel[ERROR] for pixel in found] if estimated else []

    found, errors = pixels(0.5, 0.5, labelled=True)
    image, uncertain = _collect(found, lanes, lists.instance, quality)
    if stops_early and several:
        uncertain &= lanes.image(mi.Bool, [~_exceeds_tolerance(errors, lanes.inside, tolerance)] * lanes.rows)
    if quality.order != "tile":
        image.error = lanes.image(mi.Float, errors or [mi.Float(0.0) for _ in found])
    if estimated:
        dr.eval(image, uncertain, errors)  # in one kernel
    # On a CPU, reading one bit is cheap and mostly saves the launch; on a GPU, it would cause a synchronisation.
    if several and (dr.backend_v(uncertain) == dr.JitBackend.CUDA or dr.any(uncertain)):
        image.instance = resolve_instances(image.instance, uncertain, lists, view, quality, order, z_max)
    n, colours = view.samples, []
    for y, x in np.ndindex(n, n) if n > 1 else ():
        if (2 * x + 1, 2 * y + 1) == (n, n):  # an odd number of samples includes the centre
            colours.append([*image.rgb, image.alpha])
        else:
            found, also = pixels((x + 0.5) / n, (y + 0.5) / n, labelled=False)
            colours.append([*_picture(found, lanes, quality)])
            errors = [dr.maximum(a, b) for a, b in zip(errors, also, strict=True)]
        dr.eval(colours[-1], errors)
    if n > 1:
        *image.rgb, image.alpha = (sum(channel[1:], channel[0]) / (n * n) for channel in zip(*colours, strict=True))
        if estimated:
            image.error = lanes.image(mi.Float, errors)
    return image, _tiles_of(_exceeds_tolerance(errors, lanes.inside, tolerance), lanes) if estimated else None


def _out_of_order(quality: Quality) -> OutOfOrder:
    """Return how late peaks are blended without an error estimate; in the order of rays no peak is late."""
    return "corrected" if quality.correct_late_gaussians and quality.order == "tile" else "ignored"


def _without_extra(pixels: list[Pixel], late: OutOfOrder) -> list[Pixel]:
    """Return the states of rays without the state of late peaks."""
    return [pixel[: len(pixel) - _EXTRA_STATE[late]] for pixel in pixels]


def _exceeds_tolerance(errors: list[mi.Float], inside: list[mi.Bool], tolerance: mi.Float) -> mi.Bool:
    """Return True for lanes in which the estimate of a ray inside the image exceeds the tolerance."""
    return max_of([dr.select(m, error, 0.0) for error, m in zip(errors, inside, strict=True)]) > tolerance


def _tiles_of(flags: mi.Bool, lanes: Lanes) -> mi.UInt32:
    """Return the places of tiles that have flagged lanes."""
    dr.eval(flags)
    per_tile = TILE_PIXELS // lanes.rows
    lane = dr.arange(mi.UInt32, dr.width(flags) // per_tile) * per_tile
    return dr.compress(reduce(or_, [dr.gather(mi.Bool, flags, lane + k) for k in range(per_tile)]))


def march_tiles(lists: TileLists, view: CameraView, quality: Quality, z_max: mi.Float | None = None) -> Image:
    """Render the pixels of some tiles, tile after tile, with one ray through each pixel's centre.

    Arguments are those of :func:`march`. Nothing is repaired: the order is per tile or per ray.
    """
    lanes = Lanes(lists, view, rows_together(quality.order), by_tile=True)
    places = zip(lanes.pixel, lanes.inside, strict=True)
    far = [mi.Float(dr.inf) if z_max is None else dr.gather(mi.Float, z_max, pixel, inside) for pixel, inside in places]
    if quality.order == "ray":
        dr.eval(lists.nearest)
    late = _out_of_order(quality)
    state: dict[str, Any] = {"several": lists.instance is None, "late": late}
    where = lanes.slopes(dr.opaque(mi.Float, 0.5), dr.opaque(mi.Float, 0.5))
    rays = Rays.through(lists, view, quality, where, far, lanes.start, lanes.stop)
    found = walk(rays, quality.order, partial(_fresh, **state), partial(_blend, **state))
    image, _ = _collect(_without_extra(found, late), lanes, lists.instance, quality)
    dr.eval(image)
    return image


def _picture(pixels: list[Pixel], lanes: Lanes, quality: Quality) -> list[mi.Float]:
    """Return red, green, blue and opacity of the lanes' pixels as row-major arrays."""
    shown = [[*pixel[RED : BLUE + 1], 1.0 - pixel[TRANSMITTANCE]] for pixel in pixels]
    if quality.normalise_ended_rays:
        end = dr.opaque(mi.Float, quality.transmittance_min)
        whole = [dr.select(pixel[TRANSMITTANCE] <= end, dr.rcp(1.0 - pixel[TRANSMITTANCE]), 1.0) for pixel in pixels]
        shown = [[value * scale for value in values] for values, scale in zip(shown, whole, strict=True)]
    return [lanes.image(mi.Float, list(channel)) for channel in zip(*shown, strict=True)]


def _collect(pixels: list[Pixel], lanes: Lanes, only: int | None, quality: Quality) -> tuple[Image, mi.Bool | None]:
    """Return the lanes' pixels as row-major arrays, and a flag (Bool) where an instance is uncertain.

    ``only`` is the instance id of all Gaussians, or None if there are several.
    """
    *rgb, alpha = _picture(pixels, lanes, quality)
    depths = []
    for pixel in pixels:
        opacity = 1.0 - pixel[TRANSMITTANCE]
        mean = dr.select(opacity > 0, pixel[SUM_Z] / opacity, 0.0)
        depths.append(dr.select(pixel[TRANSMITTANCE] < 0.5, pixel[HALF_Z], mean))
    uncertain = None
    if only is None:
        winners = [winner_of_tally(pixel[TALLY:], pixel[TRANSMITTANCE]) for pixel in pixels]
        numbers = [number for number, _ in winners]
        uncertain = lanes.image(mi.Bool, [doubt for _, doubt in winners])
    else:
        everything = dr.opaque(mi.Float, only)
        numbers = [dr.select(1.0 - pixel[TRANSMITTANCE] > pixel[TRANSMITTANCE], everything, 0.0) for pixel in pixels]
    depth, instance = lanes.image(mi.Float, depths), lanes.image(mi.UInt32, numbers)
    return Image(rgb, alpha, depth, instance, alpha, None), uncertain
