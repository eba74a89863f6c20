"""Surface of a mesh with all its parts: hits of rays, base colours and materials at its points."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import Float32Array, Float64Array, Int64Array
from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import Surfels, place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.path_tracing import antialiased_picture
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, wrapped

_FOOTPRINT_SAMPLES = 16
"""Surface points whose mean is the material of a surfel."""
_SHEET_LIFT = 3.0
"""Height of surfels above a sheet without thickness, in their standard deviations along the normal."""
_BACK_RAYS = 20_000
"""Number of chords of a sphere around the mesh that find backs of faces."""
_ALIKE = 0.8
"""Minimum cosine between the normal of a surfel and those of the points that it averages."""


class MeshSurface:
    """Parts of a mesh as one surface.

    Attributes:
        mesh: Geometry of all parts [m].
    """

    def __init__(self, parts: Sequence[MeshPart]) -> None:
        self.mesh: trimesh.Trimesh = trimesh.util.concatenate([part.mesh for part in parts])
        self._parts = parts
        self._first = np.cumsum([0, *(len(part.mesh.faces) for part in parts)])
        self._double_sided = np.repeat([part.double_sided for part in parts], np.diff(self._first))
        self._scene = ray_scene(
            {"surface": plain_mesh(trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, process=False))}
        )

    def trace(self, rays: mi.Ray3f) -> tuple[Int64Array, Float64Array, Float64Array]:
        """Return faces (N,), barycentric coordinates (N, 3) and distances (N,) [m] of first hits; face -1 is a miss."""
        hit = self._scene.ray_intersect_preliminary(rays)
        uv = dr.select(dr.isfinite(hit.t), hit.prim_uv, 0.0)  # misses leave it uninitialised
        dr.eval(hit.t, hit.prim_index, uv)
        distance, index = np.asarray(hit.t, dtype=np.float64), np.asarray(hit.prim_index).astype(np.int64)
        u, v = np.asarray(uv, dtype=np.float64)
        is_hit = np.isfinite(distance)
        return np.where(is_hit, index, -1), np.where(is_hit, (1 - u - v, u, v), 0.0).T, distance

    def parts_of(self, faces: Int64Array) -> Int64Array:
        """Return the positions (N,) of the parts of faces (N,)."""
        return np.searchsorted(self._first, faces, side="right") - 1

    def share_of_backs(self, rng: np.random.Generator) -> float:
        """Return the share of visible points that are backs of one-sided faces, seen through openings of the mesh."""
        random = rng.normal(size=(2, _BACK_RAYS, 3))
        start, end = random / np.linalg.norm(random, axis=2, keepdims=True)
        middle = self.mesh.bounds.mean(axis=0)
        radius = 0.5 * float(np.linalg.norm(self.mesh.extents))
        origins, ways = middle + 1.5 * radius * start, radius * end - 1.5 * radius * start
        rays = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(ways.T.astype(np.float32)))
        faces, _, _ = self.trace(rays)
        cosine = np.einsum("nd,nd->n", self.mesh.face_normals[faces], ways)
        is_back = (cosine > 0.05 * np.linalg.norm(ways, axis=1)) & ~self._double_sided[faces]
        return float(is_back[faces >= 0].mean()) if (faces >= 0).any() else 0.0

    def place_surfels(self, density: Float64Array, count: int, rng: np.random.Generator) -> Surfels:
        """Place about ``count`` surfels with a relative ``density`` (F,), on both sides of double-sided faces."""
        if not self._double_sided.any():
            return place_surfels(self.mesh, density, count, rng)
        behind = np.flatnonzero(self._double_sided)
        backs = trimesh.Trimesh(self.mesh.vertices, self.mesh.faces[behind][:, ::-1], process=False)
        sides = trimesh.util.concatenate([trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, process=False), backs])
        own = np.concatenate([np.arange(len(self.mesh.faces)), behind])
        surfels = place_surfels(sides, density[own], count, rng)
        is_back = surfels.faces >= len(self.mesh.faces)
        barycentric = np.where(is_back[:, None], surfels.barycentric[:, ::-1], surfels.barycentric)
        faces = own[surfels.faces]
        # A sheet has no thickness: its Gaussians lie on their own side of it, so that they cover those of the other.
        lift = np.where(self._double_sided[faces], _SHEET_LIFT * surfels.scales[:, 2], 0.0)
        points = surfels.points + lift[:, None] * surfels.normals
        return Surfels(points, surfels.frames, surfels.scales, faces, barycentric)

    def base_colours(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return linear base colours (N, 3) at points of faces."""
        return self._gather(MeshPart.colours_at, faces, barycentric)

    def materials(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return metallic, roughness and specular, shape (N, 3)."""
        return self._gather(MeshPart.materials_at, faces, barycentric)

    def normals(self, faces: Int64Array, barycentric: Float64Array) -> Float64Array:
        """Return shading normals (N, 3), with the normal maps applied."""
        return self._gather(MeshPart.normals_at, faces, barycentric)

    def _gather(
        self,
        values: Callable[[MeshPart, Int64Array, Float64Array], Float64Array],
        faces: Int64Array,
        barycentric: Float64Array,
    ) -> Float64Array:
        """Return the values (N, 3) of each part at points of its faces."""
        found = np.zeros((len(faces), 3))
        for part, first, end in zip(self._parts, self._first, self._first[1:], strict=False):
            own = np.flatnonzero((faces >= first) & (faces < end))
            if len(own):
                found[own] = values(part, faces[own] - first, barycentric[own])
        return found

    def sample_surfels(self, surfels: Surfels, rng: np.random.Generator) -> tuple[Float64Array, SplatMaterials]:
        """Return display-encoded base colours (N, 3) and materials of surfels, averaged over their footprints."""
        count, lift = len(surfels), 0.3 * surfels.scales[:, None, :1]
        offset = np.clip(rng.normal(size=(count, _FOOTPRINT_SAMPLES, 2)), -1.5, 1.5) * 0.5 * surfels.scales[:, None, :2]
        outward = np.broadcast_to(surfels.normals[:, None], (count, _FOOTPRINT_SAMPLES, 3))
        origins = surfels.points[:, None] + np.einsum("nij,nmj->nmi", surfels.frames[:, :, :2], offset) + lift * outward
        rays = mi.Ray3f(
            mi.Point3f(*(wrapped(mi.Float, axis.astype(np.float32)) for axis in origins.reshape(-1, 3).T)),
            mi.Vector3f(*(wrapped(mi.Float, axis.astype(np.float32)) for axis in -outward.reshape(-1, 3).T)),
        )
        faces, barycentric, distance = self.trace(rays)
        own = np.repeat(np.arange(count), _FOOTPRINT_SAMPLES)
        near = (faces >= 0) & (distance < 1.2 * surfels.scales[own, 0])
        cosine = np.einsum("nd,nd->n", self.mesh.face_normals[faces], surfels.normals[own])
        near &= np.where(self._double_sided[faces], np.abs(cosine), cosine) > _ALIKE
        faces = np.where(near, faces, surfels.faces[own])
        barycentric = np.where(near[:, None], barycentric, surfels.barycentric[own])

        def mean(values: Float64Array) -> Float64Array:
            return np.asarray(values.reshape(count, _FOOTPRINT_SAMPLES, -1).mean(axis=1))

        metallic, roughness, specular = mean(self.materials(faces, barycentric)).T.clip(0, 1).astype(np.float32)
        normals: Float32Array | None = None
        if any(part.normal_map is not None for part in self._parts):
            shading = mean(self.normals(faces, barycentric))
            shading *= np.where(np.einsum("nd,nd->n", shading, surfels.normals) < 0, -1.0, 1.0)[:, None]
            normals = (shading / np.linalg.norm(shading, axis=1, keepdims=True)).astype(np.float32)
        colours = encode_srgb(mean(self.base_colours(faces, barycentric)))
        return colours, SplatMaterials(metallic, roughness, specular, normals)

    def picture(self, camera: Camera, samples: int, _seed: int = 0) -> tuple[Float64Array, Float64Array]:
        """Return antialiased linear base colours (H, W, 3), black for background, and coverage (H, W)."""

        def mean_colours(rays: mi.Ray3f, samples: int, _launch: int) -> tuple[Float64Array, Float64Array]:
            faces, barycentric, _ = self.trace(rays)
            colours = self.base_colours(faces, barycentric).reshape(-1, samples, 3)
            return colours.mean(axis=1), (faces >= 0).reshape(-1, samples).mean(axis=1)

        return antialiased_picture(camera, samples, mean_colours)
