"""Cheap visibility prediction for view selection.

Surfaces are represented by points, spread evenly over the proxy meshes. The visible fraction of an object is predicted
on a raster whose cells match the spacing of the points. It is the share of the object's cells inside the image in which
no point of another object is nearer. Occlusion by visible shapes is tested with rays from the points to the camera. The
environment occludes nothing here. NumPy computes everything on the CPU, so that views do not depend on the device that
renders them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, cast

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_points import points_inside
from mitsplat.geometry.rigid import transform_points
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.storage.files import JsonObject

if TYPE_CHECKING:
    from mitsplat.scene.layout import Instance, Layout
    from mitsplat.scene.scene import Scene
    from mitsplat.scene.spec.camera_spec import Acceptance, Occlusion, Truncation

_MAX_POINTS = 40_000
"""Maximum number of points of all objects of a layout."""
_LARGEST_OBJECT_POINTS = 800
"""Number of points of the object with the largest surface."""
_MIN_POINTS = 100
_CELL_SIZE = 1.25
"""Size of a raster cell, in point spacings."""
_PARTLY_HIDDEN = (0.2, 0.9)
"""Range of visible fractions of a partly hidden object."""
_CUT = (0.05, 0.8)
"""Range of the share beyond the border of an object that the border cuts."""
_MAX_TESTS = 2_000_000
"""Maximum number of ray-triangle pairs that are tested together."""


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """Surface points of a layout, projected into the image of a camera.

    Attributes:
        camera: The camera.
        x, y, depth: Pixel positions [px] and depths [m] of the points, shape (P,).
        raster: Mask of the points in front of the camera and in the image or a margin of one image size around it,
            shape (P,).
        cell_size: Size of the raster cells [px].
        within: Share of the surface of each object that is in front of the camera and in the image, shape (N,).
        outside_raster: Share of each object outside of the raster, shape (N,).
    """

    camera: Camera
    x: Float64Array
    y: Float64Array
    depth: Float64Array
    raster: BoolArray
    cell_size: float
    within: Float64Array
    outside_raster: Float64Array


@dataclass(frozen=True, eq=False)
class PredictedView:
    """Predicted visibility of the labelled objects of a layout in a view.

    Attributes:
        visible: Visible fraction of each object, 0 outside of the image, shape (N,).
        beyond: Share of each object beyond the border of the image, shape (N,).
        in_view: Number of objects with enough visible pixels for a label.
        hidden: Number of those objects that are partly hidden by the rule of the scene file.
        cut: Number of those objects that the border cuts by the rule of the scene file.
    """

    visible: Float64Array
    beyond: Float64Array
    in_view: int
    hidden: int
    cut: int

    def to_json(self) -> JsonObject:
        """Return the counts as JSON values for the dataset."""
        return {"in_view": self.in_view, "hidden": self.hidden, "cut": self.cut}


class VisibilityPredictor:
    """Visibility prediction for the objects of a layout.

    Attributes:
        ids: Instance ids, shape (N,).
        labelled: Mask of the labelled instances, shape (N,).
        centres: Centre of the bounding box of each instance [m], shape (N, 3).
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        self._scene, self._layout = scene, layout
        instances = layout.instances
        self.ids = np.array([one.id for one in instances], dtype=np.int64)
        self.labelled = np.array([one.class_index is not None for one in instances], dtype=bool)
        samples = [_surface_points(scene)[one.asset] for one in instances]
        step = 1 + sum(map(len, samples)) // _MAX_POINTS
        samples = [points[::step] for points in samples]
        poses = [one.world_from_object for one in instances]
        placed = [transform_points(pose, points) for points, pose in zip(samples, poses, strict=True)]
        meshes = [_mesh(scene, one.asset) for one in instances]
        middles = [transform_points(pose, mesh.bounds.mean(axis=0)) for mesh, pose in zip(meshes, poses, strict=True)]
        self.centres: Float64Array = np.array(middles, dtype=np.float64).reshape(-1, 3)
        self._points: Float64Array = np.concatenate(placed) if placed else np.zeros((0, 3))
        self._counts = np.array([len(points) for points in placed], dtype=np.int64)
        self._owner = np.repeat(np.arange(len(instances)), self._counts)
        self._spacing = _spacing(scene) * float(np.sqrt(step))
        self._radii = np.array([np.linalg.norm(mesh.extents) / 2 for mesh in meshes])
        shapes = [placed.mesh for placed in placed_shapes(scene, layout.index) if placed.shape.visible]
        triangles = np.concatenate([np.zeros((0, 3, 3)), *(mesh.triangles for mesh in shapes)])
        self._occluders = _Occluders(triangles, self._points)
        here = scene.environment_of(layout.index)
        around = [] if here is None or here.mesh is None else [here.mesh]
        self._static_triangles = _Triangles(np.concatenate([triangles, *(mesh.triangles for mesh in around)]))

    @staticmethod
    @lru_cache(maxsize=2)
    def of(scene: Scene, layout: Layout) -> VisibilityPredictor:
        """Return the predictor of a layout, cached for its next frame."""
        return VisibilityPredictor(scene, layout)

    def project(self, camera: Camera) -> ProjectedPoints:
        """Project the surface points into the image of a camera."""
        count, owner = len(self.ids), self._owner
        pixel, depth = camera.project(self._points)
        x, y = np.ascontiguousarray(pixel.T)
        front = depth > camera.near
        with np.errstate(invalid="ignore"):
            inside = front & _within(x, y, camera, 0)
            # Distortion far outside of the image is undefined, and the raster must be finite.
            raster = front & _within(x, y, camera, 1)
        within, in_raster = (np.bincount(owner[some], minlength=count) / self._counts for some in (inside, raster))
        cell_size = 1.0
        if front.any():
            away = max(float(np.median(depth[front])), camera.near)
            cell_size = _CELL_SIZE * self._spacing * max(camera.fx, camera.fy) / away
        return ProjectedPoints(camera, x, y, depth, raster, cell_size, within, 1.0 - in_raster)

    def predict(
        self, projected: ProjectedPoints, occlusion: Occlusion | None, truncation: Truncation | None, min_pixels: int
    ) -> PredictedView:
        """Predict the visibility of the labelled objects in a view."""
        visible, beyond, seen = self._count_cells(projected)
        beyond = projected.outside_raster + (1.0 - projected.outside_raster) * beyond
        shown = self.labelled & (seen * projected.cell_size**2 >= min_pixels)
        hidden = cut = 0
        if occlusion is not None:
            hidden = int(np.count_nonzero(shown & _in_range(visible, _PARTLY_HIDDEN)))
        if truncation is not None:
            cut = int(np.count_nonzero(shown & _in_range(beyond, _CUT)))
        labelled = self.labelled
        return PredictedView(visible[labelled], beyond[labelled], int(np.count_nonzero(shown)), hidden, cut)

    def _count_cells(self, projected: ProjectedPoints) -> tuple[Float64Array, Float64Array, Int64Array]:
        """Return, for each object, visible fraction, share beyond the border, and number of visible raster cells."""
        count, camera, cell_size, depth = len(self.ids), projected.camera, projected.cell_size, projected.depth
        across = int(3 * camera.width / cell_size) + 2
        left, above = across // 3 + 1, int(camera.height / cell_size) + 2
        selected = np.flatnonzero(projected.raster)
        column, row = (np.floor(at[selected] / cell_size).astype(np.int64) for at in (projected.x, projected.y))
        key = (column + left + across * (row + above)) * count + self._owner[selected]
        order = np.argsort(key)
        selected, key = selected[order], key[order]
        # Take each object of a cell once, by its nearest point there. The nearest object of the cell is visible.
        first = _starts(key)
        nearest = selected[_first_minima(depth[selected], first)]
        owner, cell = self._owner[nearest], key[first] // count
        seen = np.zeros(len(first), dtype=bool)
        seen[_first_minima(depth[nearest], _starts(cell))] = True
        x, y = (np.asarray((n + 0.5) * cell_size, np.float64) for n in (cell % across - left, cell // across - above))
        shown = _within(x, y, camera, 0)
        seen &= shown
        triangles = self._occluders.towards(camera.centre)
        if len(triangles):
            seen[seen] = ~_occluded(camera.centre, self._points[nearest[seen]], triangles)
        seen_cells, own = (np.bincount(owner[some], minlength=count) for some in (seen, shown))
        everywhere = np.bincount(owner, minlength=count)
        beyond = np.where(everywhere > 0, 1.0 - own / np.maximum(everywhere, 1), 1.0)
        return seen_cells / np.maximum(own, 1), beyond, seen_cells

    def find_violations(self, projected: ProjectedPoints, rules: Acceptance) -> list[tuple[float, str]]:
        """Return the rules that a view violates: the relative shortfall, and a description."""
        found, eye = [], projected.camera.centre
        within = projected.within[self.labelled]
        share = float(np.mean(within >= 0.5)) if len(within) else 1.0
        if share < rules.in_view:
            text = f"shows {share:.3g} of the labelled objects, but in_view is {rules.in_view:g}"
            found.append((1 - share / rules.in_view, text))
        away = self._clearance(eye, rules.clearance)
        if name := containing_solid(self._scene, self._layout, eye, self._near(eye, 0.0)):
            found.append((1.0, f"is inside {name}"))
        elif away < rules.clearance:
            text = f"is {away:.3g} m from the nearest surface, but clearance is {rules.clearance:g}"
            found.append((1 - away / rules.clearance, text))
        return found

    def _clearance(self, eye: Float64Array, reach: float) -> float:
        """Return the distance from a point to the nearest surface [m], at most ``reach``."""
        distance = self._static_triangles.distance(eye, reach)
        for one in self._near(eye, distance):
            triangles = _Triangles(np.asarray(_mesh(self._scene, one.asset).triangles))
            distance = triangles.distance(_local(eye, one.world_from_object), distance)
        return distance

    def _near(self, eye: Float64Array, reach: float) -> list[Instance]:
        """Return the instances whose bounding spheres come within ``reach`` [m] of a point."""
        near = np.linalg.norm(self.centres - eye, axis=1) < self._radii + reach
        return [one for one, is_near in zip(self._layout.instances, near, strict=True) if is_near]


def containing_solid(
    scene: Scene, layout: Layout, point: Float64Array, instances: Sequence[Instance] | None = None
) -> str:
    """Return the description of the visible shape or the object that contains a point [m]; empty if none does.

    ``instances`` are the objects to test, by default all of the layout.
    """
    if name := enclosing_shape(scene, point, layout.index):
        return f"shape {name!r}"
    for one in layout.instances if instances is None else instances:
        mesh = _mesh(scene, one.asset)
        if points_inside(mesh, _local(point, one.world_from_object)[None])[0]:
            return f"object {one.id} ({scene.assets[one.asset].name})"
    return ""


def enclosing_shape(scene: Scene, point: Float64Array, layout: int = 0) -> str:
    """Return the name of a visible shape that contains a point [m] and not the centre of the region, or empty."""
    middle = (np.array(scene.spec.region.min) + scene.spec.region.max) / 2
    for placed in placed_shapes(scene, layout):
        low, high = placed.bounds
        if not placed.shape.visible or not ((point > low) & (point < high)).all():
            continue
        if points_inside(placed.mesh, np.stack([point, middle])).tolist() == [True, False]:
            return placed.shape.name
    return ""


@lru_cache(maxsize=2)
def _surface_points(scene: Scene) -> tuple[Float64Array, ...]:
    """Return points on the surface of each asset, in its frame [m], with equal density on all assets."""
    spacing = _spacing(scene)
    points = []
    for asset in range(len(scene.assets)):
        mesh = _mesh(scene, asset)
        samples, _ = trimesh.sample.sample_surface(mesh, max(_MIN_POINTS, round(mesh.area / spacing**2)), seed=0)
        points.append(np.asarray(samples, dtype=np.float64))
    return tuple(points)


def _spacing(scene: Scene) -> float:
    """Return the approximate distance between surface points [m]."""
    return float(
        np.sqrt(max(asset.mesh.area for asset in scene.assets if asset.mesh is not None) / _LARGEST_OBJECT_POINTS)
    )


def _mesh(scene: Scene, asset: int) -> trimesh.Trimesh:
    return cast(trimesh.Trimesh, scene.assets[asset].mesh)  # loading refuses objects without a mesh


def _local(point: Float64Array, pose: Float64Array) -> Float64Array:
    return np.asarray((point - pose[:3, 3]) @ pose[:3, :3], dtype=np.float64)


def _within(x: Float64Array, y: Float64Array, camera: Camera, margin: int) -> BoolArray:
    """Return a mask of the pixels in the image of a camera, extended on each side by ``margin`` image sizes."""
    width, height = camera.size
    inside = (x >= -margin * width) & (x < (1 + margin) * width)
    return np.asarray(inside & (y >= -margin * height) & (y < (1 + margin) * height))


def _starts(key: Int64Array) -> Int64Array:
    """Return the start index of each run of equal numbers."""
    begins = np.ones(len(key), dtype=bool)
    begins[1:] = key[1:] != key[:-1]
    return np.flatnonzero(begins)


def _first_minima(values: Float64Array, starts: Int64Array) -> Int64Array:
    """Return the index of the first minimum of each run. Runs begin at ``starts``."""
    if not len(starts):
        return starts
    least = np.minimum.reduceat(values, starts)
    equals = np.flatnonzero(values == np.repeat(least, np.diff(starts, append=len(values))))
    return equals[np.searchsorted(equals, starts)]


def _in_range(values: Float64Array, bounds: tuple[float, float]) -> BoolArray:
    return np.asarray((values >= bounds[0]) & (values <= bounds[1]))


class _Triangles:
    """Triangles (T, 3, 3) [m] with bounding boxes, which exclude most of them from distance tests."""

    def __init__(self, triangles: Float64Array) -> None:
        self._triangles = triangles
        by_axis = np.ascontiguousarray(np.moveaxis(triangles, 2, 0))
        self._boxes = list(zip(by_axis.min(axis=2), by_axis.max(axis=2), strict=True))

    def distance(self, point: Float64Array, reach: float) -> float:
        """Return the distance from a point to the nearest triangle [m], at most ``reach``."""
        touched = np.ones(len(self._triangles), dtype=bool)
        for (low, high), place in zip(self._boxes, point, strict=True):
            touched &= (low < place + reach) & (high > place - reach)
        near = self._triangles[touched]
        if not len(near):
            return reach
        closest = trimesh.triangles.closest_point(near, np.broadcast_to(point, (len(near), 3)))
        return min(reach, float(np.linalg.norm(closest - point, axis=1).min()))


class _Occluders:
    """Triangles (T, 3, 3) [m] that may hide points from an eye."""

    def __init__(self, triangles: Float64Array, points: Float64Array) -> None:
        self._triangles = triangles if len(points) else triangles[:0]
        if not len(self._triangles):
            return
        low, high = points.min(axis=0), points.max(axis=0)
        self._normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        corners = np.stack(np.meshgrid(*np.stack([low, high]).T, indexing="ij"), axis=-1).reshape(-1, 3)
        there = np.einsum("ti,tci->tc", self._normals, corners - triangles[:, :1])
        # Objects penetrate their support by less than 0.1 mm.
        slack = 1e-4 * np.linalg.norm(self._normals, axis=1)
        self._reach_front = there.max(axis=1) > slack
        self._reach_back = there.min(axis=1) < -slack

    def towards(self, eye: Float64Array) -> Float64Array:
        """Return the triangles that can intersect a line of sight from a point [m].

        A triangle cannot if the bounding box of the points is on the same side of its plane as the eye.
        """
        if not len(self._triangles):
            return self._triangles
        here = np.einsum("ti,ti->t", self._normals, eye - self._triangles[:, 0])
        return np.asarray(self._triangles[((here > 0) & self._reach_back) | ((here < 0) & self._reach_front)])


def _occluded(eye: Float64Array, points: Float64Array, triangles: Float64Array) -> BoolArray:
    """Return a mask of the points (N, 3) whose line of sight from the eye hits a triangle (Möller, Trumbore 1997)."""
    crossed = np.zeros(len(points), dtype=bool)
    one, two = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    start = eye - triangles[:, 0]
    turned = np.cross(start, one)
    height = np.einsum("ti,ti->t", two, turned)
    for part in np.array_split(np.arange(len(points)), 1 + len(points) * len(triangles) // _MAX_TESTS):
        ray = points[part] - eye
        across = np.cross(ray[:, None], two[None])
        volume = np.einsum("pti,ti->pt", across, one)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("pti,ti->pt", across, start) / volume
            v = ray @ turned.T / volume
            along = height / volume
        crossed[part] = ((u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0) & (along < 1 - 1e-3)).any(axis=1)
    return crossed
