"""Surface points for light: a splat takes position and normal from the proxy below it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import drjit as dr
import mitsuba as mi

from mitsplat.renderer.light.light_traits import Traits
from mitsplat.renderer.materials.principled import MIN_COSINE, SpecularLobe
from mitsplat.renderer.occluders.proxies import Hit, Proxies
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import gathered

AGREEMENT = 0.02
"""Largest distance of a splat in front of its proxy, as a share of the depth, at which the proxy's surface is used."""


_AROUND = [
    (x * distance, y * distance) for distance in (1, 2, 3, 4, 6, 8) for x, y in product((-1, 0, 1), repeat=2) if x or y
]
"""Steps to the pixels [px] at which a pixel beside a proxy looks for it, the nearest first."""

MAX_METALLIC = 0.99
"""Metalness above which diffuse light is not traced."""


@dataclass(eq=False)
class LitSurface:
    """Visible surface points.

    Attributes:
        position, normal: Point [m] and unit normal towards the camera.
        face: Unit normal of the proxy's triangle.
        lift: Displacement [m] from the triangle to the smooth surface that the proxy approximates.
        to_camera: Unit vector towards the camera.
        offset: Distance of shadow ray origins from the surface [m].
        instance: Instance id (Float).
        trait: Row of the shape in :class:`Traits` (Float). Light is not averaged across rows.
        relit: True if the point is relit (uniform capture), False if it is only shadowed.
        roughness, metallic, specular, bend: Parameters of
            :class:`mitsplat.renderer.materials.principled.SpecularLobe`.
        captured: True if the colour contains the mirror image of the light of the capture.
        known: True if the point comes from the proxy of the visible instance, or see :func:`is_raised`; otherwise
            position and normal are a guess.
        valid: True if there is a point.
    """

    position: mi.Point3f
    normal: mi.Vector3f
    face: mi.Vector3f
    lift: mi.Vector3f
    to_camera: mi.Vector3f
    offset: mi.Float
    instance: mi.Float
    trait: mi.Float
    relit: mi.Bool
    roughness: mi.Float
    metallic: mi.Float
    specular: mi.Float
    bend: mi.Vector3f
    captured: mi.Bool
    known: mi.Bool
    valid: mi.Bool

    @property
    def glossy(self) -> mi.Bool:
        """True if the surface mirrors light."""
        return (self.specular > 0) | (self.metallic > 0)

    @property
    def diffuse(self) -> mi.Bool:
        """True if the surface reflects diffuse light."""
        return self.metallic < MAX_METALLIC

    @property
    def lobe(self) -> SpecularLobe:
        """Specular lobes towards the camera."""
        return SpecularLobe.of(self.normal, self.to_camera, self.roughness, self.metallic, self.specular, self.bend)


@dataclass(frozen=True, eq=False)
class VisiblePixels:
    """Visible surfaces of pixels that receive light: splats and purely diffuse meshes.

    Attributes:
        direction: Ray direction.
        cover: Opacity of these surfaces.
        depth: Depth along z [m] of the surface that the pixel shows.
        instance: Instance id of this surface; 0 for a mesh.
        trait: Row of the visible shape in :class:`Traits`.
        mesh: True if the pixel shows a purely diffuse mesh.
        metallic, roughness: Parameters that replace those of the proxy where they are not negative.
        normal: Unit shading normal that replaces that of the proxy where it is not zero.
    """

    direction: mi.Vector3f
    cover: mi.Float
    depth: mi.Float
    instance: mi.UInt32
    trait: mi.UInt32
    mesh: mi.Bool
    metallic: mi.Float
    roughness: mi.Float
    normal: mi.Vector3f


@dataclass(frozen=True, eq=False)
class VisibleSurfaces:
    """Surface points of the pixels of a view.

    Attributes:
        traits: Light parameters of shapes.
        view: The camera.
        proxies: Surfaces that represent the splats.
        eye: Origin of the camera rays.
        seen: Primary visibility of all pixels.
        hit: First proxy hit of the camera rays.
        static: First hit of the camera rays without dynamic objects.
    """

    traits: Traits
    view: CameraView
    proxies: Proxies
    eye: mi.Point3f
    seen: VisiblePixels
    hit: Hit
    static: Hit

    def at(self, pixel: mi.UInt32) -> LitSurface:
        """Return the points at pixel centres.

        They lie on the proxy where it agrees with the visible depth, and otherwise at that depth.
        """
        hit, static = (gathered(hits, pixel) for hits in (self.hit, self.static))
        beside = gathered(self.hit, dr.gather(mi.UInt32, self._nearest, pixel))
        return self._surface(gathered(self.seen, pixel), hit, static, beside)

    @cached_property
    def _nearest(self) -> mi.UInt32:
        """Nearest pixels whose rays hit the proxy of the object that the pixels show; the pixels themselves if none.

        Splats reach beyond the edges of their proxy by a part of a pixel.
        """
        width, height, instance = self.view.width, self.view.height, self.seen.instance
        nearest = dr.arange(mi.UInt32, width * height)
        dr.eval(nearest)
        own = dr.compress((instance > 0) & (self.hit.instance != instance))
        if not dr.width(own):
            return nearest
        shown, found, done = dr.gather(mi.UInt32, instance, own), mi.UInt32(own), mi.Bool(False)
        column, row = mi.Int32(own % width), mi.Int32(own // width)
        for dx, dy in _AROUND:
            x, y = column + dx, row + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & ~done
            other = mi.UInt32(y * width + x)
            hits = inside & (dr.gather(mi.UInt32, self.hit.instance, other, inside) == shown)
            found, done = dr.select(hits, other, found), done | hits
        dr.scatter(nearest, found, own, mode=dr.ReduceMode.Permute)
        dr.eval(nearest)
        return nearest

    def at_offset(self, pixel: mi.UInt32, offset: mi.Point2f) -> LitSurface:
        """Return the points at ``offset`` [px] (Point2f) from pixel centres.

        A point is valid where the ray hits a proxy of the same instance or, at instance 0, a visible mesh.
        """
        row = pixel // self.view.width
        x, y = mi.Float(pixel - row * self.view.width) + 0.5, mi.Float(row) + 0.5
        rays = self.view.rays_through(x + offset.x, y + offset.y)
        seen, (hit, _) = gathered(self.seen, pixel), self.proxies.nearest(rays)
        # Hits on visible meshes have the normals of triangles.
        smooth = dr.select(seen.mesh, dr.gather(mi.Normal3f, self.static.normal, pixel), hit.normal)
        hit = replace(hit, normal=smooth)
        dr.eval(hit)
        surface = self._surface(replace(seen, direction=rays.d), hit, hit, hit)
        surface.valid &= mi.Float(hit.instance) == surface.instance
        dr.eval(surface)
        return surface

    def _surface(self, seen: VisiblePixels, hit: Hit, static: Hit, beside: Hit) -> LitSurface:
        """Return the points of rays; ``beside`` has the surface of objects whose proxy the ray misses."""
        ray, depth, instance = mi.Ray3f(self.eye, seen.direction), seen.depth, seen.instance
        cosine = self.view.cosine(ray)
        met = hit.distance < dr.inf
        # Splats that are visible through or beside the proxy of a dynamic object lie on a static proxy.
        behind = instance == 0
        # Raised splats are lit at the object: light changes continuously from the visible proxy beside them.
        raised = is_raised(instance, depth, hit.instance, hit.distance * cosine)
        known = ~met | (hit.instance == instance) | raised
        same = dr.select(behind, static.distance < dr.inf, met & known)
        proxy_depth = dr.select(behind & ~raised, static.distance, hit.distance) * cosine
        shown = [dr.select(behind, getattr(static, name), getattr(hit, name)) for name in ("normal", "face", "lift")]
        towards = mi.Normal3f(-ray.d)
        at_edge = ~same & ~behind & (beside.instance == instance)
        normal, face = (dr.select(at_edge, getattr(beside, name), towards) for name in ("normal", "face"))
        # A splat inside its own coarse proxy would lie in the proxy's shadow, so it is lit at the surface of the proxy.
        on_proxy = same & (depth > (1 - AGREEMENT) * proxy_depth)
        z = dr.select(on_proxy, proxy_depth, depth)
        quarter = dr.opaque(mi.Float, 0.25 / self.view.fx)  # of a pixel, at a depth of 1
        z = dr.select(raised, z * (1 - quarter), z)  # before the object instead of inside it
        position = ray(z / cosine)
        valid = (seen.cover > 1 / 255) & (z > 0)
        traits, trait = self.traits, seen.trait
        captured = dr.gather(mi.Bool, traits.captured, trait)
        roughness, metallic, specular = (
            dr.select(
                (same | at_edge) & ~captured,
                dr.select(behind, getattr(static, name), dr.select(at_edge, getattr(beside, name), getattr(hit, name))),
                dr.gather(mi.Float, getattr(traits, name), trait),
            )
            for name in ("roughness", "metallic", "specular")
        )
        metallic = dr.select(seen.metallic >= 0, seen.metallic, metallic)
        roughness = dr.select(seen.roughness >= 0, seen.roughness, roughness)
        reach = dr.max(dr.abs(position))
        return LitSurface(
            position=position,
            normal=self._shading_normal(seen, mi.Vector3f(dr.select(same, shown[0], normal))),
            face=mi.Vector3f(dr.select(same, shown[1], face)),
            lift=dr.select(on_proxy, shown[2], 0),
            to_camera=-ray.d,
            offset=dr.fma(z, quarter, reach * 4e-6),
            instance=mi.Float(instance),
            trait=mi.Float(trait),
            relit=dr.gather(mi.Bool, traits.relit, trait) | seen.mesh,
            roughness=roughness,
            metallic=dr.select(seen.mesh, 0, metallic),
            specular=dr.select(seen.mesh, 0, specular),
            bend=dr.zeros(mi.Vector3f, dr.width(position)),
            captured=captured,
            known=known,
            valid=valid,
        )

    @staticmethod
    def _shading_normal(seen: VisiblePixels, smooth: mi.Vector3f) -> mi.Vector3f:
        """Return the normal of the splats where they have one, otherwise ``smooth``.

        A normal that points away from the camera is turned to the horizon.
        """
        normal, towards = seen.normal, -seen.direction
        cosine = dr.dot(normal, towards)
        normal = dr.select(cosine < MIN_COSINE, dr.normalize(normal + (MIN_COSINE - cosine) * towards), normal)
        return dr.select(dr.squared_norm(seen.normal) > 0, normal, smooth)


def is_raised(instance: mi.UInt32, depth: mi.Float, proxy_instance: mi.UInt32, proxy_depth: mi.Float) -> mi.Bool:
    """Return True for splats of surroundings that rise above their proxy and hide the lower edge of an object.

    Args:
        instance: Visible instance.
        depth: Visible depth [m].
        proxy_instance: Instance of the first proxy.
        proxy_depth: Depth of the first proxy [m].
    """
    close = (depth < proxy_depth) & (depth > (1 - AGREEMENT) * proxy_depth)
    return (instance == 0) & (proxy_instance > 0) & close
