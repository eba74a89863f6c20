"""Walls of bins, enclosures and backdrops, and the bounds within which objects must stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.scene.spec.object_spec import Arrangement, ObjectPose
from mitsplat.scene.spec.scene_spec import BACKDROP, SceneSpec
from mitsplat.scene.spec.shape_spec import Backdrop, Bin, Box, Enclosure, Region, Shape
from mitsplat.storage.field_types import Vec3

if TYPE_CHECKING:
    from mitsplat.asset import Asset


ENCLOSURE = "enclosure "
"""Prefix of the names of the shapes that an enclosure expands to."""

_ENCLOSURE_THICKNESS = 0.05
"""Thickness of the walls and lid of an enclosure [m]."""

BACKDROP_THICKNESS = 0.1
"""Thickness of the floor and walls of a backdrop [m]."""

PILE_HEIGHT = 1.0
"""Maximum height above the drop region at which objects of a pile start [m]."""


def enclosure_walls(
    enclosure: Enclosure, spec: SceneSpec, assets: Sequence[Asset], supports: Sequence[trimesh.Trimesh], number: int = 0
) -> list[Shape]:
    """Return the enclosure of a region as five invisible boxes: four walls and a lid.

    The walls reach from the floor of the enclosure to the top of the region, or of the pile. Without a margin in the
    specification, the largest object fits between region and walls; but no wall is farther out than the supports.
    """
    region, arrangements = spec.all_regions[number]
    inner_low, inner_high = np.array(region.min), np.array(region.max)
    if enclosure.margin is not None:
        low, high = inner_low - enclosure.margin, inner_high + enclosure.margin
    else:
        margin = max((float(asset.mesh.extents.max()) for asset in assets if asset.mesh is not None), default=0.0)
        bounds = np.array([mesh.bounds for mesh in supports] or [(inner_low, inner_high)])
        low = np.minimum(inner_low, np.maximum(inner_low - margin, bounds[:, 0].min(axis=0)))
        high = np.maximum(inner_high, np.minimum(inner_high + margin, bounds[:, 1].max(axis=0)))
    low[2], high[2] = enclosure.floor, inner_high[2]
    if "pile" in arrangements:
        high[2] += PILE_HEIGHT
    middle, size, thickness = (low + high) / 2, high - low, _ENCLOSURE_THICKNESS
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
    """Return the part of a wall's name that identifies its region; empty for the main region."""
    return f"{spec.region_names[number]} " if number else ""


def walls_beside(spec: SceneSpec, number: int, names: Sequence[str], walls: Sequence[int]) -> list[int]:
    """Return the indices of those walls that do not belong to another region. ``walls`` are indices into ``names``."""
    others = [f"{ENCLOSURE}{_of_region(spec, i)}" for i in range(len(spec.all_regions)) if i != number]
    foreign = {f"{other}{side}" for other in others for side in ("-x", "+x", "-y", "+y", "lid")}
    return [position for position in walls if names[position] not in foreign]


def enclosure_box(bounds: Mapping[str, Float64Array]) -> tuple[Float64Array, Float64Array]:
    """Return the corners of the box between the walls of an enclosure [m]; infinite where there is no wall.

    Args:
        bounds: Bounding box of each wall by name, shape (2, 3) [m]; other names are ignored.
    """
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    for name, box in bounds.items():
        side = name.split()[-1]
        if not name.startswith(ENCLOSURE) or side == "lid":
            continue
        axis = "xy".index(side[1])
        if side[0] == "-":
            low[axis] = max(low[axis], box[1][axis])
        else:
            high[axis] = min(high[axis], box[0][axis])
    return low, high


def backdrop_shapes(room: Backdrop) -> list[Shape]:
    """Return a backdrop as visible boxes: floor, walls on the floor, and ceiling, all outside of the room."""
    width, depth, height = room.size
    edge = BACKDROP_THICKNESS
    wide = width + 2 * edge, depth + 2 * edge
    parts: list[tuple[str, Vec3, Vec3]] = [("floor", (*wide, edge), (0.0, 0.0, -edge / 2))]
    for side in ("-x", "+x", "-y", "+y"):
        axis, sign = "xy".index(side[1]), -1.0 if side[0] == "-" else 1.0
        size, middle = [width, wide[1], height], [0.0, 0.0, height / 2]
        if axis == 1:  # between the other walls, so that no faces coincide
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
            box=Box(size=size, position=tuple(np.add(middle, room.position).tolist())),
            visible=True,
            collider=False,
            materials=room.floor if name == "floor" else room.walls,
        )
        for name, size, middle in parts
    ]


def backdrop_distance(spec: SceneSpec, point: Vec3) -> float:
    """Return the distance from a point to the walls and ceiling of a backdrop [m]; 0 if there are none."""

    def distance(box: Box) -> float:
        pose = pose_matrix(box)
        own = pose[:3, :3].T @ (np.asarray(point) - pose[:3, 3])
        return float(np.linalg.norm(np.maximum(np.abs(own) - np.asarray(box.size) / 2, 0)))

    return min((distance(box) for box in backdrop_walls(spec)), default=0.0)


def backdrop_walls(spec: SceneSpec) -> list[Box]:
    """Return the walls and the ceiling of a backdrop."""
    return [shape.box for shape in spec.shapes if shape.box and shape.name.startswith(f"{BACKDROP}wall ")]


def material_name(shape: str) -> str:
    """Return the name under which a shape's material is drawn. All walls of a backdrop share one name."""
    return f"{BACKDROP}walls" if shape.startswith(f"{BACKDROP}wall ") else shape


def pose_matrix(place: Box | ObjectPose) -> Float64Array:
    """Return a pose of the scene file as a transform (4, 4)."""
    return homogeneous_matrix(Rotation.from_euler("xyz", place.rotate, degrees=True).as_matrix(), place.position)


def bin_walls(shape: Bin) -> tuple[trimesh.Trimesh, ...]:
    """Return the five boxes of a bin, in world space."""
    width, depth, height = shape.size
    edge = shape.thickness
    # Walls along x are as long as the floor. Walls along y stand between them, so that no faces coincide.
    walls = [((width + 2 * edge, depth + 2 * edge, edge), (0.0, 0.0, -edge / 2))]
    walls += [((width + 2 * edge, edge, height), (0.0, side * (depth + edge) / 2, height / 2)) for side in (-1, 1)]
    walls += [((edge, depth, height), (side * (width + edge) / 2, 0.0, height / 2)) for side in (-1, 1)]
    return tuple(
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(np.add(middle, shape.position)))
        for size, middle in walls
    )


def enclosed_bounds(
    region: Region, arrangements: Sequence[Arrangement], bounds: Sequence[Float64Array], walls: Sequence[int]
) -> tuple[Float64Array, Float64Array]:
    """Return the corners of the box in which centres of mass must stay.

    The box ends at the outer faces of the walls beside the region, or at the bounds of all colliders without walls. It
    contains the starts of a pile.

    Args:
        region: Region in which objects start.
        arrangements: Possible arrangements in it.
        bounds: Bounding box of each collider, shape (2, 3) [m].
        walls: Indices of the colliders that are enclosure walls.
    """
    low, high = np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]
    high[2] = max(high[2], region.max[2])
    if "pile" in arrangements:
        high[2] += PILE_HEIGHT
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
