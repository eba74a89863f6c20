"""Antialiasing of silhouettes: at borders between instances, a pixel is the mean of rays with the light of their side.

One ray through a pixel's centre sees only one side of a silhouette, so that its outline shows steps. The mean of
several rays times the light of the pixel's centre shows specks where both sides differ in light. Pixels with a
neighbour of another instance or another visible mesh are therefore rendered again, in a view with one pixel per ray. So
are pixels in which splats of the surroundings hide the lower edge of an object, because they show both. Only the tiles
of this view that contain such pixels have lists. The average is taken over linear, lit colours.

Light is not traced again. The surface that the pixel shows takes its light. What else a ray sees takes the light of the
nearest pixel that shows another surface. Both sides of a silhouette are therefore lit like the surface beside them
(compare Salvi and Vidimce 2012, "Surface based anti-aliasing", which shades once per surface), also along a ray that
sees both of them. Ids, depths and all other label data stay those of the pixel's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.quality import Quality
from mitsplat.renderer.projection.clouds import CloudSet, Placement
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, CameraView
from mitsplat.renderer.rays.tile_subset import TileSubset
from mitsplat.renderer.splatting.march import Image, march_tiles
from mitsplat.renderer.splatting.pairs import CrowdedError
from mitsplat.renderer.splatting.tiles import bin_gaussians

REACH = 3
"""Distance up to which the light of another surface is found [px].

Splats of surroundings that rise above their proxy cover the lower edge of an object over several pixels, which show
both.
"""


@dataclass(frozen=True, eq=False)
class Edges:
    """Blocks of a view's pixels that contain a border, and the finer view of them.

    Rays of the finer view are numbered tile after tile of ``subset``, and row by row in each tile.

    Attributes:
        view: View of the picture.
        fine: Finer view, with one pixel per ray.
        subset: Tiles of the finer view that contain borders.
        zoom: Rays along each axis of a pixel.
    """

    view: CameraView
    fine: CameraView
    subset: TileSubset
    zoom: int

    @classmethod
    def find(cls, key: mi.UInt32, view: CameraView, zoom: int, mixed: mi.Bool | None = None) -> Edges | None:
        """Find the blocks of pixels whose ``key`` (UInt32, row-major) differs from one of their eight neighbours.

        Args:
            key: Keys of the pixels of the view.
            view: View of the picture.
            zoom: Rays along each axis of a pixel, a divisor of a tile's width and height.
            mixed: True for other pixels (row-major) that show two surfaces.

        Returns:
            None if there are no such pixels.
        """
        fine, width, height = view.finer(zoom), TILE_WIDTH // zoom, TILE_HEIGHT // zoom
        block = dr.arange(mi.UInt32, fine.tiles_x * fine.tiles_y)
        row = block // fine.tiles_x
        x, y = mi.Int32(block - row * fine.tiles_x) * width, mi.Int32(row) * height
        own, differs = dr.gather(mi.UInt32, key, _pixel(x, y, view)), mi.Bool(False)
        for dx, dy in np.ndindex(width + 2, height + 2):
            pixel = _pixel(x + (dx - 1), y + (dy - 1), view)
            differs |= dr.gather(mi.UInt32, key, pixel) != own
            if mixed is not None and 1 <= dx <= width and 1 <= dy <= height:
                differs |= dr.gather(mi.Bool, mixed, pixel)
        dr.eval(differs)
        subset = TileSubset.of(differs, fine)
        return cls(view, fine, subset, zoom) if subset.count else None

    def rays(self) -> mi.Ray3f:
        """Return the world-space rays of the finer view, with unit direction."""
        rays = self.fine.rays_through(*self.positions())
        dr.eval(rays)
        return rays

    def positions(self) -> tuple[mi.Float, mi.Float]:
        """Return the pixel positions (x, y) of those rays in the finer view [px]."""
        x, y = self.subset.positions(self.fine)
        return mi.Float(x) + 0.5, mi.Float(y) + 0.5

    def trace(
        self,
        clouds: CloudSet,
        placements: Sequence[Placement],
        quality: Quality,
        own: mi.UInt32,
        z_max: mi.Float | None,
    ) -> tuple[Image, list[mi.Float]]:
        """Render splats along those rays; arguments and result as in `march_tiles`.

        Raises:
            CrowdedError: If one tile alone has too many pairs.
        """
        return trace_tiles(clouds, placements, self.fine, self.subset, quality, mi.Float(own), z_max)

    def pixels(self) -> mi.UInt32:
        """Return the pixel of the picture that contains each ray."""
        x, y = self.subset.positions(self.fine)
        return _pixel(mi.Int32(x // self.zoom), mi.Int32(y // self.zoom), self.view)

    def nearest_other(self, keys: mi.UInt32, own: mi.UInt32) -> mi.UInt32:
        """Return for each ray the nearest pixel with another key than its own pixel; that pixel if there is none.

        Pixels up to :data:`REACH` away count, in eight directions. If the key of the ray itself is not that of its
        pixel, only pixels with the key of the ray count.

        Args:
            keys: Keys of the picture's pixels.
            own: Keys of the rays.
        """
        x, y = self.subset.positions(self.fine)
        px, py = mi.Int32(x // self.zoom), mi.Int32(y // self.zoom)
        # Direction of the nearer neighbour along each axis.
        right, down = (dr.select(place % self.zoom * 2 >= self.zoom, mi.Int32(1), -1) for place in (x, y))
        pixel = _pixel(px, py, self.view)
        here, found = dr.gather(mi.UInt32, keys, pixel), mi.Bool(False)
        directions = (1, 0), (0, 1), (1, 1), (-1, 0), (0, -1), (-1, 1), (1, -1), (-1, -1)
        for steps, (dx, dy) in product(range(1, REACH + 1), directions):
            other = _pixel(px + steps * dx * right, py + steps * dy * down, self.view)
            key = dr.gather(mi.UInt32, keys, other)
            wanted = ~found & (key != here) & ((key == own) | (own == here))
            pixel, found = dr.select(wanted, other, pixel), found | wanted
        return pixel

    def averaged(self, values: mi.Float | mi.Color3f, fine: mi.Float | mi.Color3f) -> mi.Float | mi.Color3f:
        """Return the picture ``values`` (Float or Color3f) with means over the rays in the blocks with borders."""
        width, height = TILE_WIDTH // self.zoom, TILE_HEIGHT // self.zoom
        lane = dr.arange(mi.UInt32, self.subset.count * width * height)
        tile, within = lane // (width * height), lane % (width * height)
        bx, by = within % width, within // width
        total = type(fine)(0)
        for dx, dy in np.ndindex(self.zoom, self.zoom):
            place = tile * TILE_PIXELS + (by * self.zoom + dy) * TILE_WIDTH + bx * self.zoom + dx
            total += dr.gather(type(fine), fine, place)
        number = dr.gather(mi.UInt32, self.subset.number, tile)
        row = number // self.fine.tiles_x
        x, y = (number - row * self.fine.tiles_x) * width + bx, row * height + by
        inside = (x < self.view.width) & (y < self.view.height)
        result = dr.copy(values)
        dr.scatter(result, total / self.zoom**2, y * self.view.width + x, inside, mode=dr.ReduceMode.Permute)
        return result


def _pixel(x: mi.Int32, y: mi.Int32, view: CameraView) -> mi.UInt32:
    """Return the number of a pixel, clamped to the image."""
    return mi.UInt32(dr.clip(y, 0, view.height - 1) * view.width + dr.clip(x, 0, view.width - 1))


def trace_tiles(
    clouds: CloudSet,
    placements: Sequence[Placement],
    view: CameraView,
    subset: TileSubset,
    quality: Quality,
    own: mi.Float,
    z_max: mi.Float | None,
) -> tuple[Image, list[mi.Float]]:
    """Render the tiles of ``subset``, in parts if they have too many pairs; see :func:`march_tiles`.

    The tiles are few, so that the order per ray replaces every order with a finite tolerance.

    Raises:
        CrowdedError: If one tile alone has too many pairs.
    """
    if quality.order != "tile":
        quality = replace(quality, tolerance=0.0)
    try:
        return march_tiles(bin_gaussians(clouds, placements, view, quality, subset=subset), view, quality, own, z_max)
    except CrowdedError:
        if subset.count == 1:
            raise
    parts, start = [], 0
    for half in subset.halves(view):
        pixels = dr.arange(mi.UInt32, half.count * TILE_PIXELS) + start
        part_z = None if z_max is None else dr.gather(mi.Float, z_max, pixels)
        parts.append(trace_tiles(clouds, placements, view, half, quality, dr.gather(mi.Float, own, pixels), part_z))
        start += half.count * TILE_PIXELS
    images, shares = zip(*parts, strict=True)
    return Image.joined(images), [dr.concat(list(values)) for values in zip(*shares, strict=True)]
