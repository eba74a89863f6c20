"""Traced light on splats: irradiance with and without dynamic occluders, and reflections.

A splat stores the radiance that the camera saw, shadows included. Rendering it among new objects therefore needs no
full light transport, but one light factor per visible point x with normal n:

    "captured" under the light of the scene:   factor = (E_all + B_all) / (E_static + B_static)
    "relit", captured under uniform light:     factor = (E_all + B_all) / white
    "relit" with a material of metalness m:    factor = (1 - m) d (E_all + B_all) / white

with the irradiance E = integral of V(x, w) L(w) max(0, n.w) dw over all emitters, and the irradiance B that
surroundings and objects reflect, see :mod:`mitsplat.renderer.light.bounce`. ``all`` has static and dynamic occluders,
``static`` has the captured surroundings alone. The first factor is exactly 1 where no dynamic object changes the light,
so that captured shadows are not applied twice; far from objects, B is left out. ``white`` is the irradiance for which
the colours of the surroundings are exposed. An object captured in a light tent keeps its colours under it, and is
darker where less light arrives. d is the albedo of the diffuse term of Mitsuba's ``principled``. Its specular lobe adds
a tinted part to the factor and a colourless part to the highlight, see :mod:`mitsplat.renderer.materials.principled`.
On colours captured under uniform light, the highlight is reduced by the mirror image of this light, which they contain;
under even light it adds nothing.

Rays are spent adaptively. Captured surfaces get one ray per pixel where objects occlude less light than the wanted
error, see :mod:`mitsplat.renderer.light.light_tiles`. All other points get the number of rays that most points need for
that error. Points with a larger perceptual error get more. On visible planes in even light, one pixel of four is
traced, see :mod:`mitsplat.renderer.light.light_planes`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import Emitters
from mitsplat.renderer.interreflection.reflectors import Reflectors
from mitsplat.renderer.light.bounce import object_cover, trace_bounce
from mitsplat.renderer.light.light_planes import MIN_ROWS, CoarseLight, Planes, between_samples, plane_codes
from mitsplat.renderer.light.lighting import Accuracy, Lighting
from mitsplat.renderer.light.lit_surface import VisibleSurfaces
from mitsplat.renderer.light.shadow_rays import ShadowTracer
from mitsplat.renderer.light.traced_pixels import TracedPixels
from mitsplat.renderer.light.unoccluded_light import UnoccludedLight
from mitsplat.renderer.materials.radiance_grid import RadianceGrid
from mitsplat.renderer.occluders.proxies import Proxies

TRACED_COVER = 0.2
"""Share of the hemisphere that objects cover from which the light of captured points is traced in any case."""


def light_factor(
    scene: mi.Scene,
    proxies: Proxies,
    visible: VisibleSurfaces,
    *,
    accuracy: Accuracy,
    seed: int,
    reference: tuple[float, ...],
    white: mi.Color3f,
    sky_reach: float = float("inf"),
    grid: RadianceGrid | None = None,
    bounce: bool = False,
) -> tuple[mi.Color3f, mi.Color3f]:
    """Compute light factor and highlight (Color3f) of every visible point, see the module docstring.

    The stages are: search for shadows, coarse light on planes, first rays, unoccluded light, bounce, further rays,
    filter, combination, reflections, and interpolation on planes. If the search finds no pixel to trace, the factor is
    that of the search, and there is no highlight. ``tests/renderer/light_reference.py`` computes the same quantities by
    loops.

    Args:
        scene: Mitsuba scene with the emitters.
        proxies: Occluders.
        visible: Surface points of the camera's pixels, row by row.
        accuracy: Target error and limits of shadow rays.
        seed: Offset into the low-discrepancy sequence.
        reference: Point at which emitters are compared to distribute the rays among them [m].
        white: Irradiance (Color3f) at which a uniformly captured object keeps its colours.
        sky_reach: Distance beyond which nothing occludes the sky [m].
        grid: Captured colours of the surroundings; None if there are none.
        bounce: True if points receive the light that surroundings, objects and visible meshes reflect.
    """
    emitters = Emitters(scene, reference, sky_reach)
    reflectors = Reflectors(scene, grid, proxies, emitters, white)
    lighting = Lighting(emitters, proxies, visible, accuracy, seed, white, reflectors)
    bounce &= reflectors.any
    cover = object_cover(visible) if bounce else None
    needed, others, light, codes = search_shadows(lighting, cover)
    coarse = trace_planes(lighting, needed, codes)
    if coarse is not None:
        needed &= ~coarse.coarse | coarse.lattice
        dr.eval(needed)
    index = dr.compress(needed)
    if not dr.width(index):
        return light, mi.Color3f(0)
    pixels = TracedPixels.of(lighting, index, coarse)
    estimate = pixels.trace_first_rays()
    unoccluded = UnoccludedLight.integrate(emitters, pixels.points, pixels.here, white)
    sums = pixels.points.sums_by_pixel(estimate)
    bounced = trace_bounce(pixels.centre_tracer(), reflectors, sums, cover) if bounce else None
    estimate, exposure = pixels.trace_further_rays(estimate, sums, unoccluded.level, others)
    estimate = pixels.points.sums_by_pixel(estimate)
    means = pixels.light_filter.smooth(estimate, None if bounced is None else bounced.relit)
    light = pixels.combine(light, unoccluded, means, bounced)
    light, highlight = pixels.add_reflections(light, estimate, exposure)
    if coarse is not None:
        dr.eval(light)
        light = between_samples(light, coarse.coarse, lighting.view)
    return light, highlight


def search_shadows(
    lighting: Lighting, cover: mi.Float | None
) -> tuple[mi.Bool, mi.UInt32, mi.Color3f, mi.UInt32 | None]:
    """Find the pixels whose light must be traced, by one ray per captured pixel.

    Captured points in tiles where dynamic objects occlude a share f below the wanted error take the factor 1 - f.
    Points next to objects, where ``cover`` of :func:`object_cover` is large, are traced in any case.

    Returns:
        * True (Bool) for pixels that need traced light.
        * Number of the other pixels that show a surface.
        * Light factor (Color3f) of these.
        * Codes of :func:`mitsplat.renderer.light.light_planes.plane_codes`; None if no plane is visible.
    """
    visible, error = lighting.visible, lighting.accuracy.error
    pixel = dr.arange(mi.UInt32, lighting.pixels)
    everything = visible.at(pixel)
    needed, light, codes = everything.valid, mi.Color3f(1), None
    if error > 0:
        shadow_only = everything.valid & ~(everything.relit | everything.glossy)
        plane_code = plane_codes(everything, visible.eye)
        some_shadow_only, some_planes = dr.any(shadow_only), dr.any(plane_code != 0)
        dr.eval(everything.valid, shadow_only, plane_code)
        if some_shadow_only:
            tracer = ShadowTracer(lighting.emitters, lighting.proxies, everything, pixel, lighting.view, lighting.seed)
            tiles = tracer.search(shadow_only)
            needed = everything.valid & (~shadow_only | tiles.differs(error))
            if cover is not None:
                needed |= shadow_only & (cover > TRACED_COVER)
            light = dr.select(everything.valid, tiles.light(), 1)
        codes = plane_code if some_planes else None
    others = dr.count(everything.valid & ~needed)
    dr.eval(needed, others, light)
    return needed, others, light, codes


def trace_planes(lighting: Lighting, needed: mi.Bool, codes: mi.UInt32 | None) -> CoarseLight | None:
    """Trace the first rays on visible planes in even light, at one pixel of four; return None if there are none."""
    if codes is None or lighting.view.height < MIN_ROWS:
        return None
    planes = Planes.of(codes, needed, lighting.view)
    return CoarseLight.of(planes, lighting.visible, lighting.emitters, lighting.seed, lighting.accuracy.dense)
