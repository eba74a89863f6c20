"""Presence and places of shapes, which the seed and the index of a layout determine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.shape_spec import Shape
from mitsplat.scene.streams import random_stream


@dataclass(frozen=True, eq=False)
class PlacedShape:
    """Shape of a layout.

    Attributes:
        number: Position in the ``shapes`` of the scene file.
        shape: The shape.
        stated: Mesh at the place of the scene file, in world space [m].
        mesh: Mesh at the place of the layout, in world space [m].
        motion: Transform (4, 4) from the first place to the second.
    """

    number: int
    shape: Shape
    stated: trimesh.Trimesh
    mesh: trimesh.Trimesh
    motion: Float64Array

    @cached_property
    def bounds(self) -> tuple[Float64Array, Float64Array]:
        """Corners (2, 3) of the bounding box of ``mesh`` [m]; trimesh hashes the vertices at each access."""
        low, high = self.mesh.bounds
        return low, high


def is_present(shape: Shape, seed: int, layout: int) -> bool:
    """Return True if a layout has the shape."""
    return shape.share == 1 or bool(random_stream(seed, f"share of shape {shape.name}", layout).random() < shape.share)


def draw_shift(shape: Shape, seed: int, layout: int) -> tuple[float, float, float]:
    """Draw the displacement along x and y [m] and the rotation about the vertical [degrees] of a shape."""
    x, y, turn = random_stream(seed, f"jitter of shape {shape.name}", layout).standard_normal(3).tolist()
    return shape.jitter * x, shape.jitter * y, shape.rotation_jitter * turn


def shape_motion(shape: Shape, mesh: trimesh.Trimesh, seed: int, layout: int) -> Float64Array:
    """Return the transform (4, 4) of a shape from its place in the scene file to that in a layout."""
    if not shape.is_jittered:
        return np.eye(4)
    x, y, angle = draw_shift(shape, seed, layout)
    middle = mesh.bounds.mean(axis=0)
    turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
    return homogeneous_matrix(turn, middle + np.array([x, y, 0.0]) - turn @ middle)


@lru_cache(maxsize=2)
def placed_shapes(scene: Scene, layout: int | None) -> tuple[PlacedShape, ...]:
    """Return the shapes that a layout has, or all shapes at the places of the scene file; the last ones from a cache.

    Args:
        scene: The scene.
        layout: Index of the layout, or None for the scene file.
    """
    if layout is None:
        pairs = enumerate(zip(scene.spec.shapes, scene.shape_meshes, strict=True))
        return tuple(PlacedShape(number, shape, mesh, mesh, np.eye(4)) for number, (shape, mesh) in pairs)
    placed = []
    for number, (shape, stated) in enumerate(zip(scene.spec.shapes, scene.shape_meshes, strict=True)):
        if is_present(shape, scene.spec.seed, layout):
            motion = shape_motion(shape, stated, scene.spec.seed, layout)
            mesh = stated.copy().apply_transform(motion) if shape.is_jittered else stated
            placed.append(PlacedShape(number, shape, stated, mesh, motion))
    return tuple(placed)
