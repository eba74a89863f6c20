"""Coarse light on visible planes: in evenly lit tiles one pixel of four is traced.

Light on a plane changes slowly, except at the edge of a shadow. A tile of BLOCK x BLOCK pixels is coarse under two
conditions. The tile and its neighbours show one plane each. Their light is even, according to the first rays from every
second pixel of every second row. Light in a coarse tile is traced and filtered at these pixels only, and interpolated
linearly between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import Emitters
from mitsplat.renderer.light.error_target import share_variance
from mitsplat.renderer.light.light_estimate import Estimate
from mitsplat.renderer.light.light_tiles import BLOCK, grid_size, tile_of_pixels
from mitsplat.renderer.light.lit_surface import LitSurface, VisibleSurfaces
from mitsplat.renderer.light.shadow_rays import ShadowTracer
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered

SAMPLES = (BLOCK // 2) ** 2
"""Number of traced pixels in a coarse tile."""

MIN_ROWS = 128
"""Smallest image height [px] at which planes are searched. Lower images gain little."""

MAX_EVEN_STEP = 0.04
"""Largest difference between the light shares of adjacent tiles that counts as even light."""

NOISE = 1.0
"""Tolerated noise of that difference, in squared standard deviations of independent rays. The rays of a tile are
stratified, so that their noise is lower.
"""

_PRIMES = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F, 0x165667B1)
"""Odd multipliers of the hash (those of xxHash)."""

_NEEDED, _PLAIN = 0x80000000, 0x40000000


def plane_codes(surface: LitSurface, eye: mi.Point3f) -> mi.UInt32:
    """Return a hash (UInt32) of the plane and the material at every pixel.

    The hash is 0 on instances, shiny surfaces and unknown points.

    The normal and the camera's distance to the plane are rounded. The rounding limits avoid the values that modelled
    planes typically have.
    """
    normal = surface.normal
    away = dr.abs(dr.dot(normal, surface.position - eye))
    parts = [mi.UInt32(mi.Int32(dr.floor(dr.fma(component, 200, 0.37)))) for component in normal]
    parts += [dr.reinterpret_array(mi.UInt32, away) >> 12, mi.UInt32(surface.trait) * 2]
    parts[-1] += dr.select(surface.relit, mi.UInt32(1), 0)
    code = mi.UInt32(0)
    for part, prime in zip(parts, _PRIMES, strict=True):
        code = (code ^ part) * prime
        code ^= code >> 15
    plain = surface.valid & surface.known & surface.relit & (surface.instance == 0) & ~surface.glossy
    return dr.select(plain, code & (_PLAIN - 1) | _PLAIN, 0)


@dataclass(frozen=True, eq=False)
class Planes:
    """Tiles that show a plane.

    Attributes:
        number: Tile numbers, row by row over all tiles.
        place: Index into ``number`` for every tile of the image. It is ``count`` where no light is needed, and ``count
            + 1`` where the tile shows no plane.
        view: Camera.
    """

    number: mi.UInt32
    place: mi.UInt32
    view: CameraView

    @classmethod
    def of(cls, codes: mi.UInt32, needed: mi.Bool, view: CameraView) -> Planes:
        """Find the tiles that need light and have one code in all pixels.

        The code must also hold in the adjacent row below and in the adjacent column to the right.
        """
        across, down = grid_size(view)
        tile = dr.arange(mi.UInt32, across * down)
        x, y = tile % across * BLOCK, tile // across * BLOCK
        codes = dr.select(needed, codes | _NEEDED, codes)
        first = dr.gather(mi.UInt32, codes, y * view.width + x)
        rounds, side = dr.opaque(mi.UInt32, (BLOCK + 1) ** 2), BLOCK + 1
        whole = (x + BLOCK <= view.width) & (y + BLOCK <= view.height)

        def look(i: mi.UInt32, same: mi.Bool, wanted: mi.Bool) -> tuple[mi.UInt32, mi.Bool, mi.Bool]:
            px, py = x + i % side, y + i // side
            inside = (px < view.width) & (py < view.height)
            code = dr.gather(mi.UInt32, codes, py * view.width + px, inside)
            within = (i % side < BLOCK) & (i // side < BLOCK)
            # Beyond the tile, only the code is compared, not the flag for needed light.
            alike = dr.select(within, code, code | _NEEDED) == (first | dr.select(within, mi.UInt32(0), _NEEDED))
            return i + 1, same & (alike | ~inside), wanted | (inside & within & (code >= _NEEDED))

        state = dr.zeros(mi.UInt32, dr.width(tile)), whole & (first > _NEEDED), dr.full(mi.Bool, False, dr.width(tile))
        # The search of a tile ends as soon as neither result can change.
        _, flat, wanted = dr.while_loop(state, lambda i, s, w: (i < rounds) & (s | ~w), look, label="planes")
        dr.eval(flat, wanted)
        number = dr.compress(flat)
        count = dr.width(number)
        place = dr.select(wanted, dr.opaque(mi.UInt32, count + 1), dr.opaque(mi.UInt32, count))
        if count:
            dr.scatter(place, dr.arange(mi.UInt32, count), number)
        dr.eval(place)
        return cls(number, place, view)

    @property
    def count(self) -> int:
        """Number of tiles that show a plane."""
        return int(dr.width(self.number))

    def samples(self) -> mi.UInt32:
        """Return the traced pixels, ordered by their place in the tile and then by tile."""
        i, count = dr.arange(mi.UInt32, SAMPLES * self.count), dr.opaque(mi.UInt32, self.count)
        across, _ = grid_size(self.view)
        within = i // count
        tile = dr.gather(mi.UInt32, self.number, i - within * count)
        x, y = tile % across * BLOCK + within % (BLOCK // 2) * 2, tile // across * BLOCK + within // (BLOCK // 2) * 2
        return y * self.view.width + x

    def coarse(self, estimate: Estimate) -> mi.Bool:
        """Return for every pixel (Bool) if it lies in a coarse tile, given the estimate at the :meth:`samples`."""
        count = dr.opaque(mi.UInt32, self.count)
        lane, rounds = dr.arange(mi.UInt32, self.count), dr.opaque(mi.UInt32, SAMPLES)

        def add(i: mi.UInt32, *sums: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Float]:
            at = lane + i * count
            more = [dr.sum(dr.gather(mi.Color3f, colour, at)) for colour in (estimate.lit, estimate.base)]
            more.append(dr.gather(mi.Float, estimate.squares, at))
            return i + 1, *(s + m for s, m in zip(sums, more, strict=True))

        state = dr.zeros(mi.UInt32, self.count), *(dr.zeros(mi.Float, self.count) for _ in range(3))
        _, lit, base, squares = dr.while_loop(state, lambda i, *_: i < rounds, add, label="planes' light")
        draws = dr.maximum(dr.square(base) / dr.maximum(squares, 1e-20), 1)
        share = dr.select(base > 0, lit / base, 1)
        variance = share_variance(share, draws)
        dr.eval(share, variance)
        even = mi.Bool(True)
        for neighbour in self._neighbours():
            plane = neighbour < count
            theirs = dr.gather(mi.Float, share, neighbour, plane), dr.gather(mi.Float, variance, neighbour, plane)
            # Where no light is needed, almost all light arrives.
            other, noise = (dr.select(plane, v, rest) for v, rest in zip(theirs, (mi.Float(1), 0), strict=True))
            allowed = dr.fma(NOISE, variance + noise, MAX_EVEN_STEP**2)
            even &= (neighbour <= count) & (dr.square(share - other) <= allowed)
        by_tile = dr.full(mi.Bool, False, dr.width(self.place))
        dr.scatter(by_tile, even, self.number)
        dr.eval(by_tile)
        return dr.gather(mi.Bool, by_tile, tile_of_pixels(self.view))

    def _neighbours(self) -> Iterator[mi.UInt32]:
        """Yield the places of the eight neighbours of each tile, and of the tile itself.

        Coordinates are clamped to the image.
        """
        across, down = grid_size(self.view)
        x, y = mi.Int32(self.number % across), mi.Int32(self.number // across)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                nx, ny = dr.clip(x + dx, 0, across - 1), dr.clip(y + dy, 0, down - 1)
                yield dr.gather(mi.UInt32, self.place, mi.UInt32(ny * across + nx))


@dataclass(frozen=True, eq=False)
class CoarseLight:
    """First rays of the traced pixels of coarse tiles.

    Attributes:
        coarse: True for pixels in such a tile, by pixel of the image.
        lattice: True for traced pixels of such tiles, by pixel of the image.
        pixel: Numbers of these traced pixels.
        estimate: Estimate at these pixels.
    """

    coarse: mi.Bool
    lattice: mi.Bool
    pixel: mi.UInt32
    estimate: Estimate

    @classmethod
    def of(
        cls, planes: Planes, visible: VisibleSurfaces, emitters: Emitters, seed: int, rays: int
    ) -> CoarseLight | None:
        """Trace ``rays`` rays at the samples of planes and keep the evenly lit tiles; return None if there are none."""
        if not planes.count:
            return None
        pixel, view = planes.samples(), visible.view
        lattice = dr.full(mi.Bool, False, view.width * view.height)
        dr.scatter(lattice, mi.Bool(True), pixel)
        surface = visible.at(pixel)
        dr.eval(surface, lattice)
        tracer = ShadowTracer(emitters, visible.proxies, surface, pixel, view, seed, lattice)
        count, steps = dr.width(pixel), (mi.UInt32(0), mi.UInt32(1))
        rows, rounds = dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, rays)
        estimate = tracer.trace(rows, Estimate.empty(count), rounds, rays, steps, matt=True)
        coarse = planes.coarse(estimate)
        # In a tile that is not coarse, the samples took other points of the sequence than the rest of its pixels will
        # take.
        lattice &= coarse
        dr.eval(coarse, lattice)
        kept = dr.compress(dr.gather(mi.Bool, lattice, pixel))
        if not dr.width(kept):
            return None
        return cls(coarse, lattice, dr.gather(mi.UInt32, pixel, kept), gathered(estimate, kept))


def between_samples(light: mi.Color3f, coarse: mi.Bool, view: CameraView) -> mi.Color3f:
    """Interpolate light (Color3f) linearly between the traced pixels of coarse tiles."""
    pixel = dr.arange(mi.UInt32, view.width * view.height)
    x, y = pixel % view.width, pixel // view.width
    odd_x, odd_y = x & 1, y & 1
    left, top = x - odd_x, y - odd_y
    right, bottom = x + odd_x, y + odd_y
    right, bottom = dr.select(right < view.width, right, left), dr.select(bottom < view.height, bottom, top)
    between = coarse & ((odd_x | odd_y) != 0)
    total = mi.Color3f(0)
    for ny in (top, bottom):
        for nx in (left, right):
            total += dr.gather(mi.Color3f, light, ny * view.width + nx, between)
    return dr.select(between, total * 0.25, light)
