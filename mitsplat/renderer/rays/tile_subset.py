"""Subsets of a view's tiles, with counts of their members in rectangles of tiles."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, CameraView


@dataclass(frozen=True, eq=False)
class TileSubset:
    """Subset of a view's tiles that is processed separately.

    Attributes:
        number: Tile numbers in the view, ascending.
        count: Number of tiles.
        before: Number of subset tiles before each tile of the view; the last entry is the total.
        above: Number of subset tiles above and to the left of each tile corner of the view, row by row (Crow 1984,
            "Summed-area tables for texture mapping").
        columns: Number of corners in a row.
    """

    number: mi.UInt32
    count: int
    before: mi.UInt32
    above: mi.UInt32
    columns: int

    @classmethod
    def of(cls, flags: mi.Bool, view: CameraView) -> TileSubset:
        """Create the subset of a view's tiles that are flagged (Bool)."""
        columns, rows = view.tiles_x + 1, view.tiles_y + 1
        number = dr.compress(flags)
        corner = dr.arange(mi.UInt32, columns * rows)
        y = corner // columns
        x = corner - y * columns
        tile = y * view.tiles_x + x
        inside = (x < view.tiles_x) & (y < view.tiles_y)
        flag = dr.select(dr.gather(mi.Bool, flags, tile, inside), mi.UInt32(1), 0)
        # Prefix sums along the rows of corners, then along the columns, minus the sum at the start of each line.
        running = dr.prefix_sum(flag)
        along = running - dr.gather(mi.UInt32, running, y * columns)
        column_major = x * rows + y
        transposed = dr.empty(mi.UInt32, columns * rows)
        dr.scatter(transposed, along, column_major, mode=dr.ReduceMode.Permute)
        dr.eval(transposed)
        running = dr.prefix_sum(transposed)
        above = dr.gather(mi.UInt32, running, column_major) - dr.gather(mi.UInt32, running, x * rows)
        ones = dr.select(flags, mi.UInt32(1), 0)
        before = dr.empty(mi.UInt32, dr.width(flags) + 1)
        order = dr.arange(mi.UInt32, dr.width(flags))
        dr.scatter(before, dr.prefix_sum(ones), order, mode=dr.ReduceMode.Permute)
        dr.scatter(before, dr.opaque(mi.UInt32, dr.width(number)), dr.opaque(mi.UInt32, dr.width(flags)))
        dr.eval(number, before, above)
        return cls(number, dr.width(number), before, above, columns)

    def positions(self, view: CameraView) -> tuple[mi.UInt32, mi.UInt32]:
        """Return column and row of every pixel, tile after tile; those at the border may lie outside the image."""
        lane = dr.arange(mi.UInt32, self.count * TILE_PIXELS)
        number = dr.gather(mi.UInt32, self.number, lane // TILE_PIXELS)
        row = number // view.tiles_x
        x = (number - row * view.tiles_x) * TILE_WIDTH + lane % TILE_WIDTH
        return x, row * TILE_HEIGHT + lane // TILE_WIDTH % TILE_HEIGHT

    def halves(self, view: CameraView) -> tuple[TileSubset, TileSubset]:
        """Split the subset into its first and second half."""
        middle, tiles = self.count // 2, dr.width(self.before) - 1
        flags = [dr.zeros(mi.Bool, tiles) for _ in range(2)]
        place = dr.arange(mi.UInt32, self.count)
        for flag, mine in zip(flags, (place < middle, place >= middle), strict=True):
            dr.scatter(flag, mi.Bool(True), self.number, mine)
        first, second = (TileSubset.of(flag, view) for flag in flags)
        return first, second

    def any_in(self, x0: mi.UInt32, x1: mi.UInt32, y0: mi.UInt32, y1: mi.UInt32, active: mi.Bool = True) -> mi.Bool:
        """Return True for half-open ranges of columns and rows that contain a tile of the subset."""

        def above(x: mi.UInt32, y: mi.UInt32) -> mi.UInt32:
            return dr.gather(mi.UInt32, self.above, y * self.columns + x, active)

        return above(x1, y1) + above(x0, y0) > above(x0, y1) + above(x1, y0)

    def among(self, begin: mi.UInt32, size: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Return first place and number of the subset's tiles among ``size`` consecutive tiles from ``begin`` on."""
        first = dr.gather(mi.UInt32, self.before, begin)
        return first, dr.gather(mi.UInt32, self.before, begin + size) - first


@dataclass(frozen=True, eq=False)
class TileBox:
    """Box of a view's tiles: a :class:`TileSubset` that needs no tables.

    Attributes:
        number: Tile numbers in the view, ascending.
        count: Number of tiles.
        left, top, columns: First column, first row and number of columns, as opaque values.
        across: Number of the view's columns.
    """

    number: mi.UInt32
    count: int
    left: mi.UInt32
    top: mi.UInt32
    columns: mi.UInt32
    across: int

    @classmethod
    def around(cls, boxes: mi.UInt32, view: CameraView) -> TileBox:
        """Create the smallest box around non-empty half-open ranges (x0, x1, y0, y1), four numbers each."""
        x0, x1, y0, y1 = dr.gather(mi.Array4u, boxes, dr.arange(mi.UInt32, dr.width(boxes) // 4))
        ends = np.array(dr.concat([dr.min(x0), dr.max(x1), dr.min(y0), dr.max(y1)])).tolist()
        left, right, top, bottom = (int(end) for end in ends)
        place = dr.arange(mi.UInt32, (right - left) * (bottom - top))
        first_column, first_row, columns = (dr.opaque(mi.UInt32, n) for n in (left, top, right - left))
        row = place // columns
        number = (first_row + row) * view.tiles_x + first_column + (place - row * columns)
        dr.eval(number)
        return cls(number, dr.width(number), first_column, first_row, columns, view.tiles_x)

    def among(self, begin: mi.UInt32, size: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Return first place and number of ``size`` consecutive tiles in the box from ``begin`` on."""
        row = begin // self.across
        return (row - self.top) * self.columns + (begin - row * self.across - self.left), size
