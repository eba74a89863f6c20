"""Displayed parts as plain values: splats, meshes, lines, points and cameras with their poses.

The name of a part is a path, ``/group/name``; a group is shown or hidden as a whole. If two parts of one name differ
only in their pose, only the pose is sent to browsers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture
from mitsplat.gaussians.spherical_harmonics import sh_to_rgb
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.geometry.rigid import homogeneous_matrix, transform_points
from mitsplat.labels.overlay import class_colour
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import layout_at_view
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.scene.planning.viewpoints import viewpoint_of
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightSpec, RoomLight, SpotLight
from mitsplat.scene.spec.shape_spec import Region
from mitsplat.scene.walls import ENCLOSURE

Colour = tuple[int, int, int]

HIDDEN_AT_START = frozenset({"meshes", "pieces", "colliders", "enclosure", "other cameras"})
"""Groups that are hidden initially."""

MAX_CAMERAS = 200
"""Maximum number of evenly spaced camera frusta, and of frusta of the current layout."""

_GREY, _WALL, _REGION, _LIGHT, _CAMERA, _OTHER = (
    (150, 150, 150),
    (90, 140, 220),
    (60, 180, 90),
    (255, 190, 40),
    (220, 70, 60),
    (120, 120, 120),
)
_CONE_LENGTH = 0.15
"""Length of the lines that show the cone of a spot light [m]."""
_RING = np.linspace(0, 2 * np.pi, 25)
_EDGES = np.array([[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]])
"""Edges of a box, whose corner ``i`` is low or high along x, y, z by the bits of ``i``."""


@dataclass(frozen=True, eq=False)
class ShownSplats:
    """Gaussians, drawn with their direction-independent colours; ``share`` is the part of them that is drawn."""

    splats: Splats
    share: float = 1.0

    @property
    def count(self) -> int:
        """Number of drawn Gaussians, at least one."""
        return max(1, int(self.share * len(self.splats)))

    def thinned(self) -> Splats:
        """Return the drawn Gaussians.

        Every n-th Gaussian is taken and enlarged by the square root of n, so that surfaces stay covered.
        """
        count = len(self.splats)
        if self.share == 1.0:
            return self.splats
        sample = self.splats.select(np.linspace(0, count - 1, self.count).astype(int))
        return replace(sample, scales=sample.scales * np.float32(np.sqrt(count / self.count)))


@dataclass(frozen=True, eq=False)
class ShownMesh:
    """Mesh of one colour, opaque or transparent."""

    mesh: trimesh.Trimesh
    colour: Colour
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Lines:
    """Line segments, shape (N, 2, 3) [m]."""

    segments: Float64Array
    colour: Colour


@dataclass(frozen=True, eq=False)
class ShownPoints:
    """Points, shape (N, 3), with 8-bit colours of the same shape, drawn with an edge of ``size``."""

    points: Float64Array
    colours: npt.NDArray[np.uint8]
    size: float | None = None

    @property
    def edge(self) -> float:
        """Edge of a drawn point."""
        if self.size is not None:
            return self.size
        return 0.002 * float(np.linalg.norm(np.ptp(self.points, axis=0))) if len(self.points) else 0.002


@dataclass(frozen=True, eq=False)
class Frustum:
    """Camera frustum of the given ``depth`` [m]; a click moves the view to the camera of frame or photo ``index``."""

    camera: Camera
    depth: float
    colour: Colour
    index: int


Drawable = ShownSplats | ShownMesh | Lines | ShownPoints | Frustum


@dataclass(frozen=True, eq=False)
class ShownPart:
    """Drawable with its pose.

    Attributes:
        name: Path in the tree of displayed parts, ``/group/name``.
        drawable: Geometry to display.
        pose: ``world_from_drawable``, rotation and translation [m], shape (4, 4).
    """

    name: str
    drawable: Drawable
    pose: Float64Array = field(default_factory=lambda: np.eye(4))

    @property
    def group(self) -> str:
        """Group with which the part is shown or hidden."""
        return self.name.split("/")[1]


def share_gaussians(parts: Iterable[ShownPart], most: int) -> tuple[list[ShownPart], int]:
    """Return parts that draw at most ``most`` Gaussians together, and the number of all their Gaussians.

    All clouds draw the same share, because a browser sorts and draws the Gaussians of all clouds together. Shares are
    powers of the square root of 1/2, so that adding or removing one object seldom changes the share of all clouds.
    """
    parts = list(parts)
    count = sum(len(part.drawable.splats) for part in parts if isinstance(part.drawable, ShownSplats))
    if count <= most:
        return parts, count
    share = float(0.5 ** (np.ceil(2 * np.log2(count / most)) / 2))
    return [
        replace(part, drawable=replace(part.drawable, share=share)) if isinstance(part.drawable, ShownSplats) else part
        for part in parts
    ], count


def look_same(one: Any, other: Any) -> bool:
    """Return True if two drawables, or their fields, look the same, so that nothing must be sent again."""
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, trimesh.Trimesh):
        return look_same(np.asarray(one.vertices), np.asarray(other.vertices)) and look_same(
            np.asarray(one.faces), np.asarray(other.faces)
        )
    if is_dataclass(one):
        return all(look_same(getattr(one, entry.name), getattr(other, entry.name)) for entry in fields(one))
    return np.array_equal(one, other)


def base_colours(splats: Splats) -> Float32Array:
    """Return the direction-independent, display-encoded colours in [0, 1], shape (N, 3)."""
    return np.asarray(np.clip(sh_to_rgb(splats.sh[:, 0]), 0.0, 1.0), dtype=np.float32)


def scene_parts(
    scene: Scene, index: int, layout: Layout | None = None, lights: Sequence[LightSpec] = ()
) -> Iterator[ShownPart]:
    """Iterate over the parts of a scene in frame ``index``.

    Args:
        scene: The scene.
        index: Index of the frame.
        layout: Poses of the frame's objects; None omits the objects.
        lights: Lights of the frame.
    """
    number = index // scene.spec.output.views
    environment = scene.environment_of(number)
    if environment is not None:
        yield ShownPart("/splats/environment", ShownSplats(environment.splats))
        if environment.mesh is not None:
            yield ShownPart("/meshes/environment", ShownMesh(environment.mesh, _GREY, 0.6))
    if layout is not None:
        yield from _object_parts(scene, layout)
    for placed in placed_shapes(scene, number):
        shape, mesh = placed.shape, placed.mesh
        if shape.visible:
            red, green, blue = (round(255 * value) for value in shape.colour)
            yield ShownPart(f"/shapes/{shape.name}", ShownMesh(mesh, (red, green, blue)))
        else:
            walls = shape.name.startswith(ENCLOSURE)
            colour, opacity = (_WALL, 0.15) if walls else (_GREY, 0.5)
            yield ShownPart(f"/{'enclosure' if walls else 'colliders'}/{shape.name}", ShownMesh(mesh, colour, opacity))
    for name, (region, _) in zip(scene.spec.region_names, scene.spec.all_regions, strict=True):
        yield ShownPart(f"/regions/{name}", Lines(_box_edges(region), _REGION))
    yield from light_parts(lights, scene)


def _object_parts(scene: Scene, layout: Layout) -> Iterator[ShownPart]:
    """Iterate over splats, proxy mesh and convex pieces of every object.

    Names are numbered per asset, so that a drop changes only poses.
    """
    counts = Counter[int]()
    for instance in layout.instances:
        asset = scene.assets[instance.asset]
        name = f"{instance.asset}-{asset.name}-{counts[instance.asset]}".replace("/", "_")
        counts[instance.asset] += 1
        yield from _asset_parts(asset, name, instance.world_from_object)


def _asset_parts(asset: Asset, name: str, pose: Float64Array) -> Iterator[ShownPart]:
    yield ShownPart(f"/splats/{name}", ShownSplats(asset.splats), pose)
    if asset.mesh is not None:
        yield ShownPart(f"/meshes/{name}", ShownMesh(asset.mesh, _GREY), pose)
    for number, piece in enumerate(asset.pieces):
        yield ShownPart(f"/pieces/{name}/{number}", ShownMesh(piece, class_colour(number), 0.7), pose)


def asset_parts(asset: Asset) -> Iterator[ShownPart]:
    """Iterate over the parts of an asset in its own frame."""
    yield from _asset_parts(asset, asset.name.replace("/", "_"), np.eye(4))
    if asset.keypoints:
        points = asset.keypoint_array
        yield ShownPart("/keypoints/all", ShownPoints(points, np.full(points.shape, (255, 60, 60), dtype=np.uint8)))


def capture_parts(capture: Capture) -> Iterator[ShownPart]:
    """Iterate over the points of a capture and its cameras."""
    yield ShownPart("/points/all", ShownPoints(capture.points, capture.colours))
    centres = np.array([photo.camera.centre for photo in capture.photos]).reshape(-1, 3)
    around = centres if not len(capture.points) else np.vstack([centres, np.median(capture.points, axis=0)])
    depth = 0.06 * float(np.linalg.norm(np.ptp(around, axis=0))) if len(around) > 1 else 0.1
    for index, photo in enumerate(capture.photos):
        yield ShownPart(
            f"/cameras/{index}", Frustum(photo.camera, depth, _CAMERA, index), photo.camera.world_from_camera
        )


def light_parts(lights: Sequence[LightSpec], scene: Scene | None = None) -> Iterator[ShownPart]:
    """Iterate over lights in their poses and sizes, and over the paths of a scene's lights."""
    for number, light in enumerate(lights):
        if isinstance(light, EnvironmentLight):
            continue
        if not isinstance(light, AreaLight | SpotLight):
            ball = ShownMesh(trimesh.creation.icosphere(2, 0.02), _LIGHT)
            yield ShownPart(f"/lights/{number}", ball, homogeneous_matrix(np.eye(3), light.position))
            continue
        pose = look_at_pose(light.position, light.target)
        if isinstance(light, AreaLight):
            width, height = light.size
            yield ShownPart(f"/lights/{number}", ShownMesh(_rectangle(width, height), _LIGHT, 0.85), pose)
        else:
            yield ShownPart(f"/lights/{number}", Lines(_cone(light.cone), _LIGHT), pose)
        aim = np.array([[light.position, light.target]], dtype=np.float64)
        yield ShownPart(f"/lights/{number}-aim", Lines(aim, _LIGHT))
    for number, entry in enumerate(() if scene is None else scene.spec.lights):
        if isinstance(entry, EnvironmentLight | RoomLight) or not entry.path:
            continue
        stops = np.array([key.position or entry.position for key in entry.path], dtype=np.float64)
        if len(stops) > 1:
            yield ShownPart(f"/lights/path-{number}", Lines(np.stack([stops[:-1], stops[1:]], axis=1), _LIGHT))


def camera_parts(scene: Scene, index: int, layout: Layout | None) -> Iterator[ShownPart]:
    """Iterate over the cameras of the frames of the current layout, and of other frames at even intervals."""
    views = scene.spec.output.views
    own = range(index // views * views, (index // views + 1) * views)
    spread = np.linspace(0, scene.num_frames - 1, min(scene.num_frames, MAX_CAMERAS)).astype(int)
    size = float(np.linalg.norm(np.subtract(scene.spec.region.max, scene.spec.region.min)))
    for frame in sorted({*own[:MAX_CAMERAS], *spread.tolist()}):
        there = None if layout is None or frame not in own else layout_at_view(scene, layout, frame % views)
        camera = viewpoint_of(scene, frame, there).camera
        group, colour = ("cameras", _CAMERA) if frame in own else ("other cameras", _OTHER)
        yield ShownPart(f"/{group}/{frame}", Frustum(camera, 0.15 * size, colour, frame), camera.world_from_camera)


def bounds_of(parts: Iterable[ShownPart]) -> Float64Array:
    """Return the minimum and maximum coordinates [m] of the central 96 % of splats and points, shape (2, 3)."""
    found = []
    for part in parts:
        if isinstance(part.drawable, ShownSplats | ShownPoints):
            points = part.drawable.splats.means if isinstance(part.drawable, ShownSplats) else part.drawable.points
            if len(points):
                low, high = np.percentile(points, (2, 98), axis=0)
                corners = transform_points(part.pose, _corners(low, high))
                found += [corners.min(axis=0), corners.max(axis=0)]
    return np.array([np.min(found, axis=0), np.max(found, axis=0)]) if found else np.array([[-0.5] * 3, [0.5] * 3])


def changes(
    shown: Mapping[str, ShownPart], wanted: Mapping[str, ShownPart]
) -> tuple[list[str], list[ShownPart], list[ShownPart]]:
    """Compare displayed and requested parts.

    Returns:
        Names to remove, parts to add, and parts of which only the pose changed.
    """
    kept = {name for name, part in wanted.items() if name in shown and look_same(shown[name].drawable, part.drawable)}
    moved = [wanted[name] for name in kept if not np.array_equal(shown[name].pose, wanted[name].pose)]
    return [name for name in shown if name not in kept], [wanted[n] for n in wanted if n not in kept], moved


def _corners(low: npt.ArrayLike, high: npt.ArrayLike) -> Float64Array:
    bits = np.arange(8)[:, None] >> np.arange(3) & 1
    return np.asarray(np.where(bits, np.asarray(high), np.asarray(low)), dtype=np.float64)


def _box_edges(region: Region) -> Float64Array:
    edges: Float64Array = _corners(region.min, region.max)[_EDGES]
    return edges


def _rectangle(width: float, height: float) -> trimesh.Trimesh:
    x, y = width / 2, height / 2
    corners = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)]
    return trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)


def _cone(half_angle: float) -> Float64Array:
    """Return the lines of a cone that opens along +z from the origin, shape (N, 2, 3) [m]."""
    along, across = _CONE_LENGTH * np.cos(np.radians(half_angle)), _CONE_LENGTH * np.sin(np.radians(half_angle))
    rim = np.stack([across * np.cos(_RING), across * np.sin(_RING), np.full_like(_RING, along)], axis=1)
    rays = np.stack([np.zeros((4, 3)), rim[:-1:6]], axis=1)
    return np.concatenate([np.stack([rim[:-1], rim[1:]], axis=1), rays])
