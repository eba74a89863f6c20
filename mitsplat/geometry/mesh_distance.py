"""Signed distances between placed meshes, computed by mesh queries of Warp."""

# Kernels are Python by syntax only.
# mypy: disable-error-code="attr-defined, index, no-untyped-call, untyped-decorator"

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import trimesh
import warp as wp

from mitsplat.arrays import Float32Array, Float64Array, Int64Array
from mitsplat.geometry.mesh import contact_points
from mitsplat.geometry.rigid import transform_points
from mitsplat.geometry.solids import join_meshes
from mitsplat.runtime.warp_start import quiet_warp

_SAMPLES, _BATCH = 4000, 256
ROUNDING_ERROR = 1e-6
"""Upper bound of the error of distances in single precision [m]."""
_FAR = 1e6  # beyond the distance of any inside point from its surface [m]


class DistanceSurface:
    """Mesh for distance queries, with the points that touch another mesh first.

    Inside and outside are defined by the generalised winding number (Jacobson et al., *Robust Inside-Outside
    Segmentation using Generalized Winding Numbers*, 2013). Holes in a scan are therefore harmless.

    Attributes:
        points: Contact points in the mesh's frame [m], shape (N, 3).
    """

    @quiet_warp()
    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.points = contact_points(mesh)
        self._mesh = _warp_mesh(mesh, winding_number=True)

    @quiet_warp()
    def signed_distances(self, points: Float64Array) -> Float32Array:
        """Return the distance of each point (N, 3) [m], in the mesh's frame, to the surface; negative inside."""
        distances = wp.empty(len(points), dtype=wp.float32, device="cpu")
        _query(_signed_distances, self._mesh, points, [distances])
        found: Float32Array = np.array(distances.numpy())
        return found

    @quiet_warp()
    def nearest(self, points: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return the surface points (N, 3) nearest to ``points`` (N, 3), unit normals (N, 3) and distances (N,)."""
        positions, normals = (wp.empty(len(points), dtype=wp.vec3, device="cpu") for _ in range(2))
        _query(_nearest_points, self._mesh, points, [positions, normals])
        found = positions.numpy().astype(np.float64)
        return found, normals.numpy().astype(np.float64), np.linalg.norm(found - points, axis=1)


@quiet_warp()
def nearest_faces(mesh: trimesh.Trimesh, points: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Return the nearest faces (N,) of a mesh to ``points`` (N, 3), and barycentric coordinates (N, 3) on them."""
    faces = wp.zeros(len(points), dtype=wp.int32, device="cpu")
    weights = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    _query(_nearest_faces, _warp_mesh(mesh), points, [faces, weights])
    return faces.numpy().astype(np.int64), weights.numpy().astype(np.float64)


def _warp_mesh(mesh: trimesh.Trimesh, *, winding_number: bool = False) -> wp.Mesh:
    return wp.Mesh(
        points=wp.array(np.asarray(mesh.vertices, np.float32), dtype=wp.vec3, device="cpu"),
        indices=wp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=winding_number,
    )


def _query(kernel: wp.Kernel, mesh: wp.Mesh, points: Float64Array, outputs: list[wp.array[Any]]) -> None:
    """Run a kernel that queries a mesh at points (N, 3)."""
    inputs = [mesh.id, wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu"), _FAR]
    wp.launch(kernel, dim=len(points), inputs=inputs, outputs=outputs, device="cpu")


class PlacedSurface:
    """Surface at a pose.

    Attributes:
        name: Name of the surface.
        size: Longest extent [m], to which tolerances relate.
        points: Contact points in world space [m], shape (N, 3).
        bounds: Corners of their bounding box, shape (2, 3).
    """

    def __init__(self, name: str, surface: DistanceSurface, world_from_surface: Float64Array | None = None) -> None:
        pose = np.eye(4) if world_from_surface is None else world_from_surface
        self.name = name
        self.points = transform_points(pose, surface.points)
        self.bounds = np.stack([self.points.min(axis=0), self.points.max(axis=0)])
        self.size = float(np.ptp(surface.points, axis=0).max())
        self._surface, self._pose = surface, pose

    def signed_distance(self, points: Float64Array, reach: float) -> float:
        """Return the smallest signed distance [m] of world-space points (N, 3), at most ``reach``."""
        near = points[((points > self.bounds[0] - reach) & (points < self.bounds[1] + reach)).all(axis=1)]
        if not len(near):
            return reach
        return min(reach, float(self.signed_distances(near).min()))

    def signed_distances(self, points: Float64Array) -> Float32Array:
        """Return the distance of each world-space point (N, 3) [m] to the surface; negative inside."""
        return self._surface.signed_distances((points - self._pose[:3, 3]) @ self._pose[:3, :3])


@dataclass(frozen=True)
class Clearance:
    """Clearance of a pair of surfaces.

    Distances are measured at vertices and edge samples. Faces that overlap exactly flush (two equal boxes shifted along
    one axis) are therefore not detected; resting objects are never so aligned.

    Attributes:
        first, second: The surfaces.
        distance: Smallest distance [m]. If the surfaces overlap, minus the depth of the deepest point.
    """

    first: PlacedSurface
    second: PlacedSurface
    distance: float


def clearance(first: PlacedSurface, second: PlacedSurface, *, reach: float) -> Clearance:
    """Return the smallest signed distance [m] between two surfaces, at most ``reach``."""
    apart = (first.bounds[0] > second.bounds[1] + reach) | (second.bounds[0] > first.bounds[1] + reach)
    if apart.any():
        return Clearance(first, second, reach)
    distance = second.signed_distance(first.points, reach)
    # In the other direction only smaller distances matter. Overlaps always matter, because the meshes may have holes.
    nearer = reach if distance < 0 else distance + ROUNDING_ERROR
    return Clearance(first, second, min(distance, first.signed_distance(second.points, nearer)))


def all_clearances(
    objects: Sequence[PlacedSurface], colliders: Sequence[PlacedSurface], *, reach: float
) -> list[Clearance]:
    """Return the clearances between all objects, and between every object and every collider."""
    pairs = [*combinations(objects, 2), *((item, collider) for item in objects for collider in colliders)]
    return [clearance(first, second, reach=reach) for first, second in pairs]


def standoff(surface: DistanceSurface, pieces: Sequence[trimesh.Trimesh]) -> float:
    """Return the maximum distance of convex pieces from the mesh that they replace [m], which bounds gaps at rest.

    It is measured at vertices, at edges, and at 4000 points on faces.
    """
    samples, _ = trimesh.sample.sample_surface(join_meshes(pieces), _SAMPLES, seed=0)
    return max_outside_distance(surface, np.concatenate([*(contact_points(piece) for piece in pieces), samples]))


def max_outside_distance(
    surface: DistanceSurface, points: Float64Array, *, min_distance: float = 0.0, batch: int = _BATCH
) -> float:
    """Return the maximum distance from a mesh of those points (N, 3) that are outside of it [m].

    Distances below ``min_distance`` count as 0. The side of a point costs ten times as much as its distance. Sides are
    therefore computed in order of decreasing distance, and only up to the first ``batch`` that contains an outside
    point.
    """
    distances = surface.nearest(points)[2]
    farthest_first = np.argsort(-distances, kind="stable")[: int((distances >= min_distance).sum())]
    for start in range(0, len(farthest_first), batch):
        distance = float(surface.signed_distances(points[farthest_first[start : start + batch]]).max())
        if distance > 0:
            return distance
    return 0.0


@wp.kernel(enable_backward=False, module="unique")
def _signed_distances(mesh: wp.uint64, points: wp.array[wp.vec3], reach: float, distances: wp.array[float]) -> None:
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach, 2.0, 0.5)
    distances[i] = reach
    if query.result:
        nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distances[i] = query.sign * wp.length(points[i] - nearest)


@wp.kernel(enable_backward=False, module="unique")
def _nearest_points(
    mesh: wp.uint64, points: wp.array[wp.vec3], reach: float, positions: wp.array[wp.vec3], normals: wp.array[wp.vec3]
) -> None:
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
    if query.result:
        positions[i] = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        normals[i] = wp.mesh_eval_face_normal(mesh, query.face)


@wp.kernel(enable_backward=False, module="unique")
def _nearest_faces(
    mesh: wp.uint64, points: wp.array[wp.vec3], reach: float, faces: wp.array[int], weights: wp.array[wp.vec3]
) -> None:
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
    if query.result:
        faces[i] = query.face
        weights[i] = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
