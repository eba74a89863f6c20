"""Visible meshes: camera hits of meshes and emitters.

Purely diffuse meshes are lit like splats, see :mod:`mitsplat.renderer.light.light`. All other materials of Mitsuba are
path traced, see :mod:`mitsplat.renderer.meshes.mesh_radiance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.renderer.occluders.proxies import Hit
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.rays.device_arrays import ray_scene, wrapped

FOOTPRINT = 4
"""Sample points along each side of a pixel's footprint for the reflectance of textured meshes."""

_NORMAL_MODIFIERS = ("NormalMap", "BumpMap")
"""Materials that perturb the normals of their nested material."""


def has_bsdf_flag(flags: mi.UInt32, *names: str) -> mi.Bool:
    """Return True if the flags contain one of the named flags of ``mi.BSDFFlags``."""
    return (flags & reduce(or_, (int(getattr(mi.BSDFFlags, name)) for name in names))) != 0


def is_diffuse(bsdf: mi.BSDF) -> bool:
    """Return True if a material is purely diffuse."""
    flags, diffuse = int(bsdf.flags()), int(mi.BSDFFlags.DiffuseReflection)
    return (flags & int(mi.BSDFFlags.All)) == diffuse and not any(name in str(bsdf) for name in _NORMAL_MODIFIERS)


def is_null(bsdf: mi.BSDF) -> bool:
    """Return True if a material changes no light; a surface of it is invisible."""
    return (int(bsdf.flags()) & int(mi.BSDFFlags.All)) == int(mi.BSDFFlags.Null)


def visible_parts(scene: mi.Scene) -> list[mi.Shape | mi.Emitter] | None:
    """Return emitters, in their order, and the shapes that change light; None if all shapes of the scene do.

    Rays would hit the other shapes.
    """
    emitters, shapes = scene.emitters(), [s for s in scene.shapes() if not s.is_emitter()]
    visible = [s for s in shapes if not is_null(s.bsdf())]
    if len(visible) == len(shapes):
        return None
    lights = [e.get_shape() if mi.has_flag(e.flags(), mi.EmitterFlags.Surface) else e for e in emitters]
    return [*lights, *visible]


def is_transmissive(bsdf: mi.BSDF) -> bool:
    """Return True if light passes through a material, which then casts no shadow on splats and diffuse meshes."""
    return bool(has_bsdf_flag(int(bsdf.flags()), "GlossyTransmission", "DeltaTransmission")) or "ThinDielectric" in str(
        bsdf
    )


def has_texture(bsdf: mi.BSDF) -> bool:
    """Return True if a material depends on texture coordinates; Mitsuba does not set its flag for textures."""
    return any(key.endswith(".to_uv") for key in mi.traverse(bsdf).keys())  # noqa: SIM118 - no mapping


@dataclass(frozen=True, eq=False)
class MeshHits:
    """Camera hits on visible meshes.

    Attributes:
        depth: Depth along z [m], infinite for a miss.
        reflectance: Diffuse albedo (Color3f) of purely diffuse meshes.
        valid: True for a hit.
        diffuse: True if the mesh is purely diffuse.
        normal, face: Unit normals of the surface and of its triangle, towards the camera.
        hit: Mitsuba's intersection.
    """

    depth: mi.Float
    reflectance: mi.Color3f
    valid: mi.Bool
    diffuse: mi.Bool
    normal: mi.Normal3f
    face: mi.Normal3f
    hit: mi.PreliminaryIntersection3f

    def before(self, other: Hit) -> Hit:
        """Return the nearer of these hits and other hits of the same rays."""
        return Hit.matt(self.hit.t, self.face, self.normal).before(other)


@dataclass(frozen=True, eq=False)
class VisibleMeshes:
    """Meshes of a scene that are neither splats nor lights.

    Attributes:
        scene: Mitsuba scene of these meshes only.
        diffuse: True if a shape is purely diffuse, by shape number; None if all shapes are.
        textured: True if the reflectance of any mesh varies over its surface.
    """

    scene: mi.Scene
    diffuse: mi.Bool | None
    textured: bool

    @classmethod
    def build(cls, shapes: Sequence[mi.Shape]) -> VisibleMeshes | None:
        """Build the scene of the visible ``shapes``; return None if there are none."""
        if not shapes:
            return None
        scene = ray_scene({f"visible_{i}": shape for i, shape in enumerate(shapes)})
        diffuse = [is_diffuse(shape.bsdf()) for shape in shapes]
        textured = any(map(has_texture, (shape.bsdf() for shape in shapes)))
        if all(diffuse):
            return cls(scene, None, textured)
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        table = np.zeros(1 + max(numbers), bool)
        table[numbers] = diffuse
        return cls(scene, wrapped(mi.Bool, table), textured)

    def is_diffuse(self, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Return True for hits on purely diffuse meshes, False for misses."""
        if self.diffuse is None:
            return hit.is_valid()
        return dr.gather(mi.Bool, self.diffuse, dr.reinterpret_array(mi.UInt32, hit.shape), hit.is_valid())

    def trace(self, view: CameraView, rays: mi.Ray3f, at: tuple[mi.Float, mi.Float] | None = None) -> MeshHits:
        """Trace camera rays through positions ``at`` [px], or through the centres of all pixels."""
        hit = self.scene.ray_intersect_preliminary(rays, coherent=True)
        si = hit.compute_surface_interaction(rays)
        valid = si.is_valid()
        diffuse = self.is_diffuse(hit)
        reflectance = self._reflectance(view, rays, at, si, valid & diffuse)
        depth = dr.select(valid, si.t * view.cosine(rays), dr.inf)
        normal, face = (dr.select(dr.dot(n, rays.d) > 0, -n, n) for n in (si.sh_frame.n, si.n))
        behind = MeshHits(depth, reflectance, valid, diffuse, normal, face, hit)
        dr.eval(behind)
        return behind

    def _reflectance(
        self,
        view: CameraView,
        rays: mi.Ray3f,
        at: tuple[mi.Float, mi.Float] | None,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> mi.Color3f:
        """Return the diffuse albedo (Color3f) of hits; for textures, its mean over the pixel's footprint.

        The footprint is the parallelogram of ray differentials (Igehy 1999), sampled at ``FOOTPRINT`` squared points.
        """
        if not self.textured:
            return si.bsdf().eval_diffuse_reflectance(si, active)
        x, y = at or view.centres()
        wide = mi.RayDifferential3f(rays)
        wide.o_x, wide.o_y, wide.has_differentials = rays.o, rays.o, True
        wide.d_x, wide.d_y = view.direction(x + 1, y), view.direction(x, y + 1)
        si.compute_uv_partials(wide)
        bsdf, uv, total = si.bsdf(), mi.Point2f(si.uv), mi.Color3f(0)
        across, along = (dr.select(dr.isfinite(step), step, 0) for step in (si.duv_dx, si.duv_dy))
        for i in range(FOOTPRINT**2):
            s, t = ((number + 0.5) / FOOTPRINT - 0.5 for number in divmod(i, FOOTPRINT))
            si.uv = uv + s * across + t * along
            total += bsdf.eval_diffuse_reflectance(si, active)
        si.uv = uv
        return total / FOOTPRINT**2


@dataclass(frozen=True, eq=False)
class VisibleEmitters:
    """Emitters seen by a camera.

    Attributes:
        depth: Depth along z [m] of emitters that are shapes, infinite for a miss.
        radiance: Radiance of the shape, otherwise of the sky (Color3f).
        everywhere: True if there is a sky.
    """

    depth: mi.Float
    radiance: mi.Color3f
    everywhere: bool

    @classmethod
    def trace(cls, scene: mi.Scene, view: CameraView, rays: mi.Ray3f) -> VisibleEmitters | None:
        """Trace camera rays to a scene's emitters; return None if no emitter can be visible."""
        sky = scene.environment()
        if any(shape.is_emitter() for shape in scene.shapes()):
            si = scene.ray_intersect(rays, mi.RayFlags.All, coherent=True)
        elif sky is not None:
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(rays))
            si.t, si.wi = dr.full(mi.Float, dr.inf, dr.width(rays)), -rays.d
        else:
            return None
        emitter = si.emitter(scene)
        shines = emitter != None  # noqa: E711 - of every element
        depth = dr.select(shines & si.is_valid(), si.t * view.cosine(rays), dr.inf)
        # Meshes that occlude the sky are handled by their depth.
        lights = cls(depth, dr.select(shines, emitter.eval(si, shines), 0), sky is not None)
        dr.eval(lights)
        return lights
