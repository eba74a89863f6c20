"""Traced light on splats: irradiance with and without dynamic occluders, and a highlight.

A splat stores the radiance that the camera saw, shadows included. Rendering it among new objects therefore needs no
full light transport, but one factor per visible point x with normal n:

    captured under the scene's light:   ratio = E(x, n | static and dynamic occluders) / E(x, n | static occluders)
    captured under uniform light:       ratio = (E(x, n | static and dynamic occluders) + E_bounce) / E_ref

with irradiance E = integral of V(x, w) L(w) max(0, n.w) dw over all emitters. The first ratio is exactly 1 where no
dynamic object takes light away, so that captured shadows are not applied twice. E_ref is the irradiance for which the
colours of the surroundings are exposed. An object captured in a light tent keeps its colours under E_ref, and is darker
where less light arrives. E_bounce is the light that the surroundings reflect, see
:mod:`mitsplat.renderer.light.bounce`. The highlight is the mirrored light of the emitters minus the tent light mirrored
in the captured colour; under even light it adds nothing.

Rays are spent adaptively. Captured surfaces get one ray per pixel where objects occlude less light than the wanted
error, see :mod:`mitsplat.renderer.light.light_tiles`. All other points get the number of rays that most points need for
that error. Points with a larger perceptual error get more. On visible planes in even light, one pixel of four is
traced, see :mod:`mitsplat.renderer.light.light_planes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.bounce import BOUNCE_RAYS, MESH_RAYS, RadianceGrid, Reflectors
from mitsplat.renderer.light.emitter_sampling import Beam, Emitters, receiver
from mitsplat.renderer.light.highlight import Lobe, mirrored_tent
from mitsplat.renderer.light.light_filter import RADIUS, UNTRACED, Estimate, LightFilter, packed
from mitsplat.renderer.light.light_planes import MIN_ROWS, Planes, between_samples, plane_codes
from mitsplat.renderer.light.light_points import LightPoints
from mitsplat.renderer.light.light_tiles import BLOCK, STRIDE, ShadowTiles, block_order, parity
from mitsplat.renderer.light.lit_surface import LitSurface, VisibleSurfaces
from mitsplat.renderer.occluders.proxies import OccluderScene, Proxies
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered
from mitsplat.renderer.splatting.sorting import stable_order

ROBERTS = (3242174889, 2447445414)
"""Additive recurrence of the two-dimensional golden ratio in units of 2^-32 (Roberts 2018, "The unreasonable
effectiveness of quasirandom sequences"). The shadow search takes one point of it per pixel.
"""

RECURRENCE = (1996816038, 1246200886)
"""Additive recurrence of the shadow rays: a pixel takes every 64th point, and its 8 x 8 neighbours take the others.

Every 64th point of this recurrence is a point of Roberts' recurrence, in whose own order every 16th point is nearly the
same. There are 4096 recurrences of this kind; in this one consecutive points are farthest apart.
"""

FIRST_RAYS = 0.3
"""Rays per point before the first error estimate, times the wanted error: the number that most points need.

With fewer rays the estimates are so rough that rays go to the wrong points, and penumbras count as even light.
"""

MIN_FIRST_RAYS = 4
"""Smallest number of these rays."""

PLANE_FACTOR = 2
"""Factor of the number of rays at a point that represents four pixels of a plane. With factor 1, its error would be a
quarter larger than with rays at each pixel. With this factor the error is the same.
"""

LEVEL_BITS = 4
"""Bits of the number of doublings; 2^15 times the first rays exceeds every setting."""

WORD_BITS = 32
"""Number of rays whose occlusion is stored as bits of one integer."""


@dataclass(frozen=True)
class Accuracy:
    """Target error and limits of shadow rays.

    Attributes:
        error: Target standard error of mid-grey irradiance, scaled perceptually elsewhere; 0 spends ``most``
            everywhere.
        most: Largest number of rays per pixel.
        metered: True if automatic exposure normalises the mean brightness of the picture to mid-grey.
    """

    error: float
    most: int
    metered: bool = False

    @property
    def first(self) -> int:
        """Rays per point before the first error estimate."""
        wanted = max(MIN_FIRST_RAYS, round(FIRST_RAYS / self.error)) if self.error > 0 else self.most
        return min(wanted, self.most)

    @property
    def dense(self) -> int:
        """Rays per point that represents four pixels of a plane, before the first error estimate."""
        return min(PLANE_FACTOR * self.first, self.most)


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
    bounce: bool = False,
) -> tuple[Any, Any]:
    """Compute light factor and highlight (Color3f) of every visible point, see the module docstring.

    Sums over rays are averaged over neighbours before the division, so that points with little light do not turn black
    by chance. A relit point takes its unoccluded irradiance from one fixed, noise-free set of directions. Its rays only
    estimate the share that arrives.

    Args:
        scene: Mitsuba scene with the emitters.
        proxies: Occluders.
        visible: Surface points of the camera's pixels, row by row.
        accuracy: Target error and limits of shadow rays.
        seed: Offset into the low-discrepancy sequence.
        point: Point at which emitters are compared to distribute the rays among them [m].
        reference: Irradiance (Color3f) at which a uniformly captured object keeps its colours.
        sky_reach: Distance beyond which nothing occludes the sky [m].
        grid: Captured colours of the surroundings; None if there are none.
        bounce: True if objects receive the light that surroundings and visible meshes reflect.
    """
    emitters, view = Emitters(scene, point, sky_reach), visible.view
    everything = visible.at(dr.arange(mi.UInt32, view.width * view.height))
    needed, light = everything.valid, mi.Color3f(1)
    if accuracy.error > 0:
        captured = everything.valid & ~(everything.relit | (everything.specular > 0))
        codes = plane_codes(everything, visible.eye)
        some_captured, some_planes = dr.any(captured), dr.any(codes != 0)
        dr.eval(everything.valid, captured, codes)
        if some_captured:
            tiles = _Tracer(emitters, proxies, everything, None, view, seed).search(captured)
            needed = everything.valid & (~captured | tiles.differs(accuracy.error))
            light = dr.select(everything.valid, tiles.light(), 1)
    dr.eval(needed, light)
    highlight = mi.Color3f(0)
    first, plane = accuracy.first, None
    if accuracy.error > 0 and view.height >= MIN_ROWS and some_planes:
        plane = _CoarseLight.of(Planes.of(codes, needed, view), visible, emitters, seed, accuracy)
    if plane is not None:
        needed &= ~plane.coarse | plane.lattice
        dr.eval(needed)
    index = dr.compress(needed)
    if not dr.width(index):
        return light, highlight
    here = visible.at(index)
    dr.eval(here)
    light_filter = LightFilter(here, view, index, plane and plane.coarse)
    order = _blockwise(light_filter.place, view)
    points = LightPoints.of(visible, here, index, light_filter.place, order)
    pixels = dr.gather(mi.UInt32, index, points.owner)
    tracer = _Tracer(emitters, proxies, points.surface, pixels, view, seed, plane and plane.lattice)
    estimate = Estimate.empty(dr.width(points.owner))
    rest = order
    if plane is not None:
        places = dr.gather(mi.UInt32, light_filter.place, plane.pixel)
        estimate = plane.estimate.scattered(places, dr.width(points.owner))
        rest = dr.gather(mi.UInt32, order, dr.compress(dr.gather(mi.Float, estimate.rays, order) == 0))
    rows = points.rows(rest)
    if dr.width(rows):
        rays = points.ray_count(dr.opaque(mi.UInt32, first), rows)
        estimate = tracer.trace(rows, estimate, rays, first, points.steps(rows))
    special = dr.compress(here.relit | (here.specular > 0))
    unshadowed = dr.full(mi.Float, 1, dr.width(index))
    if dr.width(special):
        open_light, mirrored, tent = _open_light(emitters, points, special)
        relit = dr.gather(mi.Bool, here.relit, special)
        dr.scatter(unshadowed, dr.sum(open_light / reference) / 3, special, relit)
        dr.eval(unshadowed)
    bounced, reflectors = None, Reflectors(grid, proxies, emitters, reference)
    if bounce and reflectors.any and dr.width(special):
        whole = _Tracer(emitters, proxies, here, index, view, seed, plane and plane.lattice)
        bounced = whole.bounce(reflectors)
    if first < accuracy.most:
        pixels = dr.width(needed) if accuracy.metered else 0
        wanted = light_filter.rays_for(points.sum_estimate(estimate), accuracy.error, unshadowed, pixels)
        spent = dr.full(mi.UInt32, first, dr.width(index))
        if plane is not None:
            spent = dr.select(dr.gather(mi.Bool, plane.lattice, index), dr.opaque(mi.UInt32, accuracy.dense), spent)
        dr.eval(spent)
        more = dr.gather(mi.Float, wanted, order) > mi.Float(dr.gather(mi.UInt32, spent, order))
        rows = points.rows(dr.gather(mi.UInt32, order, dr.compress(more)))
        if dr.width(rows):
            # The number of rays is doubled until sufficient. Pixels with equal numbers are traced together, so that no
            # lane idles.
            owner = dr.gather(mi.UInt32, points.owner, rows)
            level, extra = _doublings(dr.gather(mi.Float, wanted, owner), first, accuracy.most)
            extra += dr.opaque(mi.UInt32, first) - dr.gather(mi.UInt32, spent, owner)
            lane = stable_order(level, LEVEL_BITS)
            rows, extra = (dr.gather(mi.UInt32, values, lane) for values in (rows, points.ray_count(extra, rows)))
            estimate = tracer.trace(rows, estimate, extra, accuracy.most - first, points.steps(rows))
    lit, base, specular_lit, specular_base, bounced = light_filter.smooth(points.sum_estimate(estimate), bounced)
    share = dr.select((base > 0) & (lit != base), lit / base, 1)  # a GPU divides a number by itself to almost 1
    light = mi.Color3f(*[v + dr.zeros(mi.Float, dr.width(needed)) for v in light])
    dr.eval(light, share, specular_lit, specular_base)
    dr.scatter(light, share, index)
    if dr.width(special):
        own, pixels = gathered(here, special), dr.gather(mi.UInt32, index, special)
        part, specular_lit, specular_base = (
            dr.gather(type(v), v, special) for v in (share, specular_lit, specular_base)
        )
        dr.eval(own, part, specular_lit, specular_base)
        # If no ray came from the directions of the lobe, the arriving share of all light applies. (dr.mean would write
        # the width of the array into the kernel.)
        mirrored *= dr.select(specular_base > 0, specular_lit / specular_base, dr.sum(part) / 3) * (dr.pi / reference)
        relit = part * open_light / reference
        mirrored -= dr.select(own.relit, relit * tent, 0)
        dr.eval(relit, mirrored)
        if bounced is not None:
            # Added after the exchange of mirror images: the tent's mirror image also represents that of the
            # surroundings.
            relit += dr.gather(mi.Color3f, bounced, special)
        dr.scatter(light, relit, pixels, own.relit)
        highlight = mi.Color3f(dr.zeros(mi.Float, dr.width(needed)))
        dr.scatter(highlight, mirrored, pixels)
    if plane is not None:
        dr.eval(light)
        light = between_samples(light, plane.coarse, view)
    return light, highlight


def _open_light(emitters: Emitters, points: LightPoints, special: Any) -> tuple[Any, Any, Any]:
    """Return unoccluded means over the points of pixels: irradiance, mirrored light, and mirrored tent."""
    rows = points.rows(special)
    own = gathered(points.surface, rows)
    dr.eval(own)
    count = dr.width(rows)
    columns: Any = [dr.zeros(mi.Color3f, count), dr.zeros(mi.Color3f, count), mirrored_tent(own)]
    columns.append(dr.select(own.valid, mi.Float(1), 0))
    dr.eval(columns)
    for shiny in (False, True):
        which = dr.compress((own.specular > 0) == mi.Bool(shiny))
        if dr.width(which):
            some = gathered(own, which)
            dr.eval(some)
            found = emitters.open_light(
                receiver(some.position, some.normal), Lobe.of(some) if shiny else None, some.valid
            )
            dr.eval(found)
            for column, values in zip(columns, found, strict=False):
                dr.scatter(column, values, which)
    dr.eval(columns)
    means = []
    for column in columns:
        by_row = dr.zeros(type(column), dr.width(points.owner))
        dr.scatter(by_row, dr.select(own.valid, column, 0), rows)
        dr.eval(by_row)
        means.append(dr.gather(type(column), points.sum_by_pixel(by_row), special))
    *sums, count = means
    light, mirrored, tent = (total / dr.maximum(count, 1) for total in sums)
    dr.eval(light, mirrored, tent)
    return light, mirrored, tent


@dataclass(frozen=True, eq=False)
class _CoarseLight:
    """First rays of the traced pixels of coarse tiles, see :mod:`mitsplat.renderer.light.light_planes`.

    Attributes:
        coarse: True for pixels in such a tile, by pixel of the image.
        lattice: True for traced pixels of such tiles, by pixel of the image.
        pixel: Numbers of these traced pixels.
        estimate: Estimate at these pixels.
    """

    coarse: Any
    lattice: Any
    pixel: Any
    estimate: Estimate

    @classmethod
    def of(
        cls, planes: Planes, visible: VisibleSurfaces, emitters: Emitters, seed: int, accuracy: Accuracy
    ) -> _CoarseLight | None:
        """Trace the samples of planes and keep the evenly lit tiles; return None if there are none."""
        if not planes.count:
            return None
        pixel, view = planes.samples(), visible.view
        lattice = dr.full(mi.Bool, False, view.width * view.height)
        dr.scatter(lattice, mi.Bool(True), pixel)
        surface = visible.at(pixel)
        dr.eval(surface, lattice)
        tracer = _Tracer(emitters, visible.proxies, surface, pixel, view, seed, lattice)
        count, rays, steps = dr.width(pixel), accuracy.dense, (mi.UInt32(0), mi.UInt32(1))
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


def _doublings(wanted: Any, rays: int, most: int) -> tuple[Any, Any]:
    """Return the number of doublings of ``rays`` up to ``wanted`` or ``most``, and the number of additional rays."""
    level, extra = (dr.zeros(mi.UInt32, dr.width(wanted)) for _ in range(2))
    while rays < most:
        more, step = wanted > dr.opaque(mi.Float, rays), min(rays, most - rays)
        level += dr.select(more, mi.UInt32(1), 0)
        extra += dr.select(more, dr.opaque(mi.UInt32, step), 0)
        rays += step
    dr.eval(level, extra)
    return level, extra


def _blockwise(place: Any, view: CameraView) -> Any:
    """Return the values of an image ``place``, except NOWHERE, in the order of :func:`block_order`."""
    pixel, inside = block_order(view)
    ordered = dr.select(inside, dr.gather(mi.UInt32, place, pixel), UNTRACED)
    return dr.gather(mi.UInt32, ordered, dr.compress(ordered != UNTRACED))


@dataclass(frozen=True, eq=False)
class _Tracer:
    """Shadow rays from visible points.

    Attributes:
        surface: The points.
        pixel: Number of the image's pixel of each point.
        lattice: True for traced pixels of coarse tiles, by pixel of the image; None if there are no coarse tiles.
    """

    emitters: Emitters
    proxies: Proxies
    surface: LitSurface
    pixel: Any
    view: CameraView
    seed: int
    lattice: Any = None

    def search(self, captured: Any) -> ShadowTiles:
        """Estimate by tiles the light that dynamic objects occlude, with one ray per captured point of all pixels.

        The four blocks of a 2 x 2 group have different points; otherwise a shadow too small for the points of one block
        would be missed in all of them. The light without dynamic objects is only a divisor, for which a quarter of the
        rays is sufficient. The other rays test static occluders only if a dynamic object occludes them as well.
        """
        proxies, width = self.proxies, self.view.width
        pixel, inside = block_order(self.view)
        origin, normal, offset, instance = _packed_rays(self.surface, captured, pixel)
        x, y = pixel % width, pixel // width
        number = self._start(pixel) + parity(x // BLOCK, y // BLOCK) * STRIDE
        active = inside & (offset > 0)
        beam = self.emitters.sample(receiver(origin, normal), _sequence(number, ROBERTS), active)
        ray, key = _shadow_ray(origin, beam, offset), pixel * RECURRENCE[0] + number
        active &= dr.sum(beam.irradiance) > 0
        blocked, counts, share = mi.Bool(False), active, 1
        for occluder_scene in proxies.shadow_casters:
            blocked |= occluder_scene.occluded(ray, instance, key, active & ~blocked)
            if proxies.separate_kernels:
                dr.eval(blocked)
        if proxies.static is not None:
            one_of_four = ((x | y) & 1) == 0
            stopped = proxies.static.occluded(ray, instance, key, active & (blocked | one_of_four))
            blocked &= ~stopped
            counts, share = active & one_of_four & ~stopped, 4
        arriving = dr.select(counts, beam.irradiance * share, 0)
        lost = dr.select(blocked, beam.irradiance, 0)
        dr.eval(arriving, lost)
        return ShadowTiles.of(arriving, lost, self.view)

    def trace(
        self, places: Any, before: Estimate, rays: Any, most: int, steps: tuple[Any, Any], *, matt: bool = False
    ) -> Estimate:
        """Add ``rays`` more rays to an estimate at ``places``.

        Args:
            places: Indices of the points.
            before: Estimate so far.
            rays: Number of additional rays per point.
            most: Upper limit of ``rays``.
            steps: First number in the sequence of the pixel, and the step to the next number, by point.
            matt: True if no point mirrors light, so that the highlight sums are skipped.
        """
        separate_kernels = self.proxies.separate_kernels
        if separate_kernels and most > WORD_BITS:
            for begin in range(0, most, WORD_BITS):
                part = dr.minimum(dr.maximum(rays, begin) - begin, WORD_BITS)
                before = self.trace(places, before, part, min(WORD_BITS, most - begin), steps, matt=matt)
            return before
        surface = gathered(self.surface, places)
        pixel = dr.gather(mi.UInt32, self.pixel, places)
        begin, step = steps
        done = mi.UInt32(dr.gather(mi.Float, before.rays, places))
        start, step = self._start(pixel) + (begin + done * step) * STRIDE, step * STRIDE
        si = receiver(surface.position, surface.normal)
        origin = _origin(surface)
        lobe = Lobe.of(surface)
        static, occluder_scenes = self.proxies.static, self.proxies.occluder_scenes
        known: list[Any] = []

        def send(i: Any) -> tuple[Beam, Any, Any, list[Any]]:
            """Return ray ``i`` of every point: beam, active flag, sequence number, and known occlusion flags."""
            number = start + i * step
            beam = self.emitters.sample(si, _sequence(number), surface.valid)
            active = surface.valid & (dr.sum(beam.irradiance) > 0)
            return beam, active, number, [(word >> i & 1) != 0 for word in known]

        def occluded(occluder_scene: OccluderScene, beam: Beam, number: Any, active: Any) -> Any:
            ray = _shadow_ray(origin, beam, surface.offset)
            return occluder_scene.occluded(ray, surface.instance, pixel * RECURRENCE[0] + number, active)

        def note(i: Any, word: Any) -> tuple[Any, Any]:
            beam, free, number, stopped = send(i)
            for each in stopped:
                free = free & ~each
            return i + 1, word | dr.select(
                occluded(occluder_scenes[len(known)], beam, number, free), mi.UInt32(1) << i, 0
            )

        if separate_kernels:  # one bit per ray and scene except the last, one kernel each
            for _ in occluder_scenes[1:]:
                nothing = dr.zeros(mi.UInt32, dr.width(places))
                _, word = dr.while_loop((nothing, mi.UInt32(nothing)), lambda i, _: i < rays, note, label="stopped")
                dr.eval(word)
                known.append(word)

        def body(i: Any, lit: Any, base: Any, specular_lit: Any, specular_base: Any, squares: Any) -> tuple[Any, ...]:
            beam, active, number, stopped = send(i)
            static_light = free = active
            for each, occluder_scene in enumerate(occluder_scenes):
                free = free & ~(stopped[each] if each < len(stopped) else occluded(occluder_scene, beam, number, free))
                if occluder_scene is static:
                    static_light = free
            light, unshadowed = (dr.select(where, beam.irradiance, 0) for where in (free, static_light))
            compared = dr.select(surface.relit, dr.select(active, beam.irradiance, 0), unshadowed)
            lit += light
            base += compared
            if not matt:
                reflectance = lobe.reflectance(beam.direction)
                specular_lit += dr.sum(light) * reflectance
                specular_base += dr.select(active, dr.sum(beam.irradiance) * reflectance, 0)
            squares += dr.square(dr.sum(compared))
            return i + 1, lit, base, specular_lit, specular_base, squares

        sums = [dr.gather(type(v), v, places) for v in before.sums]
        state = dr.zeros(mi.UInt32, dr.width(places)), *sums
        _, *sums = dr.while_loop(state, lambda i, *_: i < rays, body, label="light")
        return before.updated(places, *sums, dr.gather(mi.Float, before.rays, places) + mi.Float(rays))

    def bounce(self, reflectors: Reflectors) -> tuple[Any, Any]:
        """Return the reflected irradiance (Color3f) over that of display white, and a flag (Float) where it is known.

        Relit points of objects use a few rays each, so that their neighbours must be averaged. On visible meshes, one
        pixel in each cell of 2 x 2 is traced, and the result is already a mean over many cells. This mean is necessary,
        because few rays hit small bright regions such as a wall near a lamp.
        """
        surface, view = self.surface, self.view
        cells = replace(view, width=-(-view.width // 2), height=-(-view.height // 2))
        x, y = self.pixel % view.width, self.pixel // view.width
        column, row = x >> 1, y >> 1
        selected = ((x & 1) == (row & 1)) & (
            (y & 1) == ((column + row) & 1)
        )  # equally often in each row and in each column
        if self.lattice is not None:
            selected |= dr.gather(mi.Bool, self.lattice, self.pixel)
        thing, count = surface.instance > 0, dr.width(self.pixel)
        total, known = mi.Color3f(dr.zeros(mi.Float, count)), dr.zeros(mi.Float, count)
        for on_mesh, which, rays in ((False, thing, BOUNCE_RAYS), (True, ~thing & selected, MESH_RAYS)):
            places = dr.compress(surface.relit & which)
            if not dr.width(places):
                continue
            own = gathered(surface, places)
            start = self._start(dr.gather(mi.UInt32, self.pixel, places))
            origin, normal = mi.Point3f(_origin(own)), mi.Vector3f(own.normal)
            dr.eval(own, start, origin, normal)
            found = reflectors.irradiance(origin, normal, start, rays, _two_points)
            if on_mesh:
                cell = dr.gather(mi.UInt32, row * cells.width + column, places)
                for stride in (1, RADIUS):
                    found = LightFilter(own, cells, cell, stride=stride).average([*found])
            dr.scatter(total, mi.Color3f(*found), places)
            dr.scatter(known, mi.Float(1), places)
            dr.eval(total, known)
        return total, known

    def _start(self, pixel: Any) -> Any:
        start = dr.opaque(mi.UInt32, self.seed * 2654435761 % (1 << 32))
        x, y = pixel % self.view.width, pixel // self.view.width
        if self.lattice is not None:
            # Traced neighbours are two pixels apart there.
            shift = dr.select(dr.gather(mi.Bool, self.lattice, pixel), mi.UInt32(1), 0)
            x, y = x >> shift, y >> shift
        return start + _bayer(x, y)


def _origin(surface: LitSurface) -> Any:
    """Return the origins of shadow rays: on the smooth surface of the proxy, and off the triangle itself."""
    return surface.position + surface.lift + surface.face * surface.offset


def _packed_rays(surface: LitSurface, selected: Any, pixel: Any) -> tuple[Any, Any, Any, Any]:
    """Return ray origins, normals, offsets and instances of pixels in any order, given the points of all pixels.

    The offset is 0 where ``selected`` is False. The values are packed, because separate fetches take half of the
    time.
    """
    offset = dr.select(selected, surface.offset, 0)
    rows = packed([*_origin(surface), *surface.normal, offset, surface.instance])
    row = dr.gather(mi.ArrayXf, rows, pixel, shape=(8, dr.width(pixel)))
    return mi.Point3f(*row[:3]), mi.Vector3f(*row[3:6]), row[6], row[7]


def _shadow_ray(origin: Any, beam: Any, offset: Any) -> Any:
    ray = mi.Ray3f(origin, beam.direction)
    ray.maxt = dr.maximum(beam.reach - 2 * offset, 0)
    return ray


def _sequence(i: Any, recurrence: tuple[int, int] = RECURRENCE) -> Any:
    """Return point ``i`` of a low-discrepancy sequence with 24 bits of precision for every ``i``."""
    return mi.Point2f(*[mi.Float((i * step) >> 8) * 2.0**-24 for step in recurrence])


def _two_points(i: Any) -> tuple[Any, Any]:
    return _sequence(i), _sequence(i, ROBERTS)


def _bayer(x: Any, y: Any) -> Any:
    """Return the rank of a pixel in an 8 x 8 ordered-dither matrix: neighbours take distant points of the sequence."""
    result = mi.UInt32(0)
    for bit in range(3):
        a, b = (x >> bit) & 1, (y >> bit) & 1
        result |= ((a ^ b) << (5 - 2 * bit)) | (b << (4 - 2 * bit))
    return result
