"""Traced light on splats: irradiance with and without the dynamic occluders, and a highlight.

A splat stores what the camera saw, shadows included. Rendering it among new objects therefore needs no light transport
from scratch but a factor per visible point x with normal n,

    captured under the scene's light:   ratio = E(x, n | static and dynamic occluders) / E(x, n | static occluders)
    captured under uniform light:       ratio = (E(x, n | static and dynamic occluders) + E_bounce) / E_ref

with irradiance E = integral of V(x, w) L(w) max(0, n.w) dw over all emitters. The first is exactly 1 where no dynamic
object takes light away, so shadows that were captured are not applied twice. E_ref is the irradiance under which the
colours of the surroundings are exposed: an object taken in a light tent keeps its colours there, and is darker where
less light arrives. E_bounce is what the surroundings reflect, see :mod:`mitsplat.plugins.bounce`. The highlight is what
the lights mirror, less what a light tent has mirrored into the captured colour: under even light it adds nothing.

Rays are spent where they are needed. One a pixel is all for captured surfaces of which objects take no more light than
the wanted error, see :mod:`mitsplat.plugins.light_tiles`. All else gets as many as most need for that error, and more
where light, as it looks in the picture, errs by more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.plugins.bounce import RadianceGrid, bounced_light
from mitsplat.plugins.device import gathered
from mitsplat.plugins.emitters import Beam, Emitters, receiver
from mitsplat.plugins.footprint import Points
from mitsplat.plugins.highlight import Lobe, mirrored_tent
from mitsplat.plugins.light_filter import NOWHERE, RADIUS, Estimate, LightFilter
from mitsplat.plugins.light_tiles import BLOCK, Tiles, block_order, parity
from mitsplat.plugins.lit_surface import Surface, VisibleSurfaces
from mitsplat.plugins.proxies import Proxies, Stopper
from mitsplat.plugins.rays import View
from mitsplat.plugins.sorting import stable_order

ROBERTS = (3242174889, 2447445414)
"""Additive recurrence of the two-dimensional golden ratio in units of 2^-32 (Roberts 2018, "The unreasonable
effectiveness of quasirandom sequences"), of which the search for shadows takes a point for each pixel."""

RECURRENCE = (1996816038, 1246200886)
"""The same, of which a pixel takes every 64th point, and its 8 x 8 neighbours the others.

Those of a pixel are Roberts', of whose own recurrence every 16th point is nearly the same. There are 4096 of the kind;
of this one consecutive points are farthest apart.
"""

FIRST = 0.3
"""Rays per point after which its error is first estimated, times the wanted one: as many as most points need.

With fewer, the estimates are so rough that they send rays to the wrong points, and take penumbras for even light.
"""

LEAST_FIRST = 4
"""Least number of them."""

LEVEL_BITS = 4
"""Of how often that number is doubled: 2^15 times it is more than any setting."""

WORD = 32
"""Rays whose fate is kept as bits of one number."""


@dataclass(frozen=True)
class Accuracy:
    """How many shadow rays are spent.

    Attributes:
        error: Standard error of light that is half of white for which rays are spent, and as much to the eye of all
            other light; 0 spends ``most`` everywhere.
        most: Most rays per pixel.
        metered: Whether the picture is shown as bright on average as if half of its light arrived.
    """

    error: float
    most: int
    metered: bool = False

    @property
    def first(self) -> int:
        """Rays per point after which its error is first estimated."""
        wanted = max(LEAST_FIRST, round(FIRST / self.error)) if self.error > 0 else self.most
        return min(wanted, self.most)


def light_factor(
    scene: Any,
    proxies: Proxies,
    visible: VisibleSurfaces,
    *,
    accuracy: Accuracy,
    seed: int,
    point: tuple[float, ...],
    reference: Any,
    sky_reach: float = float("inf"),
    grid: RadianceGrid | None = None,
) -> tuple[Any, Any]:
    """Light factor and highlight (Color3f) of every visible point, see the module docstring.

    Sums over rays are averaged over neighbours before they are divided, so that points with little light do not turn
    black by chance. A relit point takes its irradiance without occluders from one fixed set of directions, which has no
    noise, and only the share that arrives from its rays.

    Args:
        scene: Mitsuba scene whose emitters give the light.
        proxies: What can stand in its way.
        visible: Where the camera's pixels, which are counted row by row, show something.
        accuracy: How many rays to spend.
        seed: Offset into the low-discrepancy sequence.
        point: Where in the scene rays are shared out among emitters by how much light they send [m].
        reference: Irradiance (Color3f) that a uniformly captured object's colours stand for.
        sky_reach: What is farther than this from a point does not hide the sky from it [m].
        grid: Captured colours of the surroundings, for the light that they reflect to objects; None leaves it out.
    """
    emitters, view = Emitters(scene, point, sky_reach), visible.view
    everything = visible.at(dr.arange(mi.UInt32, view.width * view.height))
    needed, light = everything.valid, mi.Color3f(1)
    if accuracy.error > 0:
        pixel, inside = block_order(view)
        tiles = _Tracer(emitters, proxies, visible.at(pixel), pixel, view, seed).search(inside)
        anew = everything.relit | (everything.specular > 0)
        needed = everything.valid & (anew | tiles.differs(accuracy.error))
        light = dr.select(everything.valid, tiles.light(), 1)
    dr.eval(needed, light)
    highlight = mi.Color3f(0)
    index = dr.compress(needed)
    if not dr.width(index):
        return light, highlight
    here = visible.at(index)
    dr.eval(here)
    light_filter = LightFilter(here, view, index)
    order = _blockwise(light_filter.place, view)
    points = Points.of(visible, here, index, light_filter.place, order)
    tracer = _Tracer(emitters, proxies, points.surface, dr.gather(mi.UInt32, index, points.owner), view, seed)
    first = accuracy.first
    rows = points.rows(order)
    rays = points.shared(dr.opaque(mi.UInt32, first), rows)
    estimate = tracer.trace(rows, Estimate.nothing(dr.width(points.owner)), rays, first, points.turn(rows))
    special = dr.compress(here.relit | (here.specular > 0))
    unshadowed = dr.full(mi.Float, 1, dr.width(index))
    if dr.width(special):
        open_light, mirrored, tent = _open_light(emitters, points, special)
        relit = dr.gather(mi.Bool, here.relit, special)
        dr.scatter(unshadowed, dr.sum(open_light / reference) / 3, special, relit)
        dr.eval(unshadowed)
    if first < accuracy.most:
        pixels = dr.width(needed) if accuracy.metered else 0
        wanted = light_filter.rays_for(points.summed(estimate), accuracy.error, unshadowed, pixels)
        more = dr.gather(mi.Float, wanted, order) > dr.opaque(mi.Float, first)
        rows = points.rows(dr.gather(mi.UInt32, order, dr.compress(more)))
        if dr.width(rows):
            # Doubled until enough; pixels with the same number of rays go together, so that no lane waits for another.
            owner = dr.gather(mi.UInt32, points.owner, rows)
            level, extra = _doublings(dr.gather(mi.Float, wanted, owner), first, accuracy.most)
            lane = stable_order(level, LEVEL_BITS)
            rows, extra = (dr.gather(mi.UInt32, values, lane) for values in (rows, points.shared(extra, rows)))
            estimate = tracer.trace(rows, estimate, extra, accuracy.most - first, points.turn(rows))
    lit, base, shine, glare = light_filter.smooth(points.summed(estimate))
    share = dr.select((base > 0) & (lit != base), lit / base, 1)  # a GPU divides a number by itself to almost 1
    light = mi.Color3f(*[v + dr.zeros(mi.Float, dr.width(needed)) for v in light])
    dr.eval(light, share, shine, glare)
    dr.scatter(light, share, index)
    if dr.width(special):
        own, pixels = gathered(here, special), dr.gather(mi.UInt32, index, special)
        part, shine, glare = (dr.gather(type(v), v, special) for v in (share, shine, glare))
        dr.eval(own, part, shine, glare)
        # Where no ray came from where the lobe is, as much of it arrives as of all light. (dr.mean would write the
        # width of the array into the kernel.)
        mirrored *= dr.select(glare > 0, shine / glare, dr.sum(part) / 3) * (dr.pi / reference)
        relit = part * open_light / reference
        mirrored -= dr.select(own.relit, relit * tent, 0)
        dr.eval(relit, mirrored)
        if grid is not None and proxies.static is not None:
            # After the mirror images were exchanged: what the tent's stands for of the surroundings is the nearest
            # known.
            relit += _Tracer(emitters, proxies, own, pixels, view, seed).bounce(grid)
        dr.scatter(light, relit, pixels, own.relit)
        highlight = mi.Color3f(dr.zeros(mi.Float, dr.width(needed)))
        dr.scatter(highlight, mirrored, pixels)
    return light, highlight


def _open_light(emitters: Emitters, points: Points, special: Any) -> tuple[Any, Any, Any]:
    """Means over the points of pixels, without occluders: irradiance, mirrored light, and what the tent's takes."""
    rows = points.rows(special)
    own = gathered(points.surface, rows)
    dr.eval(own)
    found = emitters.open_light(receiver(own.position, own.normal), Lobe.of(own), own.valid)
    columns = *found, mirrored_tent(own), dr.select(own.valid, mi.Float(1), 0)
    dr.eval(columns)
    means = []
    for column in columns:
        by_row = dr.zeros(type(column), dr.width(points.owner))
        dr.scatter(by_row, dr.select(own.valid, column, 0), rows)
        dr.eval(by_row)
        means.append(dr.gather(type(column), points.total(by_row), special))
    *sums, count = means
    light, mirrored, tent = (total / dr.maximum(count, 1) for total in sums)
    dr.eval(light, mirrored, tent)
    return light, mirrored, tent


def _doublings(wanted: Any, rays: int, most: int) -> tuple[Any, Any]:
    """How often ``rays`` is doubled until it is enough or ``most``, and how many more rays these are."""
    level, extra = (dr.zeros(mi.UInt32, dr.width(wanted)) for _ in range(2))
    while rays < most:
        more, step = wanted > dr.opaque(mi.Float, rays), min(rays, most - rays)
        level += dr.select(more, mi.UInt32(1), 0)
        extra += dr.select(more, dr.opaque(mi.UInt32, step), 0)
        rays += step
    dr.eval(level, extra)
    return level, extra


def _blockwise(place: Any, view: View) -> Any:
    """What an image ``place`` holds, less where it is NOWHERE, in the order of :func:`block_order`."""
    pixel, inside = block_order(view)
    ordered = dr.select(inside, dr.gather(mi.UInt32, place, pixel), NOWHERE)
    return dr.gather(mi.UInt32, ordered, dr.compress(ordered != NOWHERE))


@dataclass(frozen=True, eq=False)
class _Tracer:
    """Rays from visible points.

    Attributes:
        surface: The points.
        pixel: Which of the image's each of them is in.
    """

    emitters: Emitters
    proxies: Proxies
    surface: Surface
    pixel: Any
    view: View
    seed: int

    def search(self, inside: Any) -> Tiles:
        """What dynamic objects take of one ray of every point, all pixels in :func:`block_order`, by tiles.

        Each of 2 x 2 blocks has points of its own, else what is too small for those of one block is missed in all.
        """
        surface, proxies, width = self.surface, self.proxies, self.view.width
        kind = parity(self.pixel % width // BLOCK, self.pixel // width // BLOCK)
        number = self._start(self.pixel) + kind * (BLOCK * BLOCK)
        active = inside & surface.valid
        beam = self.emitters.sample(receiver(surface.position, surface.normal), _sequence(number, ROBERTS), active)
        ray = _shadow_ray(_origin(surface), beam, surface.offset)
        captured = ~(surface.relit | (surface.specular > 0))
        static_light = free = active & captured & (dr.sum(beam.irradiance) > 0)
        for stopper in proxies.stoppers:
            free = free & ~stopper.stop(ray, surface.instance, self.pixel * RECURRENCE[0] + number, free)
            if proxies.apart:
                dr.eval(free)
            if stopper is proxies.static:
                static_light = free
        arriving = dr.select(static_light, beam.irradiance, 0)
        lost = dr.select(free, 0, arriving)
        dr.eval(arriving, lost)
        return Tiles.of(arriving, lost, self.view)

    def trace(self, places: Any, before: Estimate, rays: Any, most: int, turn: tuple[Any, Any]) -> Estimate:
        """What ``rays`` more rays, ``most`` at the most, add to an estimate at ``places``.

        ``turn`` says which number of its pixel's sequence a place takes first, and how many come until its next one.
        """
        apart = self.proxies.apart
        if apart and most > WORD:
            for begin in range(0, most, WORD):
                part = dr.minimum(dr.maximum(rays, begin) - begin, WORD)
                before = self.trace(places, before, part, min(WORD, most - begin), turn)
            return before
        surface = gathered(self.surface, places)
        pixel = dr.gather(mi.UInt32, self.pixel, places)
        begin, step = turn
        done = mi.UInt32(dr.gather(mi.Float, before.rays, places))
        start, step = self._start(pixel) + (begin + done * step) * (BLOCK * BLOCK), step * (BLOCK * BLOCK)
        si = receiver(surface.position, surface.normal)
        origin = _origin(surface)
        lobe = Lobe.of(surface)
        static, stoppers = self.proxies.static, self.proxies.stoppers
        known: list[Any] = []

        def send(i: Any) -> tuple[Beam, Any, Any, list[Any]]:
            """Ray ``i`` of every point: where to, whether it counts, its number, and what is known to stop it."""
            number = start + i * step
            beam = self.emitters.sample(si, _sequence(number), surface.valid)
            active = surface.valid & (dr.sum(beam.irradiance) > 0)
            return beam, active, number, [(word >> i & 1) != 0 for word in known]

        def stop(stopper: Stopper, beam: Beam, number: Any, active: Any) -> Any:
            ray = _shadow_ray(origin, beam, surface.offset)
            return stopper.stop(ray, surface.instance, pixel * RECURRENCE[0] + number, active)

        def note(i: Any, word: Any) -> tuple[Any, Any]:
            beam, free, number, stopped = send(i)
            for each in stopped:
                free = free & ~each
            return i + 1, word | dr.select(stop(stoppers[len(known)], beam, number, free), mi.UInt32(1) << i, 0)

        if apart:  # a bit for each ray and scene but the last, each by a kernel of its own
            for _ in stoppers[1:]:
                nothing = dr.zeros(mi.UInt32, dr.width(places))
                _, word = dr.while_loop((nothing, mi.UInt32(nothing)), lambda i, _: i < rays, note, label="stopped")
                dr.eval(word)
                known.append(word)

        def body(i: Any, lit: Any, base: Any, shine: Any, glare: Any, squares: Any) -> tuple[Any, ...]:
            beam, active, number, stopped = send(i)
            static_light = free = active
            for each, stopper in enumerate(stoppers):
                free = free & ~(stopped[each] if each < len(stopped) else stop(stopper, beam, number, free))
                if stopper is static:
                    static_light = free
            light, unshadowed = (dr.select(where, beam.irradiance, 0) for where in (free, static_light))
            compared = dr.select(surface.relit, dr.select(active, beam.irradiance, 0), unshadowed)
            lit += light
            base += compared
            reflectance = lobe.reflectance(beam.direction)
            shine += dr.sum(light) * reflectance
            glare += dr.select(active, dr.sum(beam.irradiance) * reflectance, 0)
            squares += dr.square(dr.sum(compared))
            return i + 1, lit, base, shine, glare, squares

        sums = [dr.gather(type(v), v, places) for v in before.sums]
        state = dr.zeros(mi.UInt32, dr.width(places)), *sums
        _, *sums = dr.while_loop(state, lambda i, *_: i < rays, body, label="light")
        return before.updated(places, *sums, dr.gather(mi.Float, before.rays, places) + mi.Float(rays))

    def bounce(self, grid: RadianceGrid) -> Any:
        """Irradiance (Color3f) from the surroundings over that of display white, averaged over neighbours."""
        light_filter = LightFilter(self.surface, self.view, self.pixel)
        places = _blockwise(light_filter.place, self.view)
        here = gathered(self.surface, places)
        start = self._start(dr.gather(mi.UInt32, self.pixel, places))
        total = bounced_light(
            grid, self.proxies, _origin(here), here.normal, lambda i: _sequence(start + i * (BLOCK * BLOCK))
        )
        rough = dr.empty(mi.Color3f, dr.width(places))
        dr.scatter(rough, total, places)
        dr.eval(rough)
        return mi.Color3f(*light_filter.average([*rough], dr.full(mi.Float, 1, dr.width(places)), RADIUS))

    def _start(self, pixel: Any) -> Any:
        start = dr.opaque(mi.UInt32, self.seed * 2654435761 % (1 << 32))
        return start + _bayer(pixel % self.view.width, pixel // self.view.width)


def _origin(surface: Surface) -> Any:
    """Where shadow rays start: on the smooth surface that the proxy stands for, and off the triangle itself."""
    return surface.position + surface.lift + surface.face * surface.offset


def _shadow_ray(origin: Any, beam: Any, offset: Any) -> Any:
    ray = mi.Ray3f(origin, beam.direction)
    ray.maxt = dr.maximum(beam.reach - 2 * offset, 0)
    return ray


def _sequence(i: Any, recurrence: tuple[int, int] = RECURRENCE) -> Any:
    """Point ``i`` of a low-discrepancy sequence, to 24 bits however large ``i`` is."""
    return mi.Point2f(*[mi.Float((i * step) >> 8) * 2.0**-24 for step in recurrence])


def _bayer(x: Any, y: Any) -> Any:
    """Rank of a pixel in an 8x8 ordered-dither matrix: neighbours take far-apart points of the sequence."""
    result = mi.UInt32(0)
    for bit in range(3):
        a, b = (x >> bit) & 1, (y >> bit) & 1
        result |= ((a ^ b) << (5 - 2 * bit)) | (b << (4 - 2 * bit))
    return result
