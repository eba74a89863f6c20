"""Proxy surfaces that rays are traced against: occluders of light, and surfaces that receive it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.mesh_normals import smooth_normals
from mitsplat.renderer.materials.proxy_materials import (
    UNCHANGED_GLOSS,
    CornerMaterials,
    GlossChange,
    ProxyPart,
    SurfaceMaterial,
    material_triangles,
)
from mitsplat.renderer.occluders.splat_occlusion import Caster, SplatOccluders
from mitsplat.renderer.projection.splat_appearance import SplatAppearance
from mitsplat.renderer.rays.device_arrays import ray_scene, wrapped

OPEN_EDGED_RAYS = 0.5
"""Rays per triangle in one call above which light is traced in a second scene without watertight edges.

Embree prepares this scene in the time that about 40 rays per triangle save. All light of a frame takes 50 rays per
triangle at 1280 x 720 pixels, with 70,000 triangles, and the scene serves all frames of a layout.
"""


@dataclass(frozen=True, eq=False)
class Occluder:
    """Proxy surface.

    Attributes:
        mesh: Surface in its own frame [m].
        instance: Instance id, 0 for the environment.
        dynamic: True if the captured colours do not contain its shadow.
        world_from_mesh: Pose, a similarity transform, shape (4, 4).
        splats: Gaussians in the frame of the mesh that give it its material; None for a black or captured surface.
        appearance: Change of the colours of the splats.
        gloss: Change of their roughness and specular.
    """

    mesh: trimesh.Trimesh
    instance: int
    dynamic: bool
    world_from_mesh: Float64Array = field(default_factory=lambda: np.eye(4))
    splats: Splats | None = None
    appearance: SplatAppearance | None = None
    gloss: GlossChange = UNCHANGED_GLOSS

    @property
    def is_captured(self) -> bool:
        """True if its colours contain the light of the scene."""
        return not self.dynamic and self.splats is None

    @property
    def part(self) -> ProxyPart:
        """The mesh with what determines its materials."""
        pose = np.asarray(self.world_from_mesh, np.float64).tobytes()
        return ProxyPart(self.mesh, self.instance, pose, self.splats, self.appearance, self.gloss)


@dataclass(frozen=True, eq=False)
class Hit:
    """Hits of rays on proxies.

    Attributes:
        distance: Distance along the ray [m], infinite for a miss.
        face: Unit normal of the triangle, towards the ray's origin.
        normal: Unit normal of the smooth surface that the triangles approximate, towards the ray's origin.
        lift: Displacement from the triangle to that surface [m] where it is convex, otherwise zero.
        instance: Instance id, 0 for a miss.
        metallic, roughness, specular: Parameters of ``principled``, of a matt surface for a miss.
    """

    distance: mi.Float
    face: mi.Normal3f
    normal: mi.Normal3f
    lift: mi.Vector3f
    instance: mi.UInt32
    metallic: mi.Float
    roughness: mi.Float
    specular: mi.Float

    @classmethod
    def miss(cls) -> Hit:
        """Return a miss."""
        return cls.matt(mi.Float(dr.inf), mi.Normal3f(0), mi.Normal3f(0))

    @classmethod
    def matt(cls, distance: mi.Float, face: mi.Normal3f, normal: mi.Normal3f) -> Hit:
        """Return hits on a matt surface of the environment; the parameters are those of the fields."""
        gloss = {"metallic": mi.Float(0), "roughness": mi.Float(1), "specular": mi.Float(0)}
        return cls(distance, face, normal, lift=mi.Vector3f(0), instance=mi.UInt32(0), **gloss)

    def before(self, other: Hit) -> Hit:
        """Return the nearer of these hits and other hits of the same rays."""
        nearer = self.distance < other.distance
        return Hit(*[dr.select(nearer, getattr(self, f.name), getattr(other, f.name)) for f in fields(Hit)])


@dataclass(frozen=True, eq=False)
class Boxes:
    """Axis-aligned boxes around proxies.

    Attributes:
        rows: Centre [m], half extents [m], instance id and zero of each box, packed.
        count: Number of boxes.
    """

    rows: mi.Float
    count: int

    @classmethod
    def of(cls, occluders: Sequence[Occluder], visible: Sequence[mi.Shape]) -> Boxes | None:
        """Return the boxes of proxies and visible shapes."""
        rows = []
        for o in occluders:
            if len(o.mesh.faces):
                world = trimesh.transform_points(trimesh.bounds.corners(o.mesh.bounds), o.world_from_mesh)
                low, high = world.min(axis=0), world.max(axis=0)
                rows.append([*(low + high) / 2, *(high - low) / 2, o.instance, 0])
        for shape in visible:
            box = shape.bbox()
            rows.append([*np.array(box.center()), *np.array(box.extents()) / 2, 0, 0])
        return cls(wrapped(mi.Float, np.array(rows, np.float32)), len(rows)) if rows else None

    def form_factor(self, point: mi.Point3f, normal: mi.Vector3f) -> mi.Float:
        """Estimate the largest share of the cosine-weighted hemisphere of points that one box covers.

        A box at distance d has the solid angle A / d^2 of its projected area A. Its mean cosine is half of that of its
        upper edge.
        """

        def add(i: mi.UInt32, most: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            row = dr.gather(mi.ArrayXf, self.rows, i, shape=(8, dr.width(i)))
            way, half = mi.Vector3f(*row[:3]) - point, mi.Vector3f(*row[3:6])
            gap = dr.norm(dr.maximum(dr.abs(way) - half, 0))
            distance = dr.norm(way)
            towards = dr.abs(way) / dr.maximum(distance, 1e-12)
            area = 4 * dr.dot(towards, mi.Vector3f(half.y * half.z, half.x * half.z, half.x * half.y))
            top = dr.dot(normal, way) + dr.dot(dr.abs(normal), half)
            solid = dr.minimum(area / dr.maximum(dr.pi * gap * distance, 1e-12), 1)
            top = dr.maximum(top, 0)
            share = 0.5 * solid * top * dr.rsqrt(dr.maximum(gap * gap + top * top, 1e-24))
            return i + 1, dr.maximum(most, share)

        rounds = dr.opaque(mi.UInt32, self.count)
        state = dr.zeros(mi.UInt32, dr.width(point)), dr.zeros(mi.Float, dr.width(point))
        return dr.while_loop(state, lambda i, _: i < rounds, add, label="boxes")[1]


class OccluderScene(Protocol):
    """Ray-traceable scene of occluders."""

    def occluded(
        self, ray: mi.Ray3f, instance: mi.UInt32, key: mi.UInt32, active: mi.Bool, *, watertight: bool = True
    ) -> mi.Bool:
        """Return True for occluded rays from points of instances; ``key`` selects the random outcome of a ray.

        If not ``watertight``, single rays in ten million may pass between two triangles.
        """


class Proxies:
    """Ray-traceable proxy surfaces: one scene of static proxies and one of dynamic proxies.

    Attributes:
        static, dynamic: These scenes, for hits.
        captured: Static proxies that show captured light, which reflected rays meet.
        reflecting: Other proxies and the visible shapes, which reflect the light of the emitters.
        first_relit: First triangle of relit surroundings in ``reflecting``; None if there are none.
        shadow_casters: Scenes that cast the shadows of dynamic objects: none, one or two.
        boxes: Boxes around the dynamic proxies, see :class:`Boxes`; None if there are none.
        shows_meshes: True if the dynamic proxies include visible meshes.
        separate_kernels: True if a kernel may trace only one scene. On CUDA, Dr.Jit drops all but the first.
    """

    def __init__(
        self, occluders: Sequence[Occluder], visible: Sequence[mi.Shape] = (), casters: Sequence[Caster] | None = None
    ) -> None:
        """Build the scenes from proxy meshes and visible Mitsuba shapes.

        Visible shapes are dynamic, because no capture contains their shadows. Shadows of dynamic proxies are cast by
        ``casters``, or by the proxy meshes if ``casters`` is None.
        """
        self.static = TraceScene.build([o for o in occluders if not o.dynamic])
        self.dynamic = TraceScene.build([o for o in occluders if o.dynamic], visible)
        self._surroundings = self.static
        if any(o.dynamic and o.instance == 0 for o in occluders):
            self._surroundings = TraceScene.build([o for o in occluders if not o.dynamic or o.instance == 0])
        self.captured, self.reflecting = self.static, self.dynamic
        self.first_relit: mi.UInt32 | None = None
        relit = [o for o in occluders if not o.dynamic and not o.is_captured]
        if relit:
            self.captured = TraceScene.build([o for o in occluders if o.is_captured])
            self.reflecting = TraceScene.build([*(o for o in occluders if o.dynamic), *relit], visible)
            before = 0 if self.dynamic is None or self.dynamic.mesh is None else dr.width(self.dynamic.instances)
            self.first_relit = dr.opaque(mi.UInt32, before)
        shadow_casters = (
            [self.dynamic] if casters is None else [TraceScene.build([], visible), SplatOccluders.build(casters)]
        )
        self.shadow_casters: tuple[OccluderScene, ...] = tuple(
            occluder_scene for occluder_scene in shadow_casters if occluder_scene is not None
        )
        self.boxes = Boxes.of([o for o in occluders if o.dynamic], visible)
        self.shows_meshes = bool(visible)
        self.separate_kernels = dr.backend_v(mi.Float) == dr.JitBackend.CUDA

    @property
    def occluder_scenes(self) -> tuple[OccluderScene, ...]:
        """All occluder scenes, the static proxies first."""
        return self.shadow_casters if self.static is None else (self.static, *self.shadow_casters)

    def on_relit_surroundings(self, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Return True for hits in ``reflecting`` on surroundings, whose light captured colours contain."""
        if self.first_relit is None or self.reflecting is None:
            return mi.Bool(False)
        return ~self.reflecting.is_visible(hit) & (hit.prim_index >= self.first_relit)

    def nearest(self, ray: mi.Ray3f) -> tuple[Hit, Hit]:
        """Return the first hits of rays, and the first hits without the dynamic objects and visible shapes."""
        ground = Hit.miss()
        if self._surroundings is not None:
            ground = self._surroundings.nearest(ray).before(ground)
        dr.eval(ground)  # a separate kernel, see `separate_kernels`
        return ground if self.dynamic is None else self.dynamic.nearest(ray).before(ground), ground

    def blocked(self, ray: mi.Ray3f) -> mi.Bool:
        """Return True for rays that hit a proxy before their end."""
        found = mi.Bool(False)
        for proxies in (self.static, self.dynamic):
            if proxies is not None:
                found |= proxies.scene.ray_test(ray)
                dr.eval(found)  # a separate kernel, see `separate_kernels`
        return found


@dataclass(frozen=True, eq=False)
class TraceScene:
    """Scene that rays are traced against: all proxy meshes merged into one, and visible shapes.

    Attributes:
        scene: Mitsuba scene of both.
        mesh: The merged proxy mesh; None if there is no proxy.
        instances: Instance id of each proxy triangle.
        corners: Positions of the corners of each proxy triangle [m], nine floats.
        normals: Normals at these corners, nine floats.
        materials: Materials at these corners; None if there is no proxy.
    """

    scene: mi.Scene
    mesh: mi.ShapePtr | None
    instances: mi.UInt32
    corners: mi.Float
    normals: mi.Float
    materials: CornerMaterials | None

    def nearest(self, ray: mi.Ray3f) -> Hit:
        """Return the first hits of rays."""
        si = self.scene.ray_intersect(ray, mi.RayFlags.UV, coherent=True)
        flip = dr.select(dr.dot(si.n, ray.d) > 0, -1.0, 1.0)
        face = si.n * flip
        hit = Hit.matt(si.t, face, face)
        if self.mesh is None:
            return hit
        proxy = si.is_valid() & (si.shape == self.mesh)
        normal, lift = self._smooth(si, flip, proxy)
        instance = dr.gather(mi.UInt32, self.instances, si.prim_index, proxy)
        hit = replace(hit, normal=dr.select(proxy, normal, face), lift=dr.select(proxy, lift, 0), instance=instance)
        if self.materials is None or not self.materials.glossy:
            return hit
        own = self.materials.at(si.prim_index, si.uv, proxy)
        gloss = {
            name: dr.select(proxy, getattr(own, name), getattr(hit, name))
            for name in ("metallic", "roughness", "specular")
        }
        return replace(hit, **gloss)

    def surface_at(self, triangle: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> SurfaceMaterial:
        """Return the materials at barycentric coordinates of proxy triangles."""
        if self.materials is None:
            return SurfaceMaterial(mi.Color3f(0), mi.Float(0), mi.Float(1), mi.Float(0))
        return self.materials.at(triangle, uv, active)

    def intersect(self, ray: mi.Ray3f, active: mi.Bool = True) -> mi.PreliminaryIntersection3f:
        """Return the first hits of rays that collect reflected light; single rays may pass between two triangles."""
        return self._scene_for(ray).ray_intersect_preliminary(ray, active=active)

    def _scene_for(self, ray: mi.Ray3f) -> mi.Scene:
        """Return the scene in which this number of rays is traced sooner."""
        many = dr.width(ray.d) > OPEN_EDGED_RAYS * self._primitives
        return self._open_edged if many else self.scene

    @cached_property
    def _primitives(self) -> int:
        return sum(shape.primitive_count() for shape in self.scene.shapes())

    @cached_property
    def _open_edged(self) -> mi.Scene:
        """The same shapes without watertight edges, which Embree intersects in three quarters of the time.

        OptiX is always watertight.
        """
        if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
            return self.scene
        return ray_scene({f"shape_{i}": shape for i, shape in enumerate(self.scene.shapes())}, watertight=False)

    def normal_at(self, triangle: mi.UInt32, active: mi.Bool) -> mi.Normal3f:
        """Return the unit normals of proxy triangles."""
        a, b, c = (dr.gather(mi.Point3f, self.corners, triangle * 3 + corner, active) for corner in range(3))
        return mi.Normal3f(dr.normalize(dr.cross(b - a, c - a)))

    def is_visible(self, hit: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Return True for hits on visible shapes."""
        return mi.Bool(True) if self.mesh is None else hit.shape != self.mesh

    def occluded(
        self, ray: mi.Ray3f, instance: mi.UInt32, key: mi.UInt32, active: mi.Bool, *, watertight: bool = True
    ) -> mi.Bool:
        """Return True for occluded rays."""
        return (self.scene if watertight else self._scene_for(ray)).ray_test(ray, active=active)

    def _smooth(self, si: mi.SurfaceInteraction3f, flip: mi.Float, proxy: mi.Bool) -> tuple[mi.Normal3f, mi.Normal3f]:
        """Return the interpolated normal, and the displacement to the convex surface through a triangle's corners.

        That surface is the mean of the projections on the corners' tangent planes. From there, grazing light is not
        shadowed by adjacent triangles (Hanika 2021, "Hacking the Shadow Terminator", Ray Tracing Gems II, chapter 4).
        """
        weights = 1 - si.uv.x - si.uv.y, si.uv.x, si.uv.y
        normal, lift = mi.Normal3f(0), mi.Vector3f(0)
        for corner, weight in enumerate(weights):
            index = si.prim_index * 3 + corner
            own = dr.gather(mi.Normal3f, self.normals, index, proxy) * flip
            above = dr.dot(dr.gather(mi.Point3f, self.corners, index, proxy) - si.p, own)
            normal += own * weight
            lift += own * (dr.maximum(above, 0) * weight)
        return mi.Normal3f(dr.normalize(normal)), lift

    @classmethod
    def build(cls, occluders: Sequence[Occluder], visible: Sequence[mi.Shape] = ()) -> TraceScene | None:
        """Merge occluders and visible shapes; return None if there are none."""
        others = {f"visible_{i}": shape for i, shape in enumerate(visible)}
        occluders = [o for o in occluders if len(o.mesh.faces)]
        if not occluders:
            if not others:
                return None
            nothing = mi.Float([0.0] * 9)
            return cls(ray_scene(others), None, mi.UInt32([0]), nothing, nothing, None)
        parts = tuple(o.part for o in occluders)
        return _merged_scene(parts, others) if others else _cached_scene(parts, str(mi.variant()))


@lru_cache(maxsize=3)
def _cached_scene(parts: tuple[ProxyPart, ...], _variant: str) -> TraceScene:
    """Return the merged meshes, cached for the static ones of all layouts and the last dynamic and reflecting ones."""
    return _merged_scene(parts, {})


def _merged_scene(parts: tuple[ProxyPart, ...], others: Mapping[str, mi.Shape]) -> TraceScene:
    corners, normals, numbers = [], [], []
    for part in parts:
        own_corners, own_normals = world_corners(part)
        corners.append(own_corners)
        normals.append(own_normals)
        numbers.append(np.full(len(own_corners) // 3, part.instance, np.uint32))
    positions = wrapped(mi.Float, np.concatenate(corners).astype(np.float32))
    count = sum(len(c) for c in corners)
    mesh = mi.Mesh("proxies", count, count // 3)
    params = mi.traverse(mesh)
    params["vertex_positions"] = positions
    params["faces"] = dr.arange(mi.UInt32, count)
    params.update()
    return TraceScene(
        ray_scene({"mesh": mesh, **others}),
        dr.opaque(mi.ShapePtr, mesh),  # a literal shape number would enter the kernels and change with every layout
        wrapped(mi.UInt32, np.concatenate(numbers)),
        positions,
        wrapped(mi.Float, np.concatenate(normals).astype(np.float32)),
        CornerMaterials.of(list(parts)),
    )


def world_corners(part: ProxyPart) -> tuple[Float64Array, Float64Array]:
    """Return corners [m] and unit normals (3 T, 3) of the triangles of a placement in world space."""
    world_from_mesh = np.frombuffer(part.pose).reshape(4, 4)
    turn, shift = world_from_mesh[:3, :3], world_from_mesh[:3, 3]
    corners, normals = _own_corners(part.mesh, part.splats)
    return corners @ turn.T + shift, normals @ (turn / np.cbrt(np.linalg.det(turn))).T


@lru_cache(maxsize=64)
def _own_corners(mesh: trimesh.Trimesh, splats: Splats | None) -> tuple[Float64Array, Float64Array]:
    """Return corners and normals (3 T, 3) of the triangles in the frame of the mesh, cached across layouts."""
    own = [mesh.triangles, smooth_normals(mesh).reshape(-1, 3, 3)]
    divided = material_triangles(mesh, splats)
    if divided is not None:
        own = [divided.interpolate(values) for values in own]
        own[1] /= np.linalg.norm(own[1], axis=2, keepdims=True)
    return own[0].reshape(-1, 3), own[1].reshape(-1, 3)
