"""Light of objects on captured surroundings that rays hit: shadows, and reflected light.

Captured colours contain the light of the emitters and of earlier bounces without the objects.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import ROUGH_LATTICE, Emitters, receiver
from mitsplat.renderer.interreflection.ray_paths import (
    Paths,
    end_kernel,
    next_key,
    occluded,
    sequence_number,
    shadow_ray,
)
from mitsplat.renderer.materials.radiance_grid import RadianceGrid
from mitsplat.renderer.occluders.proxies import Boxes, Proxies, TraceScene

MIN_COVER = 0.03
"""Share of the hemisphere that an object covers from which its light on captured surroundings is traced."""

CANDIDATES = 4
"""Sampled emitters of which one is tested for the shadow of dynamic objects on captured surroundings."""

CAPTURED_SPREAD = 0.25
"""GGX's alpha of light of objects on captured surroundings, where a metal below a lamp lights a small area.

See :func:`mitsplat.renderer.interreflection.reflectors.widened`.
"""


@dataclass(frozen=True, eq=False)
class CapturedHits:
    """Captured surroundings that rays hit.

    Attributes:
        static: Their proxies.
        grid: Their captured colours; None if there are none.
        proxies: All proxies.
        emitters: Light on the surroundings.
        white: Irradiance (Color3f) of display white.
    """

    static: TraceScene
    grid: RadianceGrid | None
    proxies: Proxies
    emitters: Emitters
    white: mi.Color3f

    def arriving_share(self, place: mi.SurfaceInteraction3f, key: mi.UInt32, emitter_sample: mi.Point2f) -> mi.Float:
        """Return the share of light that dynamic objects leave at captured surfaces, from one sampled emitter.

        The sample is chosen from several in proportion to its irradiance (Talbot et al. 2005, "Importance Resampling
        for Global Illumination"). Where a captured wall hides the sky, objects block the light of the wall instead, at
        most that of the sky. Walls do not change the chances of directions: shadows are too weak where dark walls hide
        much of the sky.
        """

        def choose(
            i: mi.UInt32, rest: mi.Float, total: mi.Float, direction: mi.Vector3f, reach: mi.Float, sky: mi.Bool
        ) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Vector3f, mi.Float, mi.Bool]:
            x = emitter_sample.x + mi.Float(i) / CANDIDATES
            beam = self.emitters.sample(place, mi.Point2f(x - dr.floor(x), emitter_sample.y), mi.Bool(True))
            weight, before = dr.sum(beam.irradiance), total
            total = before + weight
            scaled = rest * total
            chosen = scaled < weight
            # The rest of the number is uniform again in either case.
            rescaled = dr.select(chosen, scaled / weight, (scaled - weight) / before)
            return (
                i + 1,
                dr.select((weight > 0) & (before > 0), rescaled, rest),
                total,
                dr.select(chosen, beam.direction, direction),
                dr.select(chosen, beam.reach, reach),
                dr.select(chosen, beam.sky, sky),
            )

        count, last = dr.width(key), dr.opaque(mi.UInt32, CANDIDATES)
        nothing = (dr.zeros(kind, count) for kind in (mi.Float, mi.Vector3f, mi.Float, mi.Bool))
        state = dr.zeros(mi.UInt32, count), sequence_number(key, 4), *nothing
        state = dr.while_loop(state, lambda i, *_: i < last, choose, label="candidates")
        _, _, total, direction, reach, sky = state
        shadow, shaded = shadow_ray(place.p, direction, reach), total > 0
        end_kernel(self.proxies, shadow, key, shaded, sky)
        shaded &= occluded(self.proxies, shadow, mi.UInt32(0), key, shaded, self.proxies.shadow_casters)
        wall = self.static.intersect(shadow, shaded)
        blocked = shaded & wall.is_valid()
        shadow.maxt = dr.select(blocked, wall.t, shadow.maxt)
        end_kernel(self.proxies, shadow, blocked, shaded)
        behind = occluded(self.proxies, shadow, mi.UInt32(0), key, blocked & sky, self.proxies.shadow_casters)
        lost = dr.select(shaded & ~blocked, mi.Float(1), 0)
        if self.emitters.sky is not None and self.grid is not None:
            of_wall = self.grid.at(shadow, dr.select(behind, shadow.maxt, 0), behind) * self.white
            emitter = dr.gather(mi.EmitterPtr, self.emitters.pointers, self.emitters.sky)
            of_sky = dr.pi * self.emitters.sky_radiance(place, direction, emitter, behind)
            lost = dr.select(behind, dr.minimum(dr.sum(of_wall) / dr.maximum(dr.sum(of_sky), 1e-20), 1), lost)
        dr.eval(lost)
        return 1 - lost

    def paths_to_objects(
        self, dynamic: TraceScene, boxes: Boxes, place: mi.SurfaceInteraction3f, captured: mi.Color3f, key: mi.UInt32
    ) -> tuple[mi.UInt32, Paths] | None:
        """Return paths from captured surfaces to objects that light them, and their lanes; None if there are none.

        The captured colour is albedo * E / white with the irradiance E of the emitters, so that

            added colour = min(captured * white / E, 1) * mean colour of objects over the cosine-weighted hemisphere
        """
        near_objects = boxes.form_factor(place.p, place.n) > MIN_COVER
        dr.eval(place.p, place.n, near_objects, captured, key)  # in one kernel; gathers evaluate each in its own
        lane = dr.compress(near_objects)
        if not dr.width(lane):
            return None
        captured, origin, normal, key = (dr.gather(type(v), v, lane) for v in (captured, place.p, place.n, key))
        numbers = [sequence_number(key, dimension) for dimension in range(4)]
        upward = mi.warp.square_to_cosine_hemisphere(mi.Point2f(*numbers[:2]))
        ray, emitter_sample = mi.Ray3f(origin, mi.Frame3f(normal).to_world(upward)), mi.Point2f(*numbers[2:])
        if self.emitters.sky is not None:
            ray.maxt = self.emitters.sky_reach
        near = dynamic.intersect(ray)
        hits_object = near.is_valid() & ~self.proxies.on_relit_surroundings(near)
        dr.eval(ray, near, hits_object, emitter_sample, captured, normal, key)
        row = dr.compress(hits_object)
        if not dr.width(row):
            return None
        some = (dr.gather(type(v), v, row) for v in (ray, near, key, emitter_sample, captured, normal, lane))
        ray, near, key, emitter_sample, captured, normal, lane = some
        ray.maxt = near.t
        free = ~self.static.intersect(ray).is_valid()
        irradiance = self.emitters.unoccluded_irradiance(receiver(ray.o, normal), free, ROUGH_LATTICE)
        albedo = dr.minimum(captured * self.white / dr.maximum(irradiance, 1e-20), 1)
        spread = dr.opaque(mi.Float, CAPTURED_SPREAD, dr.width(key))
        paths = Paths(ray, near, next_key(key), emitter_sample, spread, dr.select(free, albedo, 0))
        dr.eval(lane, paths)
        return lane, paths
