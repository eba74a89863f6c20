"""Tiles of an image in which next to no light changes, and what one ray a pixel says of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.rays.camera_rays import CameraView

BLOCK = 8
"""Pixels of a BLOCK x BLOCK neighbourhood take consecutive points of one low-discrepancy sequence, so that the filter
that follows averages a stratified set."""

STRIDE = BLOCK * BLOCK
"""Numbers from one ray of a pixel to its next in that sequence; those between are of its neighbours."""

TOGETHER = 3
"""Rays that are stopped in a quarter of a tile from which on this is a shadow, and no chance."""


def block_order(view: CameraView) -> tuple[Any, Any]:
    """Pixels in an order for tracing, and whether they lie in the image.

    Those that share their place in a block, in blocks of one :func:`parity`, take the same point of the low-discrepancy
    sequence, hence similar rays, and are traced side by side (Keller and Heidrich 2001, "Interleaved Sampling"); but
    only within squares of BLOCK x BLOCK blocks, so that what is known of their pixels stays in the processor's cache.
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


def parity(block_x: Any, block_y: Any) -> Any:
    """Which of the blocks of a group of 2 x 2 blocks one is."""
    return (block_x & 1) | (block_y & 1) << 1


@dataclass(frozen=True, eq=False)
class Tiles:
    """What one ray a pixel says of tiles of BLOCK x BLOCK pixels.

    Attributes:
        taken: Share of light (Color3f) that dynamic objects take in each tile, row by row.
        known: Whether any light arrives there that they could take.
        around: Mean share that they take in a tile and those beside it.
        uneven: Whether what they take lies together in one of these tiles.
        view: Camera.
    """

    taken: Any
    known: Any
    around: Any
    uneven: Any
    view: CameraView

    @classmethod
    def of(cls, arriving: Any, lost: Any, view: CameraView) -> Tiles:
        """Of light (Color3f) that arrives without dynamic objects, and that they take, in :func:`block_order`.

        Sums are made in a fixed order, so that they do not depend on threads.
        """
        width, height = -(-view.width // BLOCK), -(-view.height // BLOCK)
        squares_x = -(-view.width // BLOCK**2)
        tile = dr.arange(mi.UInt32, width * height)
        x, y = tile % width, tile // width
        half = BLOCK // 2
        block = (parity(x, y) * half + y % BLOCK // 2) * half + x % BLOCK // 2
        start = (y // BLOCK * squares_x + x // BLOCK) * BLOCK**4 + block
        rounds = dr.opaque(mi.UInt32, BLOCK**2)

        def add(i: Any, total: Any, away: Any, hits: Any) -> tuple[Any, Any, Any, Any]:
            place = start + i * BLOCK**2
            off = dr.gather(mi.Color3f, lost, place)
            # A byte of counts for each quarter of the tile.
            quarter = (i // (BLOCK // 2) & 1) | (i // (BLOCK * BLOCK // 2) << 1)
            hit = dr.select(dr.sum(off) > 0, mi.UInt32(1) << (8 * quarter), 0)
            return i + 1, total + dr.gather(mi.Color3f, arriving, place), away + off, hits + hit

        nothing = dr.zeros(mi.UInt32, width * height)
        state = mi.UInt32(nothing), dr.zeros(mi.Color3f, width * height), dr.zeros(mi.Color3f, width * height), nothing
        _, total, away, hits = dr.while_loop(state, lambda i, *_: i < rounds, add, label="tiles")
        dr.eval(total, away, hits)
        here, gone, uneven = mi.Color3f(0), mi.Color3f(0), mi.Bool(False)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                nx, ny = mi.Int32(x) + dx, mi.Int32(y) + dy
                inside = (nx >= 0) & (nx < width) & (ny >= 0) & (ny < height)
                beside = mi.UInt32(ny * width + nx)
                weight = (2 - abs(dx)) * (2 - abs(dy))  # of which the blocks of each parity have a quarter
                here += weight * dr.gather(mi.Color3f, total, beside, inside)
                gone += weight * dr.gather(mi.Color3f, away, beside, inside)
                counts = dr.gather(mi.UInt32, hits, beside, inside)
                for quarter in range(4):
                    uneven |= (counts >> (8 * quarter) & 0xFF) >= TOGETHER
        taken = mi.Color3f(*[dr.select(h > 0, g / h, 0) for h, g in zip(here, gone, strict=True)])
        around, known = dr.select(dr.sum(here) > 0, dr.sum(gone) / dr.sum(here), 0), dr.sum(total) > 0
        dr.eval(taken, known, around, uneven)
        return cls(taken, known, around, uneven, view)

    def differs(self, error: float) -> Any:
        """Whether pixels lie where dynamic objects take more light than ``error``, or some of it in one place."""
        pixel = dr.arange(mi.UInt32, self.view.width * self.view.height)
        tile = pixel // self.view.width // BLOCK * -(-self.view.width // BLOCK) + pixel % self.view.width // BLOCK
        return dr.gather(mi.Bool, self.uneven | (self.around >= dr.opaque(mi.Float, error)), tile)

    def light(self) -> Any:
        """Share of light (Color3f) that is left at every pixel, between the middles of tiles."""
        width, height = -(-self.view.width // BLOCK), -(-self.view.height // BLOCK)
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
                total += weight * dr.gather(mi.Color3f, self.taken, tile, inside)
                weights += weight
        return 1 - dr.select(weights > 0, total / weights, 0)
