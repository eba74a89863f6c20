"""The march: rays through all pixels walk their tiles' lists, see module `walk`, and become an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.plugins.project import CloudSet, Placement
from mitsplat.plugins.rays import TILE, View
from mitsplat.plugins.shares import add_to_tally, new_tally, settle_instances, winner_of_tally
from mitsplat.plugins.tiles import CrowdedError, TileLists, bin_gaussians
from mitsplat.plugins.walk import Lanes, Pixel, Rays, walk
from mitsplat.quality import Quality


@dataclass(eq=False)
class Image:
    """What the rays of one view saw, flat and row-major over height x width pixels.

    Attributes:
        rgb: Display-encoded colour, not divided by alpha, three arrays.
        alpha: Opacity.
        depth: Depth along z [m] at which a ray has lost half its light, or, where it keeps more, the mean depth of what
            it met; 0 where it met nothing.
        instance: Id with the largest share of the ray; 0 is the environment, which has what is left of the ray as well.
        centre_alpha: Opacity of the ray through the pixel's centre, whose depth and instance these are.
    """

    rgb: list[Any]
    alpha: Any
    depth: Any
    instance: Any
    centre_alpha: Any

    @classmethod
    def empty(cls, count: int) -> Image:
        """Rays that met nothing."""
        nothing = dr.zeros(mi.Float, count)
        return cls([nothing] * 3, nothing, nothing, dr.zeros(mi.UInt32, count), nothing)

    @classmethod
    def joined(cls, parts: Sequence[Image]) -> Image:
        """The image whose rows are those of the parts, one after the other."""
        rgb = [dr.concat([part.rgb[c] for part in parts]) for c in range(3)]
        rest = [dr.concat([getattr(p, name) for p in parts]) for name in ("alpha", "depth", "instance", "centre_alpha")]
        return cls(rgb, *rest)


T, RED, GREEN, BLUE, SUM_Z, HALF_Z, TALLY = range(7)
"""State of a ray: transmittance, red, green, blue, sum of weighted depths, depth at half transmittance, and from there
on the tally of its instances where there are several."""


def _fresh(several: bool) -> Pixel:
    """A ray that has met nothing yet."""
    return [mi.Float(1.0), *(mi.Float(0.0) for _ in range(TALLY - 1)), *(new_tally() if several else [])]


def _blend(pixel: Pixel, weight: Any, record: Any, z: Any) -> Pixel:
    """The pixel after one more Gaussian."""
    transmittance = pixel[T] - weight
    return [
        transmittance,
        dr.fma(weight, record[6], pixel[RED]),
        dr.fma(weight, record[7], pixel[GREEN]),
        dr.fma(weight, record[8], pixel[BLUE]),
        dr.fma(weight, z, pixel[SUM_Z]),
        dr.select((pixel[T] >= 0.5) & (transmittance < 0.5), z, pixel[HALF_Z]),
        *(add_to_tally(pixel[TALLY:], weight, record[15]) if len(pixel) > TALLY else []),
    ]


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
    """Blend every ray of a view front to back, and average the colours of each pixel.

    What labels are made of belongs to the pixel's centre, through which a ray goes whatever the number of samples.

    Args:
        lists: Depth-sorted Gaussians per tile.
        view: Camera.
        quality: Order, cut-off and early end.
        z_max: Depth along z [m] of the nearest visible surface per pixel, beyond which nothing is seen.
        slopes: Those of the rays, where they are known already; for one sample per pixel.
    """
    lanes = Lanes(lists, view)
    far = [
        dr.gather(mi.Float, z_max, p, m) if z_max is not None else mi.Float(dr.inf)
        for p, m in zip(lanes.pixel, lanes.inside, strict=True)
    ]
    if quality.order == "ray":
        dr.eval(lists.nearest)
    several = lists.instance is None

    def pixels(dx: float, dy: float, labelled: bool) -> list[Pixel]:
        where = slopes or lanes.slopes(dr.opaque(mi.Float, dx), dr.opaque(mi.Float, dy))
        rays = Rays.through(lists, view, quality, where, far, lanes.start, lanes.stop)
        return walk(rays, quality.order, lambda: _fresh(labelled and several), _blend)

    image, unsure = _collect(pixels(0.5, 0.5, labelled=True), lanes, lists.instance)
    # One bit is soon read on a CPU, and mostly saves the launch; a GPU would have to be waited for.
    if several and (dr.backend_v(unsure) == dr.JitBackend.CUDA or dr.any(unsure)):
        image.instance = settle_instances(image.instance, unsure, lists, view, quality, z_max)
    if view.samples == 1:
        return image
    n, colours = view.samples, []
    for y, x in np.ndindex(n, n):
        if (2 * x + 1, 2 * y + 1) == (n, n):  # the centre is one of an odd number of samples
            colours.append([*image.rgb, image.alpha])
        else:
            found = pixels((x + 0.5) / n, (y + 0.5) / n, labelled=False)
            colours.append([*_picture(found, lanes)])
        dr.eval(colours[-1])
    *image.rgb, image.alpha = (sum(channel[1:], channel[0]) / (n * n) for channel in zip(*colours, strict=True))
    return image


def _picture(pixels: list[Pixel], lanes: Lanes) -> list[Any]:
    """Red, green, blue and opacity of the lanes' pixels as row-major arrays."""
    colours = [lanes.image(mi.Float, [p[c] for p in pixels]) for c in (RED, GREEN, BLUE)]
    return [*colours, lanes.image(mi.Float, [1.0 - p[T] for p in pixels])]


def _collect(pixels: list[Pixel], lanes: Lanes, only: int | None) -> tuple[Image, Any]:
    """The lanes' pixels as row-major arrays, and where an instance may be wrong.

    ``only`` is the id of all Gaussians if there is but one.
    """
    *rgb, alpha = _picture(pixels, lanes)
    depths = []
    for pixel in pixels:
        opacity = 1.0 - pixel[T]
        mean = dr.select(opacity > 0, pixel[SUM_Z] / opacity, 0.0)
        depths.append(dr.select(pixel[T] < 0.5, pixel[HALF_Z], mean))
    unsure = None
    if only is None:
        winners = [winner_of_tally(pixel[TALLY:], pixel[T]) for pixel in pixels]
        numbers = [number for number, _ in winners]
        unsure = lanes.image(mi.Bool, [doubt for _, doubt in winners])
    else:
        everything = dr.opaque(mi.Float, only)
        numbers = [dr.select(1.0 - pixel[T] > pixel[T], everything, 0.0) for pixel in pixels]
    depth, instance = lanes.image(mi.Float, depths), lanes.image(mi.UInt32, numbers)
    return Image(rgb, alpha, depth, instance, alpha), unsure
