"""Pixels whose light is traced: their shadow rays and reflection rays, and the combination of all light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.bounce import Bounce
from mitsplat.renderer.light.light_estimate import Estimate, LightMeans
from mitsplat.renderer.light.light_filter import UNTRACED, LightFilter
from mitsplat.renderer.light.light_planes import CoarseLight
from mitsplat.renderer.light.light_points import LightPoints, bent_pixels, filtered_lobes
from mitsplat.renderer.light.light_tiles import block_order
from mitsplat.renderer.light.lighting import Lighting
from mitsplat.renderer.light.lit_surface import LitSurface
from mitsplat.renderer.light.reflections import Reflections, ReflectionTracer, averaged_reflections
from mitsplat.renderer.light.shadow_rays import ShadowTracer
from mitsplat.renderer.light.unoccluded_light import UnoccludedLight
from mitsplat.renderer.materials.principled import diffuse_albedo, mirrored_uniform, typical_brightness
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered
from mitsplat.renderer.splatting.sorting import stable_order

FIRST_REFLECTIONS = 2, 6
"""Reflection rays per pixel of a dielectric and of a metal before the error estimate."""

FIRST_ON_BENDS = 12
"""The same for a pixel of a metal with several sample points.

Few of its neighbours mirror similar directions, so that its own rays determine the variance. With one ray per point,
they often agree by chance: if all four see a contact shadow, the pixel remains black.
"""

LEVEL_BITS = 4
"""Bits of the number of doublings; 2^15 times the first rays exceeds every setting."""


@dataclass(frozen=True, eq=False)
class TracedPixels:
    """Pixels whose light is traced.

    Attributes:
        lighting: Input of all stages.
        index: Numbers of the pixels in the image.
        here: Surface points at the pixel centres.
        light_filter: Filter over these pixels.
        points: Sample points of the pixels.
        order: Places of the pixels in tracing order.
        coarse: Traced light on planes; None if there is none.
    """

    lighting: Lighting
    index: mi.UInt32
    here: LitSurface
    light_filter: LightFilter
    points: LightPoints
    order: mi.UInt32
    coarse: CoarseLight | None

    @classmethod
    def of(cls, lighting: Lighting, index: mi.UInt32, coarse: CoarseLight | None) -> TracedPixels:
        """Place the sample points of the pixels ``index``."""
        visible, view = lighting.visible, lighting.view
        here = visible.at(index)
        dr.eval(here)
        light_filter = LightFilter(here, view, index, coarse and coarse.coarse)
        bent = bent_pixels(here, index, light_filter.place, view)
        here = filtered_lobes(here, index, light_filter.place, view)
        dr.eval(here)
        order = _in_blocks(light_filter.place, view)
        points = LightPoints.of(visible, here, bent, index, order)
        return cls(lighting, index, here, light_filter, points, order, coarse)

    @cached_property
    def glossy(self) -> mi.UInt32:
        """Places of the pixels that mirror light."""
        return dr.compress(self.here.glossy & self.here.valid)

    @cached_property
    def mirror_filter(self) -> LightFilter:
        """Filter over the glossy pixels."""
        own = gathered(self.here, self.glossy)
        dr.eval(own)
        return LightFilter(own, self.lighting.view, dr.gather(mi.UInt32, self.index, self.glossy))

    @cached_property
    def mirrored(self) -> mi.Vector3f:
        """Mean over the sample points of the directions that the glossy pixels mirror."""
        surface = self.points.surface
        mirrored = 2 * dr.dot(surface.normal, surface.to_camera) * surface.normal - surface.to_camera
        rows = dr.arange(mi.UInt32, dr.width(self.points.owner))
        return self.points.mean_by_pixel(mirrored, rows, surface.valid, self.glossy)

    def _rays_for_reflections(
        self, brightness: mi.Float, squares: mi.Float, rays: mi.Float, exposure: mi.Float
    ) -> mi.Float:
        """Return the wanted number of rays of the glossy pixels, given sums over the rays of all pixels."""
        brightness, squares, rays = (dr.gather(mi.Float, v, self.glossy) for v in (brightness, squares, rays))
        return self.mirror_filter.reflections_for(
            brightness, squares, rays, self.mirrored, self.lighting.accuracy.error, exposure
        )

    def _tracer(self, surface: LitSurface, pixel: mi.UInt32) -> ShadowTracer:
        lighting, lattice = self.lighting, self.coarse and self.coarse.lattice
        return ShadowTracer(lighting.emitters, lighting.proxies, surface, pixel, lighting.view, lighting.seed, lattice)

    def centre_tracer(self) -> ShadowTracer:
        """Return a tracer of rays from the pixel centres."""
        return self._tracer(self.here, self.index)

    @cached_property
    def _point_tracer(self) -> ShadowTracer:
        """Tracer of rays from the sample points."""
        return self._tracer(self.points.surface, dr.gather(mi.UInt32, self.index, self.points.owner))

    def trace_first_rays(self) -> Estimate:
        """Trace the same number of shadow rays from every pixel; those of coarse tiles have theirs already.

        The estimate of irradiance is the mean over rays of V(x, w) L(w) max(0, n.w) / p(w), see
        :meth:`ShadowTracer.trace`.
        """
        points, first = self.points, self.lighting.accuracy.first
        estimate, rest = Estimate.empty(dr.width(points.owner)), self.order
        if self.coarse is not None:
            places = dr.gather(mi.UInt32, self.light_filter.place, self.coarse.pixel)
            estimate = self.coarse.estimate.scattered(places, dr.width(points.owner))
            rest = dr.gather(mi.UInt32, self.order, dr.compress(dr.gather(mi.Float, estimate.rays, self.order) == 0))
        rows = points.rows(rest)
        if dr.width(rows):
            rays = points.ray_count(dr.opaque(mi.UInt32, first), rows)
            estimate = self._point_tracer.trace(rows, estimate, rays, first, points.steps(rows))
        return estimate

    def trace_further_rays(
        self, estimate: Estimate, sums: Estimate, level: mi.Float, others: mi.UInt32
    ) -> tuple[Estimate, mi.Float]:
        """Trace more rays from pixels whose light has not reached the wanted error.

        The number of rays is doubled until it suffices for the variance of the first rays, see
        :meth:`LightFilter.rays_for` and :meth:`LightFilter.reflections_for`. Pixels with equal numbers are traced
        together, so that no lane idles.

        Args:
            estimate: Estimate from the rays so far, by row of the sample points.
            sums: The same estimate, by pixel.
            level: Unoccluded light over white, by pixel.
            others: Number of pixels without traced light that show a surface.

        Returns:
            The estimate, and the factor of the exposure that :meth:`LightFilter.rays_for` assumes.
        """
        accuracy, points, order = self.lighting.accuracy, self.points, self.order
        if accuracy.error == 0:
            return estimate, mi.Float(1)
        first = accuracy.first
        wanted, exposure = self.light_filter.rays_for(sums, accuracy.error, level, others if accuracy.metered else None)
        if first >= accuracy.most:
            return estimate, exposure
        if dr.width(self.glossy):
            scale = dr.pi / dr.mean(self.lighting.white)
            brightness = typical_brightness(sums.tinted, sums.colourless) * scale
            squares = sums.mirrored_squares * dr.square(scale)
            for_lobe = self._rays_for_reflections(brightness, squares, sums.rays, exposure)
            for_lobe = dr.maximum(for_lobe, dr.gather(mi.Float, wanted, self.glossy))
            dr.eval(wanted, for_lobe)
            dr.scatter(wanted, for_lobe, self.glossy)
        spent = dr.full(mi.UInt32, first, dr.width(self.index))
        if self.coarse is not None:
            on_lattice = dr.gather(mi.Bool, self.coarse.lattice, self.index)
            spent = dr.select(on_lattice, dr.opaque(mi.UInt32, accuracy.dense), spent)
        dr.eval(spent)
        more = dr.gather(mi.Float, wanted, order) > mi.Float(dr.gather(mi.UInt32, spent, order))
        rows = points.rows(dr.gather(mi.UInt32, order, dr.compress(more)))
        if not dr.width(rows):
            return estimate, exposure
        owner = dr.gather(mi.UInt32, points.owner, rows)
        doublings, extra = _doublings(dr.gather(mi.Float, wanted, owner), first, accuracy.most)
        extra += dr.opaque(mi.UInt32, first) - dr.gather(mi.UInt32, spent, owner)
        lane = stable_order(doublings, LEVEL_BITS)
        rows, extra = (dr.gather(mi.UInt32, values, lane) for values in (rows, points.ray_count(extra, rows)))
        estimate = self._point_tracer.trace(rows, estimate, extra, accuracy.most - first, points.steps(rows))
        return estimate, exposure

    def combine(
        self, light: mi.Color3f, unoccluded: UnoccludedLight, means: LightMeans, bounced: Bounce | None
    ) -> mi.Color3f:
        """Return the light factor of all pixels from filtered sums, without reflections.

        With the arriving share s = lit / base, unoccluded irradiance E and metalness m:

            captured:    factor = s, or (lit + B_all) / (base + B_static) near objects
            relit:       factor = (1 - m) d (s E + B_all) / white

        d is :func:`mitsplat.renderer.materials.principled.diffuse_albedo` of glossy materials, otherwise 1.

        Sums over rays are averaged over neighbours before the division, so that points with little light do not turn
        black by chance (Heitz, Hill and McGuire 2018). :mod:`mitsplat.renderer.light.light` explains the symbols.

        Args:
            light: Light factor (Color3f) of untraced pixels.
            unoccluded: Unoccluded light.
            means: Filtered light.
            bounced: Reflected light; None if it is not traced.
        """
        lit, base, white = means.lit, means.base, self.lighting.white
        if bounced is not None:
            lit, base = lit + bounced.captured[0] * white, base + bounced.captured[1] * white
        share = dr.select((base > 0) & (lit != base), lit / base, 1)  # a GPU divides a number by itself to almost 1
        light = mi.Color3f(*[channel + dr.zeros(mi.Float, self.lighting.pixels) for channel in light])
        dr.eval(light, share)
        dr.scatter(light, dr.select(self.here.relit, 0, share), self.index)
        place = unoccluded.place
        if dr.width(place):
            relit = dr.gather(mi.Color3f, share, place) * unoccluded.irradiance / white
            if means.bounced is not None:
                relit += dr.gather(mi.Color3f, means.bounced, place)
            relit *= self._diffuse_share(gathered(self.here, place))
            dr.eval(light, relit)
            dr.scatter(light, relit, dr.gather(mi.UInt32, self.index, place))
        return light

    @staticmethod
    def _diffuse_share(surface: LitSurface) -> mi.Float:
        """Return the factor of diffuse light: that of ``principled`` for glossy materials, otherwise 1."""
        albedo = diffuse_albedo(dr.dot(surface.normal, surface.to_camera), surface.roughness)
        return dr.select(surface.glossy & ~surface.captured, (1 - surface.metallic) * albedo, 1)

    def add_reflections(
        self, light: mi.Color3f, estimate: Estimate, exposure: mi.Float
    ) -> tuple[mi.Color3f, mi.Color3f]:
        """Add the specular lobes to the light factor of all pixels, and return it with the highlight (Color3f).

        Args:
            light: Light factor without reflections (Color3f).
            estimate: Sums over shadow rays, whose light in the lobe is added to that of the reflection rays.
            exposure: Factor of the exposure.
        """
        lighting, glossy, points = self.lighting, self.glossy, self.points
        if not dr.width(glossy):
            return light, mi.Color3f(0)
        tracer = ReflectionTracer(
            self._point_tracer, lighting.reflectors, points.steps(dr.arange(mi.UInt32, dr.width(points.owner)))
        )
        valid_share = dr.maximum(dr.gather(mi.Float, points.valid_share, glossy), 1e-3)
        sums = gathered(self._trace_reflections(tracer, exposure), glossy).of_valid(valid_share)
        estimate = gathered(estimate, glossy)
        weight = dr.pi / (lighting.white * (dr.maximum(estimate.rays, 1) * valid_share))
        tinted = estimate.tinted * weight + sums.tinted / sums.rays
        colourless = estimate.colourless * weight + sums.colourless / sums.rays
        tinted, colourless = averaged_reflections(self.mirror_filter, tinted, colourless, sums.variance, self.mirrored)
        own, pixels = self.mirror_filter.here, self.mirror_filter.index
        before = dr.gather(mi.Color3f, light, pixels)
        # Captured colours contain the mirror image of the uniform light.
        colourless -= before * dr.select(own.captured & own.relit, mirrored_uniform(own.lobe), 0)
        dr.eval(before, tinted, colourless)
        dr.scatter(light, before + tinted, pixels)
        highlight = mi.Color3f(dr.zeros(mi.Float, lighting.pixels))
        dr.scatter(highlight, colourless, pixels)
        dr.eval(light, highlight)
        return light, highlight

    def _trace_reflections(self, tracer: ReflectionTracer, exposure: mi.Float) -> Reflections:
        """Trace reflection rays at the glossy pixels and return their sums by pixel.

        A pixel gets more rays if its first rays have not reached the wanted error.
        """
        error, most, points = self.lighting.accuracy.error, self.lighting.accuracy.most, self.points
        total, glossy = Reflections.empty(dr.width(points.owner)), self.glossy

        def trace(places: mi.UInt32, by_pixel: mi.UInt32) -> None:
            rows = points.rows(places)
            rays = points.ray_count(dr.gather(mi.UInt32, by_pixel, dr.gather(mi.UInt32, points.owner, rows)), rows)
            total.add(rows, tracer.trace(rows, dr.gather(mi.Float, total.rays, rows), rays))

        for_dielectric, for_metal, on_bends = (
            dr.opaque(mi.UInt32, min(first, most) if error > 0 else most)
            for first in (*FIRST_REFLECTIONS, FIRST_ON_BENDS)
        )
        on_metal = dr.select(points.slot == UNTRACED, for_metal, on_bends)
        trace(glossy, dr.select(self.here.metallic > 0, on_metal, for_dielectric))
        sums = points.sums_by_pixel(total)
        if error > 0:
            brightness = typical_brightness(sums.tinted, sums.colourless)
            wanted = self._rays_for_reflections(brightness, sums.squares, sums.rays, exposure)
            missing = mi.UInt32(dr.ceil(dr.clip(wanted - dr.gather(mi.Float, sums.rays, glossy), 0, most)))
            more = dr.zeros(mi.UInt32, points.count)
            dr.eval(missing)
            dr.scatter(more, missing, glossy)
            places = dr.gather(mi.UInt32, glossy, dr.compress(missing > 0))
            if dr.width(places):
                trace(places, more)
                sums = points.sums_by_pixel(total)
        return sums


def _doublings(wanted: mi.Float, rays: int, most: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Return the number of doublings of ``rays`` up to ``wanted`` or ``most``, and the number of additional rays."""
    level, extra = (dr.zeros(mi.UInt32, dr.width(wanted)) for _ in range(2))
    while rays < most:
        more, step = wanted > dr.opaque(mi.Float, rays), min(rays, most - rays)
        level += dr.select(more, mi.UInt32(1), 0)
        extra += dr.select(more, dr.opaque(mi.UInt32, step), 0)
        rays += step
    dr.eval(level, extra)
    return level, extra


def _in_blocks(place: mi.UInt32, view: CameraView) -> mi.UInt32:
    """Return the values of an image ``place``, except UNTRACED, in the order of :func:`block_order`."""
    pixel, inside = block_order(view)
    ordered = dr.select(inside, dr.gather(mi.UInt32, place, pixel), UNTRACED)
    return dr.gather(mi.UInt32, ordered, dr.compress(ordered != UNTRACED))
