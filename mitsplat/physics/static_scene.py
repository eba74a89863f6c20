"""Static scene on which objects fall: colliders, obstacles for distance queries, and bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.geometry.mesh import prepare_mesh
from mitsplat.geometry.mesh_distance import DistanceSurface, PlacedSurface
from mitsplat.physics.bodies import Collider, Part, all_pieces, make_collider
from mitsplat.physics.contacts import ContactFinder
from mitsplat.progress import Note
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.scene.scene import Scene
from mitsplat.scene.walls import enclosed_bounds, enclosure_box, walls_beside


@dataclass(frozen=True, eq=False)
class StaticScene:
    """Static scene; colliders and obstacles are parallel.

    Attributes:
        contact_finder: Contact finder for all objects and these colliders.
        bounds: Corners of the box in which the centres of mass must stay [m], per region, shape (R, 3) each.
        walls: Corners of the box of the enclosure's walls [m], in the same shapes; infinite without a wall.
    """

    colliders: tuple[Collider, ...]
    obstacles: tuple[PlacedSurface, ...]
    contact_finder: ContactFinder
    bounds: tuple[Float64Array, Float64Array]
    walls: tuple[Float64Array, Float64Array]


def make_static_scene(
    scene: Scene, objects: Sequence[Part], surroundings: Asset | None, progress: Note, layout: int | None = None
) -> StaticScene:
    """Build the static scene from colliding shapes and, optionally, surroundings.

    Args:
        scene: The scene.
        objects: Physics data of all objects that may fall on it.
        surroundings: Environment that collides.
        progress: Callback for slow operations.
        layout: Index of the layout whose shapes are used, or None for all shapes of the scene file.

    Raises:
        InputError: If there is no collider.
    """
    walls = []  # positions of the invisible enclosure walls
    colliders: list[Collider] = []
    obstacles: list[PlacedSurface] = []
    for placed in placed_shapes(scene, layout):
        shape, motion = placed.shape, placed.motion
        if not shape.collider:
            continue
        if not (shape.visible or shape.proxy):
            walls.append(len(colliders))
        mesh = prepare_mesh(placed.stated, f"shape {shape.name!r}")
        collider = make_collider(shape, mesh, progress)
        if shape.is_jittered:
            collider = collider.moved(motion)
        colliders.append(collider)
        obstacles.append(PlacedSurface(shape.name, DistanceSurface(mesh), motion))
    if surroundings is not None and surroundings.mesh is not None:
        mesh = prepare_mesh(surroundings.mesh, f"asset {surroundings.name!r}", solid=False)
        colliders.append(make_collider(surroundings, mesh, progress))
        obstacles.append(PlacedSurface(surroundings.name, DistanceSurface(mesh)))
    if not colliders:
        raise InputError(f"{scene.path}: at least one shape must be a collider, on which objects rest (got none)")
    names, boxes = [item.name for item in obstacles], [item.bounds for item in obstacles]
    bounds, inner = [], []
    for number, (region, arrangements) in enumerate(scene.spec.all_regions):
        beside = walls_beside(scene.spec, number, names, walls)
        bounds.append(enclosed_bounds(region, arrangements, boxes, beside))
        inner.append(enclosure_box({names[wall]: boxes[wall] for wall in beside}))
    outer_low, outer_high = np.array(bounds).swapaxes(0, 1)
    inner_low, inner_high = np.array(inner).swapaxes(0, 1)
    return StaticScene(
        tuple(colliders),
        tuple(obstacles),
        ContactFinder(lambda: all_pieces((part.body for part in objects), colliders)),
        (outer_low, outer_high),
        (inner_low, inner_high),
    )
