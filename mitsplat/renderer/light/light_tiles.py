"""Image tiles with almost no change of light, detected with one ray per pixel."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.rays.camera_rays import CameraView

BLOCK = 8
"""Edge of a pixel block. The pixels of a block take consecutive points of one low-discrepancy sequence, so that the
filter averages a stratified set.
"""

STRIDE = BLOCK * BLOCK
"""Step in the sequence between two rays of a pixel; the points between belong to its neighbours."""

MIN_SHADOW_HITS = 3
"""Number of occluded rays in a quarter of a tile that indicates a shadow instead of noise."""


def block_order(view: CameraView) -> tuple[mi.UInt32, mi.Bool]:
    """Return the pixels in tracing order, and a flag (Bool) for pixels inside the image.

    Pixels with the same place in blocks of one :func:`parity` take the same point of the low-discrepancy sequence.
    Their rays are similar and are traced side by side (Keller and Heidrich 2001, "Interleaved Sampling"). This order
    applies within squares of BLOCK x BLOCK blocks, so that the pixel data stays in the processor's cache.
    """
    square, half = BLOCK * BLOCK, BLOCK // 2
    squares_x, squares_y = -(-view.width // square), -(-view.height // square)
    i = dr.arange(mi.UInt32, squares_x * squares_y * square**2)
    block, within, number = i % square, i // square % square, i // square**2
    kind, block = block // half**2, block % half**2
    block_x, block_y = block % half * 2 + (kind & 1), block // half * 2 + (kind >> 1)
    x = number % squares_x * square + block_x * BLOCK + within % BLOCK
    y = number // squares_x * square + block_y * BLOCK + within // BLOCK
    inside = (x < view.width) & (y < view.height)
    return dr.select(inside, y * view.width + x, 0), inside


def grid_size(view: CameraView) -> tuple[int, int]:
    """Return the number of tiles of BLOCK x BLOCK pixels along each axis of an image."""
    return -(-view.width // BLOCK), -(-view.height // BLOCK)


def tile_of_pixels(view: CameraView) -> mi.UInt32:
    """Return the number of the tile of every pixel; tiles are numbered row by row."""
    pixel = dr.arange(mi.UInt32, view.width * view.height)
    return pixel // view.width // BLOCK * grid_size(view)[0] + pixel % view.width // BLOCK


def parity(block_x: mi.UInt32, block_y: mi.UInt32) -> mi.UInt32:
    """Return the index (0 to 3) of a block in its group of 2 x 2 blocks."""
    return (block_x & 1) | (block_y & 1) << 1


@dataclass(frozen=True, eq=False)
class ShadowTiles:
    """Light loss in tiles of BLOCK x BLOCK pixels, from one ray per pixel.

    Attributes:
        occluded: Share of light (Color3f) that dynamic objects occlude in each tile, row by row.
        known: True if light arrives in the tile without dynamic objects.
        mean_occluded: Mean occluded share in a tile and its neighbours.
        concentrated: True if the occluded rays are concentrated in one of these tiles.
        view: Camera.
    """

    occluded: mi.Color3f
    known: mi.Bool
    mean_occluded: mi.Float
    concentrated: mi.Bool
    view: CameraView

    @classmethod
    def of(cls, arriving: mi.Color3f, lost: mi.Color3f, view: CameraView) -> ShadowTiles:
        """Sum light by tile.

        Sums have a fixed order, so that they do not depend on the number of threads.

        Args:
            arriving: Light (Color3f) without dynamic objects, in :func:`block_order`.
            lost: Light (Color3f) that dynamic objects occlude, in the same order.
            view: Camera.
        """
        width, height = grid_size(view)
        squares_x = -(-view.width // BLOCK**2)
        tile = dr.arange(mi.UInt32, width * height)
        x, y = tile % width, tile // width
        half = BLOCK // 2
        block = (parity(x, y) * half + y % BLOCK // 2) * half + x % BLOCK // 2
        start = (y // BLOCK * squares_x + x // BLOCK) * BLOCK**4 + block
        rounds = dr.opaque(mi.UInt32, BLOCK**2)

        def add(
            i: mi.UInt32, total: mi.Color3f, away: mi.Color3f, hits: mi.UInt32
        ) -> tuple[mi.UInt32, mi.Color3f, mi.Color3f, mi.UInt32]:
            place = start + i * BLOCK**2
            off = dr.gather(mi.Color3f, lost, place)
            # Each byte counts the occluded rays of a quarter of the tile.
            quarter = (i // (BLOCK // 2) & 1) | (i // (BLOCK * BLOCK // 2) << 1)
            hit = dr.select(dr.sum(off) > 0, mi.UInt32(1) << (8 * quarter), 0)
            return i + 1, total + dr.gather(mi.Color3f, arriving, place), away + off, hits + hit

        nothing = dr.zeros(mi.UInt32, width * height)
        state = mi.UInt32(nothing), dr.zeros(mi.Color3f, width * height), dr.zeros(mi.Color3f, width * height), nothing
        _, total, away, hits = dr.while_loop(state, lambda i, *_: i < rounds, add, label="tiles")
        dr.eval(total, away, hits)
        here, gone, concentrated = mi.Color3f(0), mi.Color3f(0), mi.Bool(False)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                nx, ny = mi.Int32(x) + dx, mi.Int32(y) + dy
                inside = (nx >= 0) & (nx < width) & (ny >= 0) & (ny < height)
                neighbour = mi.UInt32(ny * width + nx)
                weight = (2 - abs(dx)) * (2 - abs(dy))  # blocks of each parity sum to a quarter of the weight
                here += weight * dr.gather(mi.Color3f, total, neighbour, inside)
                gone += weight * dr.gather(mi.Color3f, away, neighbour, inside)
                counts = dr.gather(mi.UInt32, hits, neighbour, inside)
                for quarter in range(4):
                    concentrated |= (counts >> (8 * quarter) & 0xFF) >= MIN_SHADOW_HITS
        occluded = mi.Color3f(*[dr.select(h > 0, g / h, 0) for h, g in zip(here, gone, strict=True)])
        mean_occluded, known = dr.select(dr.sum(here) > 0, dr.sum(gone) / dr.sum(here), 0), dr.sum(total) > 0
        dr.eval(occluded, known, mean_occluded, concentrated)
        return cls(occluded, known, mean_occluded, concentrated, view)

    def differs(self, error: float) -> mi.Bool:
        """Return for each pixel (Bool) if dynamic objects occlude at least the share ``error``, or one place in it."""
        differs = self.concentrated | (self.mean_occluded >= dr.opaque(mi.Float, error))
        return dr.gather(mi.Bool, differs, tile_of_pixels(self.view))

    def light(self) -> mi.Color3f:
        """Return the remaining share of light (Color3f) at every pixel, interpolated between tile centres."""
        width, height = grid_size(self.view)
        pixel = dr.arange(mi.UInt32, self.view.width * self.view.height)
        x = (mi.Float(pixel % self.view.width) + 0.5) / BLOCK - 0.5
        y = (mi.Float(pixel // self.view.width) + 0.5) / BLOCK - 0.5
        left, top = dr.floor(x), dr.floor(y)
        total, weights = mi.Color3f(0), mi.Float(0)
        for dy in (0, 1):
            for dx in (0, 1):
                nx, ny = mi.Int32(left) + dx, mi.Int32(top) + dy
                inside = (nx >= 0) & (nx < width) & (ny >= 0) & (ny < height)
                tile = mi.UInt32(ny * width + nx)
                weight = (1 - dr.abs(x - left - dx)) * (1 - dr.abs(y - top - dy))
                weight = dr.select(inside & dr.gather(mi.Bool, self.known, tile, inside), weight, 0)
                total += weight * dr.gather(mi.Color3f, self.occluded, tile, inside)
                weights += weight
        return 1 - dr.select(weights > 0, total / weights, 0)
