"""Walls that decide where objects may be: those of bins, and those that an enclosure is written out as."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.scene.spec.object_spec import ObjectPose
from mitsplat.scene.spec.scene_spec import BACKDROP, SceneSpec
from mitsplat.scene.spec.shape_spec import Backdrop, Bin, Box, Enclosure, Region, Shape
from mitsplat.storage.field_types import Vec3

if TYPE_CHECKING:
    from mitsplat.asset import Asset


ENCLOSURE = "enclosure "
"""How the names of the shapes begin that an enclosure is written out as."""

BACKDROP_THICKNESS = 0.1
"""Of a backdrop's floor and walls [m]."""

PILE_HEIGHT = 1.0
"""How far above the drop region the objects of a pile may start [m]."""


def enclosure_walls(
    enclosure: Enclosure,
    spec: SceneSpec,
    assets: Sequence[Asset],
    supports: Sequence[trimesh.Trimesh],
    number: int = 0,
) -> list[Shape]:
    """The enclosure of a region as five invisible boxes: walls from its floor up to its top or a pile's, and a lid.

    Without a margin of its own the largest object finds room between region and walls, but no wall stands where there
    is nothing to lie on before it.
    """
    region, arrangement = spec.all_regions[number]
    inner_low, inner_high = np.array(region.min), np.array(region.max)
    if enclosure.margin is not None:
        low, high = inner_low - enclosure.margin, inner_high + enclosure.margin
    else:
        margin = max((float(asset.mesh.extents.max()) for asset in assets if asset.mesh is not None), default=0.0)
        bounds = np.array([mesh.bounds for mesh in supports] or [(inner_low, inner_high)])
        low = np.minimum(inner_low, np.maximum(inner_low - margin, bounds[:, 0].min(axis=0)))
        high = np.maximum(inner_high, np.minimum(inner_high + margin, bounds[:, 1].max(axis=0)))
    low[2], high[2] = enclosure.floor, inner_high[2]
    if arrangement == "pile":
        high[2] += PILE_HEIGHT
    middle, size, thickness = (low + high) / 2, high - low, enclosure.thickness
    walls = []
    for name, axis, side in (("-x", 0, -1), ("+x", 0, 1), ("-y", 1, -1), ("+y", 1, 1), ("lid", 2, 1)):
        position = middle.copy()
        position[axis] += side * (size[axis] + thickness) / 2
        extents = size + 2 * thickness
        extents[axis] = thickness
        extents[2] = thickness if name == "lid" else size[2]
        box = Box(size=tuple(extents.tolist()), position=tuple(position.tolist()))
        walls.append(Shape(name=f"{ENCLOSURE}{_of_region(spec, number)}{name}", box=box))
    return walls


def _of_region(spec: SceneSpec, number: int) -> str:
    """What names of a region's walls have before their side."""
    return f"{spec.region_names[number]} " if number else ""


def walls_beside(spec: SceneSpec, number: int, names: Sequence[str], walls: Sequence[int]) -> list[int]:
    """Those of some walls, positions among ``names``, that no other region has of its own."""
    others = [f"{ENCLOSURE}{_of_region(spec, i)}" for i in range(len(spec.all_regions)) if i != number]
    foreign = {f"{other}{side}" for other in others for side in ("-x", "+x", "-y", "+y", "lid")}
    return [position for position in walls if names[position] not in foreign]


def backdrop_shapes(room: Backdrop) -> list[Shape]:
    """A backdrop as visible boxes: floor, walls that stand on it, and ceiling, each outside of the room."""
    width, depth, height = room.size
    turn = Rotation.from_euler("z", room.rotate_z, degrees=True).as_matrix()
    edge = BACKDROP_THICKNESS
    wide = width + 2 * edge, depth + 2 * edge
    parts: list[tuple[str, Vec3, Vec3]] = [("floor", (*wide, edge), (0.0, 0.0, -edge / 2))]
    for side in room.sides:
        axis, sign = "xy".index(side[1]), -1.0 if side[0] == "-" else 1.0
        size, middle = [width, wide[1], height], [0.0, 0.0, height / 2]
        if axis == 1:  # these stand between those along y, so that no faces coincide
            size = [width, edge, height]
        else:
            size[0] = edge
        middle[axis] = sign * (room.size[axis] + edge) / 2
        parts.append((f"wall {side}", (size[0], size[1], size[2]), (middle[0], middle[1], middle[2])))
    if room.ceiling:
        parts.append(("wall above", (*wide, edge), (0.0, 0.0, height + edge / 2)))
    return [
        Shape(
            name=f"{BACKDROP}{name}",
            box=Box(size=size, position=tuple((turn @ middle + room.position).tolist()), rotate=(0, 0, room.rotate_z)),
            visible=True,
            collider=room.collider and name == "floor",
            materials=room.floor if name == "floor" else room.walls,
        )
        for name, size, middle in parts
    ]


def backdrop_distance(spec: SceneSpec, point: Vec3) -> float:
    """How far walls and ceiling of a backdrop are from a point [m]; 0 if there are none."""

    def distance(box: Box) -> float:
        pose = stated_pose(box)
        own = pose[:3, :3].T @ (np.asarray(point) - pose[:3, 3])
        return float(np.linalg.norm(np.maximum(np.abs(own) - np.asarray(box.size) / 2, 0)))

    return min((distance(box) for box in backdrop_walls(spec)), default=0.0)


def backdrop_walls(spec: SceneSpec) -> list[Box]:
    """Walls and ceiling of a backdrop."""
    return [shape.box for shape in spec.shapes if shape.box and shape.name.startswith(f"{BACKDROP}wall ")]


def finish_name(shape: str) -> str:
    """What a shape shares its material with: all walls of a backdrop have one."""
    return f"{BACKDROP}walls" if shape.startswith(f"{BACKDROP}wall ") else shape


def stated_pose(place: Box | ObjectPose) -> Float64Array:
    """A place of the scene file as a transform (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", place.rotate, degrees=True).as_matrix()
    pose[:3, 3] = place.position
    return pose


def bin_walls(shape: Bin) -> tuple[trimesh.Trimesh, ...]:
    """The five boxes that a bin consists of, in world space."""
    width, depth, height = shape.size
    edge = shape.thickness
    # Walls along x are as long as the floor; those along y stand between them, so that no faces coincide.
    walls = [((width + 2 * edge, depth + 2 * edge, edge), (0.0, 0.0, -edge / 2))]
    walls += [((width + 2 * edge, edge, height), (0.0, side * (depth + edge) / 2, height / 2)) for side in (-1, 1)]
    walls += [((edge, depth, height), (side * (width + edge) / 2, 0.0, height / 2)) for side in (-1, 1)]
    turn = Rotation.from_euler("z", shape.rotate_z, degrees=True).as_matrix()
    boxes = []
    for size, middle in walls:
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = turn, turn @ middle + shape.position
        boxes.append(trimesh.creation.box(extents=size, transform=transform))
    return tuple(boxes)


def enclosed_bounds(
    region: Region, bounds: Sequence[Float64Array], walls: Sequence[int]
) -> tuple[Float64Array, Float64Array]:
    """Corners of what centres of mass must stay in: the outer faces of the walls beside the region, else all colliders.

    Args:
        region: Where objects start.
        bounds: Bounding box of each collider, shape (2, 3) [m].
        walls: Positions of the colliders that are an enclosure.
    """
    low, high = np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]
    high[2] = max(high[2], region.max[2])
    for axis in (0, 1):
        across = 1 - axis
        for wall in (bounds[position] for position in walls):
            if wall[0][across] > region.min[across] or wall[1][across] < region.max[across]:
                continue
            if wall[0][axis] >= region.max[axis]:
                high[axis] = min(high[axis], wall[1][axis])
            if wall[1][axis] <= region.min[axis]:
                low[axis] = max(low[axis], wall[0][axis])
    return low, high
