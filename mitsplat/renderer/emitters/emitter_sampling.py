"""Sampling of emitters: emitter, point on it, and the irradiance of the sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.renderer.emitters.rectangle_lights import Rectangles
from mitsplat.renderer.emitters.sky_irradiance import SkyIrradiance
from mitsplat.renderer.materials.principled import lattice_point
from mitsplat.renderer.rays.device_arrays import wrapped

SURVEY_LATTICE = (233, 144)
OPEN_LATTICE = (34, 21)
ROUGH_LATTICE = (8, 5)
SPHERE_LATTICE = (4181, 2584)
"""Number of points and generator of Fibonacci lattices. Consecutive Fibonacci numbers give the best two-dimensional
lattices (Niederreiter 1992, section 5.3).
"""

SMALL_LATTICES = ((2, 1), (3, 2), (5, 3), (8, 5), (13, 8), (21, 13))
"""Lattices of each emitter, if several share the points of one lattice."""

MAX_SHARING = 7
"""Number of emitters beyond which their lattices do not become smaller."""

ROUNDING = 4 / 3
"""Factor by which the points of an emitter are divided before they are rounded up to one of :data:`SMALL_LATTICES`. Two
to seven emitters then share 26 to 40 points for a lattice of 34.
"""

UNIFORM_SHARE = 0.1
"""Share of the rays that is divided equally among all emitters, independent of their light at the reference point."""

_COUNT_STEP = 4
"""Emitter counts are rounded up to multiples of this number, so that one kernel serves several counts."""


def receiver(position: mi.Point3f, normal: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """Return a surface interaction to sample light for."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(position))
    si.p = position
    si.n = mi.Normal3f(normal)
    si.sh_frame = mi.Frame3f(si.n)
    return si


@dataclass(frozen=True, eq=False)
class Beam:
    """Sampled direction towards light.

    Attributes:
        direction: Unit vector towards the light.
        reach: Largest distance of an occluder [m]: the distance to the emitter, or the sky reach.
        irradiance: Unoccluded irradiance estimate (Color3f) of this single sample.
        density: Sampling density of the direction [1/sr], infinite for point-shaped and parallel light.
        sky: True if the light is that of the sky.
    """

    direction: mi.Vector3f
    reach: mi.Float
    irradiance: mi.Color3f
    density: mi.Float
    sky: mi.Bool


class Emitters:
    """Emitters of a scene, sampled in proportion to the light that each sends to a reference point.

    A sky of one colour is sampled by the cosine to the normal, so that only occlusion causes noise. An environment map
    is sampled half by the cosine and half by its radiance, with the balance heuristic (Veach 1997, section 9.2.2).

    Attributes:
        fluence: Light of all directions at the reference point, mean over channels [W/m^2].
        sky_reach: Distance beyond which nothing occludes the sky [m].
        pointers: All emitters.
        sky: Index of the sky among them; None without a sky.
        even_sky: True if the sky has one colour.
        sky_colour: This colour; None for another sky.
        infinite: 1 for emitters at infinite distance, else 0.
        any_without_extent: True if an emitter is a point or has one direction. All of its rays through regular points
            can hit edges of a proxy.
        choice: Probabilities of the emitters in :meth:`sample`.
        local: Indices of the emitters other than the sky, on the host.
        rectangles: Area lights in closed form; None unless all emitters besides the sky are rectangles.
    """

    def __init__(self, scene: mi.Scene, reference: Sequence[float], sky_reach: float = np.inf) -> None:
        """Collect the emitters of a scene.

        Args:
            scene: Mitsuba scene with at least one emitter.
            reference: Point at which the emitters are compared [m].
            sky_reach: Distance beyond which nothing occludes the sky [m].
        """
        self.sky_reach = dr.opaque(mi.Float, sky_reach)
        emitters = scene.emitters()
        self.pointers = scene.emitters_dr()
        skies = [i for i, e in enumerate(emitters) if _is_sky(e)]
        sky = skies[0] if skies else None
        self.even_sky = sky is not None and emitters[sky].class_name() == "ConstantBackgroundEmitter"
        # The sky's index is opaque: as a literal, it would change the kernel with the number of lights.
        self.sky = None if sky is None else mi.UInt32(0) if len(emitters) == 1 else dr.opaque(mi.UInt32, sky)
        point = mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in reference])
        fluence = self._survey(len(emitters), point)
        self.fluence = dr.opaque(mi.Float, fluence.sum() / 3)
        share = UNIFORM_SHARE / len(emitters) + (1 - UNIFORM_SHARE) * fluence / max(fluence.sum(), 1e-30)
        self.choice = _DiscreteDistribution(share)
        self.local = np.delete(np.arange(len(emitters), dtype=np.uint32), skies)
        self.rectangles = Rectangles.of(emitters, sky)
        self.any_without_extent = any(mi.has_flag(e.flags(), mi.EmitterFlags.Delta) for e in emitters)
        infinite = [mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in emitters]
        self.infinite = mi.UInt32([int(v) for v in infinite])
        self.sky_colour = None
        if self.even_sky:
            pointer = dr.gather(mi.EmitterPtr, self.pointers, self.sky)
            self.sky_colour = self._sky_radiance(receiver(point, mi.Normal3f(0, 0, 1)), mi.Vector3f(0, 0, 1), pointer)
            dr.make_opaque(self.sky_colour)
        dr.make_opaque(self.infinite)
        numbers = np.array(dr.reinterpret_array(mi.UInt32, self.pointers))
        index_of = np.zeros(int(numbers.max()) + 1, np.uint32)
        index_of[numbers] = np.arange(len(emitters))
        self._index_of = wrapped(mi.UInt32, index_of)

    def _survey(self, count: int, point: mi.Point3f) -> Float64Array:
        """Return the fluence (count,) of each emitter at a point, sum over channels [W/m^2].

        That of a lamp at the point itself is infinite, and replaced by that of all others together.
        """
        i = dr.arange(mi.UInt32, count * SURVEY_LATTICE[0])
        emitter = dr.gather(mi.EmitterPtr, self.pointers, i // SURVEY_LATTICE[0])
        sample = lattice_point(i % SURVEY_LATTICE[0], SURVEY_LATTICE)
        _, radiance = emitter.sample_direction(receiver(point, mi.Normal3f(0, 0, 1)), sample, True)
        fluence = np.array(dr.sum(radiance)).reshape(count, -1).mean(axis=1)
        finite = np.isfinite(fluence)
        return np.where(finite, fluence, fluence[finite].sum() or 1.0)

    def sample(self, si: mi.SurfaceInteraction3f, point: mi.Point2f, active: mi.Bool) -> Beam:
        """Sample one random direction from ``si`` for each point of the unit square."""
        index, x, chance = self.choice.sample(point.x)
        is_sky = mi.Bool(False) if self.sky is None else index == self.sky
        emitter = dr.gather(mi.EmitterPtr, self.pointers, index, active)
        by_cosine = is_sky if self.even_sky else is_sky & (x < 0.5)
        if self.sky is not None and not self.even_sky:
            x = dr.select(is_sky, dr.select(by_cosine, 2 * x, 2 * x - 1), x)
        direction, distance, radiance, density = self._towards(si, index, mi.Point2f(x, point.y), active & ~by_cosine)
        cosine = dr.maximum(dr.dot(si.sh_frame.n, direction), 0)
        irradiance = radiance * cosine
        if self.sky is not None:
            upward = si.sh_frame.to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(x, point.y)))
            direction = dr.select(by_cosine, upward, direction)
            cosine = dr.maximum(dr.dot(si.sh_frame.n, direction), 0)
            sky, sky_density = self._sky_towards(si, direction, emitter, is_sky & active)
            irradiance = dr.select(is_sky, dr.select(sky_density > 0, sky * (cosine / sky_density), 0), irradiance)
            density = dr.select(is_sky, sky_density, density)
        # Mitsuba derives the distance of infinite lights from the extent of visible meshes, which excludes proxies.
        infinite = dr.gather(mi.UInt32, self.infinite, index, active) > 0
        reach = dr.select(is_sky, self.sky_reach, dr.select(infinite, dr.inf, distance))
        return Beam(direction, reach, irradiance / chance, density * chance, is_sky)

    def emission(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """Return the radiance (Color3f) of emitters along rays from ``si``, and the density of :meth:`sample` there.

        Lamps are visible up to the rays' ``maxt``, and the sky behind them. Point-shaped and parallel lights are not.
        """
        lamp, number, radiance, density = self._lamps_along(scene, si, ray, active)
        radiance = dr.select(lamp, radiance, 0)
        density = dr.select(lamp, density * dr.gather(mi.Float, self.choice.chances, number, lamp), 0)
        if self.sky is not None:
            pointer = dr.gather(mi.EmitterPtr, self.pointers, self.sky)
            open_sky = active & ~lamp & (ray.maxt == dr.inf)
            sky, sky_density = self._sky_towards(si, ray.d, pointer, open_sky)
            radiance = dr.select(open_sky, sky, radiance)
            chance = dr.gather(mi.Float, self.choice.chances, self.sky)
            density = dr.select(open_sky, sky_density * chance, density)
        return radiance, density

    def sky_radiance(
        self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, emitter: mi.EmitterPtr, active: mi.Bool
    ) -> mi.Color3f:
        """Return the radiance (Color3f) of the sky ``emitter`` in unit directions from ``si``."""
        return self.sky_colour if self.even_sky else self._sky_radiance(si, direction, emitter, active)

    def _lamps_along(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[mi.Bool, mi.UInt32, mi.Color3f, mi.Float]:
        """Return True where rays hit a lamp before ``maxt``, its index, its radiance, and the density of its samples.

        The back of a lamp lets rays pass.
        """
        if self.rectangles is not None:
            number, distance, radiance, density = self.rectangles.along(ray)
            return active & (distance < ray.maxt), number, radiance, density
        hit = scene.ray_intersect_preliminary(ray, active=active)
        lamp = active & hit.is_valid() & hit.shape.is_emitter()
        at = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, lamp)
        emitter = at.shape.emitter()
        towards = mi.DirectionSample3f(scene, at, si)
        number = dr.gather(mi.UInt32, self._index_of, dr.reinterpret_array(mi.UInt32, emitter), lamp)
        radiance = emitter.eval(at, lamp)
        return lamp & (dr.max(radiance) > 0), number, radiance, emitter.pdf_direction(si, towards, lamp)

    def _sky_towards(
        self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, emitter: mi.EmitterPtr, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """Return radiance (Color3f) and sampling density of the sky in unit directions."""
        density = dr.maximum(dr.dot(si.sh_frame.n, direction), 0) * dr.inv_pi
        if not self.even_sky:
            towards = dr.zeros(mi.DirectionSample3f, dr.width(direction))
            towards.d = direction
            density = 0.5 * (density + emitter.pdf_direction(si, towards, active))
        return self.sky_radiance(si, direction, emitter, active), density

    def _towards(
        self, si: mi.SurfaceInteraction3f, index: mi.UInt32, point: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float, mi.Color3f, mi.Float]:
        """Return unit vector and distance [m] to points of emitters, radiance over density, and the density [1/sr]."""
        if self.rectangles is not None and (self.sky is None or self.even_sky):
            return self.rectangles.towards(si.p, index, point)
        emitter = dr.gather(mi.EmitterPtr, self.pointers, index, active)
        sample, radiance = emitter.sample_direction(si, point, active)
        density = dr.select(sample.delta, dr.inf, sample.pdf)
        return mi.Vector3f(sample.d), sample.dist, dr.select(sample.pdf > 0, radiance, 0), density

    @staticmethod
    def _sky_radiance(
        si: mi.SurfaceInteraction3f, direction: mi.Vector3f, emitter: mi.EmitterPtr, active: mi.Bool = True
    ) -> mi.Color3f:
        outside = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        outside.p = si.p
        outside.wi = -direction
        return mi.Color3f(emitter.eval(outside, active))

    def unoccluded_irradiance(
        self, si: mi.SurfaceInteraction3f, active: mi.Bool, lattice: tuple[int, int] = OPEN_LATTICE
    ) -> mi.Color3f:
        """Compute the unoccluded irradiance (Color3f), in closed form if the emitters are rectangles.

        Otherwise it is the light of fixed points of all emitters. Emitters share about as many points as a ``lattice``
        has, but each has at least a seventh of them. Emitters are not chosen by their light at the reference point,
        because one that is near the place, but far from that point, would be missed or counted too often.
        """
        total = mi.Color3f(0)
        if self.rectangles is not None:
            total = self.rectangles.irradiance(si.p, mi.Vector3f(si.sh_frame.n), active)
        elif len(self.local):
            least = lattice[0] / min(MAX_SHARING, ROUNDING * len(self.local))
            number, generator = next((small for small in SMALL_LATTICES if small[0] >= least), lattice)
            i = np.arange(number)
            # Tables are faster than divisions in the loop, and do not change the kernel with the number of lamps.
            indices = wrapped(mi.UInt32, np.repeat(self.local, number))
            table = np.stack([(i + 0.5) / number, (i * generator % number + 0.5) / number]).astype(np.float32)
            x, y = (wrapped(mi.Float, np.tile(row, len(self.local))) for row in table)
            rounds = dr.opaque(mi.UInt32, dr.width(indices))

            def add(i: mi.UInt32, total: mi.Color3f) -> tuple[mi.UInt32, mi.Color3f]:
                index = dr.gather(mi.UInt32, indices, i, active)
                point = mi.Point2f(dr.gather(mi.Float, x, i, active), dr.gather(mi.Float, y, i, active))
                direction, _, radiance, _ = self._towards(si, index, point, active)
                cosine = dr.maximum(dr.dot(si.sh_frame.n, direction), 0)
                return i + 1, total + dr.select(active, radiance * cosine, 0)

            state = dr.zeros(mi.UInt32, dr.width(si.p)), dr.zeros(mi.Color3f, dr.width(si.p))
            _, total = dr.while_loop(state, lambda i, _: active & (i < rounds), add, label="open light")
            total /= dr.opaque(mi.Float, number)
        if self.sky is not None:
            total += dr.pi * self.sky_colour if self.even_sky else self._sky_irradiance.at(si.n, active)
        return total

    @cached_property
    def _sky_irradiance(self) -> SkyIrradiance:
        """Irradiance of the sky by normal."""
        return sky_irradiance(dr.gather(mi.EmitterPtr, self.pointers, self.sky))


class _DiscreteDistribution:
    """Discrete distribution over a few items."""

    def __init__(self, share: Float64Array) -> None:
        """Set the probabilities in proportion to ``share`` (N,)."""
        chance = share / share.sum()
        # Padding with infinite limits lets one kernel serve two to four items, another five to eight, and so on.
        ends = np.cumsum(chance)[:-1]
        if len(chance) > 1:
            ends = np.concatenate([ends, np.full(-len(chance) % _COUNT_STEP, np.inf)])
        self.ends = [dr.opaque(mi.Float, float(end)) for end in ends]
        self.starts = wrapped(mi.Float, np.concatenate([[0], np.cumsum(chance)[:-1]]).astype(np.float32))
        self.chances = wrapped(mi.Float, chance.astype(np.float32))
        dr.make_opaque(self.starts, self.chances)

    def sample(self, x: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Sample an index from a number in [0, 1).

        Returns:
            Index, the remainder of the number rescaled to [0, 1), and the probability of the index.
        """
        index = sum((dr.select(x >= end, mi.UInt32(1), mi.UInt32(0)) for end in self.ends), mi.UInt32(0))
        chance = dr.gather(mi.Float, self.chances, index)
        left = (x - dr.gather(mi.Float, self.starts, index)) / chance
        return index, dr.clip(left, 0, 1 - 2.0**-24), chance


def _is_sky(emitter: mi.Emitter) -> bool:
    flags = emitter.flags()
    infinite = mi.has_flag(flags, mi.EmitterFlags.Infinite)
    return bool(infinite and not mi.has_flag(flags, mi.EmitterFlags.DeltaDirection))


def sky_irradiance(emitter: mi.EmitterPtr) -> SkyIrradiance:
    """Compute the irradiance of an infinite emitter for every orientation, sampled in proportion to its radiance."""
    point = lattice_point(dr.arange(mi.UInt32, SPHERE_LATTICE[0]), SPHERE_LATTICE)
    sample, radiance = emitter.sample_direction(receiver(mi.Point3f(0), mi.Vector3f(0, 0, 1)), point, True)
    return SkyIrradiance(sample.d, radiance)


def reference_irradiance(scene: mi.Scene, point: Sequence[float]) -> mi.Color3f:
    """Compute the unoccluded irradiance (Color3f) of the scene's emitters on a surface element that faces up.

    Where almost no light reaches that element, the result is the mean over all orientations (a quarter of the fluence).
    """
    i = dr.arange(mi.UInt32, SPHERE_LATTICE[0])
    si = receiver(mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in point]), mi.Vector3f(0, 0, 1))
    sample, radiance = scene.sample_emitter_direction(si, lattice_point(i, SPHERE_LATTICE), False)
    irradiance = mi.Color3f(*[dr.mean(c) for c in radiance * dr.maximum(dr.dot(mi.Vector3f(si.n), sample.d), 0)])
    mean = mi.Color3f(*[0.25 * dr.mean(c) for c in radiance])
    return dr.maximum(dr.select(irradiance > 1e-3 * mean, irradiance, mean), 1e-12)
