"""Places of jittered shapes, which the seed and the index of a layout determine."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.shape_spec import Shape
from mitsplat.scene.streams import random_stream


def draw_shift(shape: Shape, seed: int, layout: int) -> tuple[float, float, float]:
    """Draw the displacement along x and y [m] and the rotation about the vertical [degrees] of a shape."""
    x, y, turn = random_stream(seed, f"jitter of shape {shape.name}", layout).standard_normal(3).tolist()
    return shape.jitter * x, shape.jitter * y, shape.rotation_jitter * turn


def shape_motion(shape: Shape, mesh: trimesh.Trimesh, seed: int, layout: int) -> Float64Array:
    """Return the transform (4, 4) of a shape from its place in the scene file to that in a layout."""
    motion = np.eye(4)
    if shape.is_jittered:
        x, y, turn = draw_shift(shape, seed, layout)
        middle = mesh.bounds.mean(axis=0)
        motion[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        motion[:3, 3] = middle + np.array([x, y, 0.0]) - motion[:3, :3] @ middle
    return motion


def placed_shapes(scene: Scene, layout: int) -> Iterator[tuple[Shape, trimesh.Trimesh, Float64Array]]:
    """Iterate over the shapes of a layout with their meshes in world space [m].

    Yields:
        Shape, its mesh, and the transform (4, 4) of :func:`shape_motion`.
    """
    for shape, mesh in zip(scene.spec.shapes, scene.shape_meshes, strict=True):
        motion = shape_motion(shape, mesh, scene.spec.seed, layout)
        yield shape, mesh.copy().apply_transform(motion) if shape.is_jittered else mesh, motion
