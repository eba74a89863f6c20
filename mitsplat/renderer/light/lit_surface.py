"""From what pixels show to the points that light is traced at: splats lend their place to the proxies under them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.light_traits import Traits
from mitsplat.renderer.occluders.proxies import Hit, Proxies
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered

AGREEMENT = 0.02
"""Share of the depth by which a splat may lie before its proxy and still be taken for its surface."""


@dataclass(eq=False)
class LitSurface:
    """Visible points.

    Attributes:
        position, normal: Point [m] and unit normal towards the camera.
        face: Unit normal of the proxy's triangle.
        lift: Displacement [m] from the triangle to the smooth surface that it stands for.
        to_camera: Unit vector towards the camera.
        offset: How far shadow rays start off the surface [m].
        instance: Instance id (Float).
        trait: Row of the shape's traits (Float); light is not averaged across its borders.
        relit: Whether the point is lit anew (uniform capture) rather than only shadowed.
        roughness, specular: GGX roughness and reflectance at normal incidence.
        known: Whether the proxy of what is seen says so; else position and normal are a guess.
        valid: Whether there is a point at all.
    """

    position: Any
    normal: Any
    face: Any
    lift: Any
    to_camera: Any
    offset: Any
    instance: Any
    trait: Any
    relit: Any
    roughness: Any
    specular: Any
    known: Any
    valid: Any


@dataclass(frozen=True, eq=False)
class Seen:
    """What pixels show.

    Attributes:
        direction: Of their rays.
        alpha, depth, instance: As in the layers.
        trait: Row of what is shown in :class:`Traits`.
        mesh: Whether it is a visible mesh.
    """

    direction: Any
    alpha: Any
    depth: Any
    instance: Any
    trait: Any
    mesh: Any


@dataclass(frozen=True, eq=False)
class VisibleSurfaces:
    """Where the pixels of a view show something that light falls on.

    Attributes:
        traits: How shapes are lit.
        view: The camera.
        proxies: The surfaces that splats stand for.
        eye: Where the camera's rays start.
        seen: What all pixels show.
        hit: What their rays meet first of the proxies.
        static: What they meet first of those that do not move.
    """

    traits: Traits
    view: CameraView
    proxies: Proxies
    eye: Any
    seen: Seen
    hit: Hit
    static: Hit

    def at(self, pixel: Any) -> LitSurface:
        """Points in the middle of pixels: on the proxy where it agrees with what is seen, else at the seen depth."""
        return self._surface(gathered(self.seen, pixel), gathered(self.hit, pixel), gathered(self.static, pixel))

    def beside(self, pixel: Any, offset: Any) -> LitSurface:
        """Points ``offset`` [px] (Point2f) off the middles of pixels, valid where a proxy of the same instance is."""
        row = pixel // self.view.width
        x, y = mi.Float(pixel - row * self.view.width) + 0.5, mi.Float(row) + 0.5
        rays = self.view.rays_through(x + offset.x, y + offset.y)
        hit, static = self.proxies.nearest(rays)
        dr.eval(hit, static)
        surface = self._surface(replace(gathered(self.seen, pixel), direction=rays.d), hit, static)
        surface.valid &= mi.Float(hit.instance) == surface.instance
        dr.eval(surface)
        return surface

    def _surface(self, seen: Seen, hit: Hit, static: Hit) -> LitSurface:
        ray, depth, instance = mi.Ray3f(self.eye, seen.direction), seen.depth, seen.instance
        cosine = self.view.cosine(ray)
        met = hit.distance < dr.inf
        known = ~met | (hit.instance == instance)
        # What shows through or beside a dynamic object's proxy lies on a static one.
        behind = instance == 0
        same = dr.select(behind, static.distance < dr.inf, met & known)
        proxy_depth = dr.select(behind, static.distance, hit.distance) * cosine
        shown = [dr.select(behind, getattr(static, name), getattr(hit, name)) for name in ("normal", "face", "lift")]
        towards = mi.Normal3f(-ray.d)
        # A splat that lies inside its own coarse proxy would be in the proxy's shadow: light it where the proxy starts.
        on_proxy = same & (depth > (1 - AGREEMENT) * proxy_depth)
        z = dr.select(on_proxy, proxy_depth, depth)
        position = ray(z / cosine)
        valid = (seen.alpha > 1 / 255) & (z > 0)
        reach = dr.max(dr.abs(position))
        return LitSurface(
            position=position,
            normal=mi.Vector3f(dr.select(same, shown[0], towards)),
            face=mi.Vector3f(dr.select(same, shown[1], towards)),
            lift=dr.select(on_proxy, shown[2], 0),
            to_camera=-ray.d,
            offset=dr.fma(z, 0.25 / self.view.fx, reach * 4e-6),
            instance=mi.Float(instance),
            trait=mi.Float(seen.trait),
            relit=dr.gather(mi.Bool, self.traits.relit, seen.trait) | seen.mesh,
            roughness=dr.gather(mi.Float, self.traits.roughness, seen.trait),
            specular=dr.select(seen.mesh, 0, dr.gather(mi.Float, self.traits.specular, seen.trait)),
            known=known,
            valid=valid,
        )
