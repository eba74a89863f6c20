"""Indirect light: light that surroundings, objects and visible meshes reflect onto visible points.

Relit points receive it in addition to the light of the emitters. A captured point receives in its captured colour the
light of the captured surroundings. The light that objects reflect and block changes it near objects, and in the shadow
of objects it is what remains:

    factor = (lit + B_all) / (base + B_static)

with the direct irradiance ``lit`` and ``base`` with and without dynamic occluders, and the reflected irradiance B with
and without objects. Both are estimated by the same rays, so that the factor is exactly 1 where nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.interreflection.captured_hits import MIN_COVER
from mitsplat.renderer.interreflection.reflectors import Reflectors
from mitsplat.renderer.light.light_estimate import Estimate
from mitsplat.renderer.light.light_filter import RADIUS, LightFilter
from mitsplat.renderer.light.light_tiles import STRIDE
from mitsplat.renderer.light.lit_surface import LitSurface, VisibleSurfaces
from mitsplat.renderer.light.shadow_rays import ROBERTS, ShadowTracer, ray_origin, sequence_point
from mitsplat.renderer.rays.device_arrays import gathered

BOUNCE_RAYS = 3
"""Rays per pixel of objects, before neighbours are averaged."""

CELL_RAYS = 4
"""Rays per cell of 2 x 2 pixels on captured surroundings near objects, before neighbours are averaged."""

COVER_CELL = 4
"""Edge [px] of the cells in which :func:`object_cover` is constant."""

MAX_SHARE = 0.85
"""Share of light that arrives below which reflected light is traced at captured points, as it is near objects."""

MESH_RAYS = 2
"""Rays per cell on visible meshes such as a table; averages over even surfaces reduce the noise."""

SPREAD = 64
"""Mean distance between a point and its neighbours in the wide average over meshes, over the offset of ray origins."""


@dataclass(frozen=True, eq=False)
class Bounce:
    """Reflected irradiance at traced pixels, divided by the irradiance of display white.

    Attributes:
        relit: Irradiance (Color3f) at relit points, not filtered, and 1 where it was computed, otherwise 0 (Float).
        captured: Irradiance (Color3f) at captured points near objects with and without dynamic objects, filtered; 0
            elsewhere.
    """

    relit: tuple[mi.Color3f, mi.Float]
    captured: tuple[mi.Color3f, mi.Color3f]


def object_cover(visible: VisibleSurfaces) -> mi.Float | None:
    """Estimate the share of the cosine-weighted hemisphere that objects cover at every pixel of the image.

    The estimate is that of one captured point in each cell of COVER_CELL x COVER_CELL pixels; where there is none, it
    is 1. The result is None without objects.
    """
    boxes, view = visible.proxies.boxes, visible.view
    if boxes is None:
        return None
    width, height = -(-view.width // COVER_CELL), -(-view.height // COVER_CELL)
    cell = dr.arange(mi.UInt32, width * height)
    x = dr.minimum(cell % width * COVER_CELL + COVER_CELL // 2, view.width - 1)
    y = dr.minimum(cell // width * COVER_CELL + COVER_CELL // 2, view.height - 1)
    point = visible.at(y * view.width + x)
    cover = dr.select(_captured(point), boxes.form_factor(point.position, point.normal), 1)
    dr.eval(cover)
    pixel = dr.arange(mi.UInt32, view.width * view.height)
    return dr.gather(mi.Float, cover, pixel // view.width // COVER_CELL * width + pixel % view.width // COVER_CELL)


def _captured(point: LitSurface) -> mi.Bool:
    """Return True for points of captured surroundings."""
    return point.valid & ~point.relit & (point.instance == 0)


def trace_bounce(tracer: ShadowTracer, reflectors: Reflectors, estimate: Estimate, cover: mi.Float | None) -> Bounce:
    """Trace the reflected irradiance at relit points, and at captured points near objects or in their shadow.

    ``cover`` is that of :func:`object_cover`.

    Points of objects use a few rays each, so that their neighbours must be averaged. On captured surroundings and
    visible meshes, one pixel in each cell of 2 x 2 is traced, and the mean over 9 x 9 cells is taken first. Its window
    is one period of the ray directions, so that it has no steps. On meshes, the mean is wider still, because few rays
    hit small bright regions such as a wall near a lamp. Light of near surfaces changes over short distances, so that
    less of this mean counts there (Ward et al. 1988, "A Ray Tracing Solution for Diffuse Interreflection").
    """
    surface, pixel = tracer.surface, tracer.pixel
    on_object, count = surface.instance > 0, dr.width(pixel)
    captured = mi.Bool(False)
    if cover is not None:
        shaded = dr.sum(estimate.lit) < MAX_SHARE * dr.sum(estimate.base)
        captured = _captured(surface) & (shaded | (dr.gather(mi.Float, cover, pixel) > MIN_COVER))
    selected = _one_pixel_of_each_cell(tracer)
    with_objects, static = dr.zeros(mi.Color3f, count), dr.zeros(mi.Color3f, count)
    known = dr.zeros(mi.Float, count)
    for which, trace in (
        (surface.relit & on_object & surface.diffuse, _trace_objects),
        (captured & selected, _trace_surroundings),
        (surface.relit & ~on_object & selected, _trace_meshes),
    ):
        places = dr.compress(which)
        if dr.width(places):
            found, without = trace(tracer, reflectors, places)
            dr.scatter(with_objects, found, places)
            dr.scatter(static, without, places)
            dr.scatter(known, mi.Float(1), places)
            dr.eval(with_objects, static, known)
    places = dr.compress(captured)
    filtered = mi.Color3f(0), mi.Color3f(0)
    if dr.width(places):
        own = gathered(surface, places)
        columns = [dr.gather(mi.Float, column, places) for column in (*with_objects, *static, known)]
        dr.eval(own, columns)
        *columns, share = LightFilter(own, tracer.view, dr.gather(mi.UInt32, pixel, places)).average(columns)
        filtered = dr.zeros(mi.Color3f, count), dr.zeros(mi.Color3f, count)
        for total, colours in zip(filtered, (columns[:3], columns[3:]), strict=True):
            dr.scatter(total, dr.select(share > 1e-6, mi.Color3f(*colours) / share, 0), places)
    return Bounce((with_objects, known), filtered)


def _one_pixel_of_each_cell(tracer: ShadowTracer) -> mi.Bool:
    """Return True for one pixel of each cell of 2 x 2, equally often in each row and in each column."""
    x, y = tracer.pixel % tracer.view.width, tracer.pixel // tracer.view.width
    selected = ((x & 1) == (y >> 1 & 1)) & ((y & 1) == ((x >> 1) + (y >> 1) & 1))
    return selected if tracer.lattice is None else selected | dr.gather(mi.Bool, tracer.lattice, tracer.pixel)


def _trace_objects(tracer: ShadowTracer, reflectors: Reflectors, places: mi.UInt32) -> tuple[mi.Color3f, mi.Color3f]:
    """Trace the irradiance with and without dynamic objects at places, from each pixel on its own."""
    own, pixel = gathered(tracer.surface, places), dr.gather(mi.UInt32, tracer.pixel, places)
    found, without, _ = _irradiance(reflectors, own, tracer.sequence_start(pixel), BOUNCE_RAYS)
    return found, without


def _trace_surroundings(
    tracer: ShadowTracer, reflectors: Reflectors, places: mi.UInt32
) -> tuple[mi.Color3f, mi.Color3f]:
    """Trace the irradiance with and without dynamic objects at places, one per cell, as a mean over cells."""
    found, without, *_ = _trace_cells(tracer, reflectors, places, CELL_RAYS)
    return found, without


def _trace_meshes(tracer: ShadowTracer, reflectors: Reflectors, places: mi.UInt32) -> tuple[mi.Color3f, mi.Color3f]:
    """Trace as :func:`_trace_surroundings`, and use a wider mean where no reflecting surface is near."""
    found, without, near, light_filter = _trace_cells(tracer, reflectors, places, MESH_RAYS)
    own = light_filter.here
    wide = LightFilter(own, light_filter.view, light_filter.index, stride=RADIUS).average([*found])
    share = dr.clip(SPREAD * own.offset * near / dr.maximum(dr.sum(found), 1e-20), 0, 1)
    return dr.lerp(mi.Color3f(*wide), found, share), without


def _trace_cells(
    tracer: ShadowTracer, reflectors: Reflectors, places: mi.UInt32, rays: int
) -> tuple[mi.Color3f, mi.Color3f, mi.Float, LightFilter]:
    """Return means over cells: irradiance with and without dynamic objects, its nearness, and the filter over cells."""
    own, pixel = gathered(tracer.surface, places), dr.gather(mi.UInt32, tracer.pixel, places)
    width, height = -(-tracer.view.width // 2), -(-tracer.view.height // 2)
    cell = (pixel // tracer.view.width >> 1) * width + (pixel % tracer.view.width >> 1)
    found, without, nearness = _irradiance(reflectors, own, tracer.start_at(cell % width, cell // width), rays)
    light_filter = LightFilter(own, replace(tracer.view, width=width, height=height), cell)
    *means, near = light_filter.average([*found, *without, dr.sum(found) * nearness])
    return mi.Color3f(*means[:3]), mi.Color3f(*means[3:]), near, light_filter


def _irradiance(
    reflectors: Reflectors, own: LitSurface, start: mi.UInt32, rays: int
) -> tuple[mi.Color3f, mi.Color3f, mi.Float]:
    """Return :meth:`Reflectors.irradiance` at points, whose rays begin at ``start`` in their sequence."""
    origin, normal = mi.Point3f(ray_origin(own)), mi.Vector3f(own.normal)
    dr.eval(own, start, origin, normal)
    return reflectors.irradiance(origin, normal, start, STRIDE, rays, _two_points)


def _two_points(i: mi.UInt32) -> tuple[mi.Point2f, mi.Point2f]:
    return sequence_point(i), sequence_point(i, ROBERTS)
