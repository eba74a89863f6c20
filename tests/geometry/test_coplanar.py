"""Surfaces of two meshes in one plane."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.geometry.coplanar import coplanar_place

ABOVE = [(0.3, 0.2, 2.0)]


def box(size: tuple[float, float, float], middle: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(middle)
    return mesh


TABLE = box((1, 1, 0.1), (0, 0, -0.05))
CASES = {
    "mat inside of the table": (box((0.2, 0.3, 0.01), (0.3, -0.2, -0.005)), True),
    "mat across the border": (box((0.4, 0.4, 0.02), (0.5, 0.5, -0.01)), True),
    "mat on the table": (box((0.2, 0.3, 0.01), (0.3, -0.2, 0.005)), False),
    "mat 0.1 mm above": (box((0.2, 0.3, 0.01), (0.3, -0.2, -0.0049)), False),
    "table beside": (box((1, 1, 0.1), (1, 0, -0.05)), False),
    "table apart": (box((1, 1, 0.1), (2, 0, -0.05)), False),
    "common bottom": (box((0.2, 0.3, 0.05), (0.3, -0.2, -0.075)), False),
    "sheet in the plane, facing down": (
        trimesh.Trimesh([(0, 0, 0), (0.2, 0, 0), (0, 0.2, 0)], [(0, 2, 1)], process=False),
        True,
    ),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("turn", [(0, 0, 0), (20, 35, 50)])
def test_planes_that_two_meshes_share_are_found(case: str, turn: tuple[int, int, int]) -> None:
    """The place is the middle of the overlap."""
    other, expected = CASES[case]
    rotation = Rotation.from_euler("xyz", turn, degrees=True)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), (0.5, -0.3, 0.2)
    one, other = (mesh.copy().apply_transform(pose) for mesh in (TABLE, other))
    eyes = rotation.apply(ABOVE) + pose[:3, 3]
    for first, second in ((one, other), (other, one)):
        place = coplanar_place(first, second, eyes)
        assert (place is not None) == expected
        if place is not None:
            x, y, z = rotation.inv().apply(place - pose[:3, 3])
            assert abs(z) < 1e-5 and abs(x) <= 0.5 and abs(y) <= 0.5
            low, high = CASES[case][0].bounds
            overlap = (np.maximum(low, -0.5) + np.minimum(high, 0.5)) / 2
            middle = overlap if other.is_watertight else CASES[case][0].centroid
            np.testing.assert_allclose((x, y), middle[:2], atol=0.005)  # two cells of the raster


def test_many_triangles_in_a_plane_take_no_pairs() -> None:
    fine = TABLE.subdivide().subdivide().subdivide().subdivide().subdivide()
    other = fine.copy().apply_translation((0.93, 0.02, 0))
    assert len(fine.faces) > 10_000
    assert coplanar_place(fine, other, ABOVE) is not None
    assert coplanar_place(fine, other.apply_translation((0.07, 0, 0)), ABOVE) is None


def test_spheres_share_no_plane() -> None:
    ball = trimesh.creation.icosphere(4)
    assert coplanar_place(ball, ball.copy().apply_translation((0.5, 0, 0)), ABOVE) is None
    assert coplanar_place(ball, ball.copy(), ABOVE) is not None
