"""Ray march: rays of all pixels traverse the lists of their tiles (see module `walk`) and form an image.

Most tiles need only the order per tile. One walk in that order, with several rays per lane, finds the others: it ends
where the estimate exceeds the tolerance. Such tiles are walked with a window. Tiles whose estimate still exceeds the
tolerance are walked in the order of each ray.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import or_

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.quality import Order, Quality
from mitsplat.renderer.projection.clouds import CloudSet, Placement
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_PIXELS, CameraView
from mitsplat.renderer.splatting.blending import (
    BLUE,
    ERROR,
    HALF_Z,
    RED,
    SHARE,
    SUM_Z,
    TALLY,
    OutOfOrder,
    blend,
    blend_share,
    new_state,
    out_of_order,
    without_late_state,
)
from mitsplat.renderer.splatting.instance_votes import resolve_instances, winner_of_tally
from mitsplat.renderer.splatting.lanes import Lanes, rows_together
from mitsplat.renderer.splatting.pairs import CrowdedError
from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians, select_tiles, sort_by_ray
from mitsplat.renderer.splatting.walk import TRANSMITTANCE, Pixel, Rays, max_of, walk


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
        return Image(
            rgb=[dr.select(changed, new, old) for new, old in zip(part.rgb, self.rgb, strict=True)],
            alpha=dr.select(changed, part.alpha, self.alpha),
            depth=dr.select(changed, part.depth, self.depth),
            instance=dr.select(changed, part.instance, self.instance),
            centre_alpha=dr.select(changed, part.centre_alpha, self.centre_alpha),
            error=None if part.error is None or self.error is None else dr.select(changed, part.error, self.error),
        )


def largest_and_mean(error: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return maximum and mean of the pixels' errors, each clamped to 1.

    The mean uses integers, whose sum does not depend on the order.
    """
    unit = 1 << 24
    total = dr.sum(mi.UInt64(dr.minimum(error, 1.0) * unit))
    return dr.minimum(dr.max(error), 1.0), mi.Float(total) / (unit * dr.width(error))


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
        view: The camera, from :meth:`CameraView.sampled`.
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
    late: OutOfOrder = "estimated" if estimated else out_of_order(quality)

    def within_tolerance(pixels: list[Pixel]) -> mi.Bool:
        """Return True for lanes in which no ray's error exceeds the tolerance."""
        return ~_exceeds_tolerance([pixel[ERROR] for pixel in pixels], lanes.inside, tolerance)

    def pixels(dx: float, dy: float, labelled: bool) -> tuple[list[Pixel], list[mi.Float]]:
        """Return the states of the rays at an offset in the pixels, and their error estimates."""
        tallies = labelled and several
        where = slopes or lanes.slopes(dr.opaque(mi.Float, dx), dr.opaque(mi.Float, dy))
        rays = Rays.through(lists, view, quality, where, far, lanes.start, lanes.stop)
        found = walk(
            rays,
            order,
            partial(new_state, tallies, late),
            partial(blend, several=tallies, late=late),
            within_tolerance if stops_early else None,
        )
        return without_late_state(found, late), [pixel[ERROR] for pixel in found] if estimated else []

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
    if view.samples > 1:
        errors = _average_samples(image, errors, partial(pixels, labelled=False), lanes, view, quality)
        if estimated:
            image.error = lanes.image(mi.Float, errors)
    return image, _tiles_of(_exceeds_tolerance(errors, lanes.inside, tolerance), lanes) if estimated else None


def _average_samples(
    image: Image,
    errors: list[mi.Float],
    pixels: Callable[[float, float], tuple[list[Pixel], list[mi.Float]]],
    lanes: Lanes,
    view: CameraView,
    quality: Quality,
) -> list[mi.Float]:
    """Replace colour and opacity of an image of the pixel centres by their means over all samples of each pixel.

    ``pixels`` renders the samples at an offset in the pixels. The result is the largest error estimate of each ray.
    """
    n, colours = view.samples, []
    for y, x in np.ndindex(n, n):
        if (2 * x + 1, 2 * y + 1) == (n, n):  # an odd number of samples includes the centre
            colours.append([*image.rgb, image.alpha])
        else:
            found, also = pixels((x + 0.5) / n, (y + 0.5) / n)
            colours.append([*_picture(found, lanes, quality)])
            errors = [dr.maximum(a, b) for a, b in zip(errors, also, strict=True)]
        dr.eval(colours[-1], errors)
    *image.rgb, image.alpha = (sum(channel[1:], channel[0]) / (n * n) for channel in zip(*colours, strict=True))
    return errors


def _exceeds_tolerance(errors: list[mi.Float], inside: list[mi.Bool], tolerance: mi.Float) -> mi.Bool:
    """Return True for lanes in which the estimate of a ray inside the image exceeds the tolerance."""
    return max_of([dr.select(m, error, 0.0) for error, m in zip(errors, inside, strict=True)]) > tolerance


def _tiles_of(flags: mi.Bool, lanes: Lanes) -> mi.UInt32:
    """Return the places of tiles that have flagged lanes."""
    dr.eval(flags)
    per_tile = TILE_PIXELS // lanes.rows
    lane = dr.arange(mi.UInt32, dr.width(flags) // per_tile) * per_tile
    return dr.compress(reduce(or_, [dr.gather(mi.Bool, flags, lane + k) for k in range(per_tile)]))


def march_tiles(
    lists: TileLists, view: CameraView, quality: Quality, own: mi.Float, z_max: mi.Float | None = None
) -> tuple[Image, list[mi.Float]]:
    """Render the pixels of some tiles, tile after tile, with one ray through each pixel's centre.

    Arguments are those of :func:`march`. Nothing is repaired: the order is per tile or per ray.

    Returns:
        The image; and for one instance ``own`` per ray (its id), opacity, red, green and blue of its Gaussians, as
        parts of those of the image.
    """
    lanes = Lanes(lists, view, rows_together(quality.order), by_tile=True)
    places = list(zip(lanes.pixel, lanes.inside, strict=True))
    far = [mi.Float(dr.inf) if z_max is None else dr.gather(mi.Float, z_max, pixel, inside) for pixel, inside in places]
    if quality.order == "ray":
        dr.eval(lists.nearest)
    late = out_of_order(quality)
    several = lists.instance is None
    where = lanes.slopes(dr.opaque(mi.Float, 0.5), dr.opaque(mi.Float, 0.5))
    rays = Rays.through(lists, view, quality, where, far, lanes.start, lanes.stop)
    nothing = [mi.Float(0.0) for _ in range(SHARE - 1)]
    fresh = iter([[*new_state(several, late), dr.gather(mi.Float, own, *place), *nothing] for place in places])
    found = walk(rays, quality.order, partial(next, fresh), partial(blend_share, several=several, late=late))
    pixels = without_late_state([pixel[:-SHARE] for pixel in found], late)
    image, _ = _collect(pixels, lanes, lists.instance, quality)
    share = _images([pixel[1 - SHARE : -4] for pixel in found], pixels, lanes, quality)
    dr.eval(image, share)
    return image, share


def _picture(pixels: list[Pixel], lanes: Lanes, quality: Quality) -> list[mi.Float]:
    """Return red, green, blue and opacity of the lanes' pixels as row-major arrays."""
    return _images([[*pixel[RED : BLUE + 1], 1.0 - pixel[TRANSMITTANCE]] for pixel in pixels], pixels, lanes, quality)


def _images(shown: list[list[mi.Float]], pixels: list[Pixel], lanes: Lanes, quality: Quality) -> list[mi.Float]:
    """Return blended values of the lanes' pixels as row-major arrays; the values of ended rays are normalised."""
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
