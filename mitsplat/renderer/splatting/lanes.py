"""Assignment of pixels to lanes: each lane carries one or more pixels of a column of a tile.

One lane may carry several rays, because fetching a record costs several times more than evaluating it for a packet of
rays. More rays per fetch are faster until registers run out.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Order
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, CameraView
from mitsplat.renderer.splatting.tiles import TileLists


def rows_together(order: Order) -> int:
    """Return the number of pixels of a column that one lane carries in a walk of an order.

    A GPU has enough lanes for one ray each, and the lanes of a warp fetch the same record. The march takes 0.6 of the
    time of four rays per lane. The orders per ray need too many registers for more than one ray.
    """
    return TILE_HEIGHT if order == "tile" and dr.backend_v(mi.Float) == dr.JitBackend.LLVM else 1


class Lanes:
    """Mapping from lanes to pixels: each lane carries one or more pixels of a column of a tile.

    Attributes:
        pixel: Row-major number of each pixel of the lane.
        inside: True if the pixel is in the image.
        count: Number of all pixels.
        start, stop: Range of the tile's list.
        x, y: Column and row of the lane's first pixel.
        view, rows: The camera, and the number of pixels of a lane.
    """

    def __init__(self, lists: TileLists, view: CameraView, rows: int = TILE_HEIGHT, *, by_tile: bool = False) -> None:
        """Assign ``rows`` pixels (a divisor of the tile height) to each lane.

        With ``by_tile``, pixels are numbered tile after tile and row by row in each tile, instead of by the image.
        """
        count = view.tiles_x * view.tiles_y if lists.tiles is None else dr.width(lists.tiles)
        per_tile = TILE_PIXELS // rows
        lane = dr.arange(mi.UInt32, count * per_tile)
        own = lane // per_tile
        tile = own if lists.tiles is None else dr.gather(mi.UInt32, lists.tiles, own)
        tile_y, column, row = tile // view.tiles_x, lane % TILE_WIDTH, lane % per_tile // TILE_WIDTH * rows
        self.view, self.rows = view, rows
        self.x = (tile - tile_y * view.tiles_x) * TILE_WIDTH + column
        self.y = tile_y * TILE_HEIGHT + row
        self.count = count * TILE_PIXELS if by_tile else view.width * view.height
        if by_tile:
            first = own * TILE_PIXELS + row * TILE_WIDTH + column
            self.pixel = [first + k * TILE_WIDTH for k in range(rows)]
        else:
            self.pixel = [(self.y + k) * view.width + self.x for k in range(rows)]
        self.inside = [(self.x < view.width) & (self.y + k < view.height) for k in range(rows)]
        self.start = dr.gather(mi.UInt32, lists.start, own)
        self.stop = dr.select(self.inside[0], dr.gather(mi.UInt32, lists.stop, own), self.start)

    def centre_slopes(self) -> tuple[list[mi.Float], list[mi.Float]]:
        """Return slopes u and v of the rays through pixel centres; those of a distorted view are stored in memory."""
        if not self.view.distortion:
            return self.slopes(0.5, 0.5)
        number = dr.arange(mi.UInt32, self.view.width * self.view.height)
        row = number // self.view.width
        u, v = self.view.slopes(mi.Float(number - row * self.view.width) + 0.5, mi.Float(row) + 0.5)
        dr.eval(u, v)
        places = list(zip(self.pixel, self.inside, strict=True))
        return [dr.gather(mi.Float, u, p, m) for p, m in places], [dr.gather(mi.Float, v, p, m) for p, m in places]

    def image(self, kind: type[dr.ArrayBase], values: list[dr.ArrayBase]) -> dr.ArrayBase:
        """Return a row-major array of type ``kind`` from one value per pixel of the lane."""
        target = dr.empty(kind, self.count)
        for value, number, mask in zip(values, self.pixel, self.inside, strict=True):
            dr.scatter(target, kind(value), number, mask, mode=dr.ReduceMode.Permute)
        return target

    def slopes(self, dx: mi.Float, dy: mi.Float) -> tuple[list[mi.Float], list[mi.Float]]:
        """Return slopes u and v of the rays at offset (dx, dy) in the lane's pixels."""
        pairs = [self.view.slopes(mi.Float(self.x) + dx, mi.Float(self.y + k) + dy) for k in range(self.rows)]
        return [u for u, _ in pairs], [v for _, v in pairs]
