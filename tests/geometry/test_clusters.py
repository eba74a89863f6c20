"""Groups of points by distance."""

from __future__ import annotations

import numpy as np
import pytest

from mitsplat.geometry.camera import Camera
from mitsplat.geometry.clusters import cluster_points, gap_between
from mitsplat.geometry.triangulation import count_observers


@pytest.mark.parametrize(("gap", "groups"), [(0.5, 4), (1.0, 2), (5.0, 2), (8.0, 1)])
def test_points_at_most_a_gap_apart_are_one_group(gap: float, groups: int) -> None:
    points = np.array([[0, 0, 0], [10, 0, 0], [1, 0, 0], [9, 0, 0]], dtype=np.float64)
    labels = cluster_points(points, gap)
    assert len(set(labels.tolist())) == groups
    assert (labels[0] == labels[2]) == (gap >= 1)


def test_no_points_are_no_group() -> None:
    assert not len(cluster_points(np.zeros((0, 3)), 1.0))


def test_gap_is_four_spacings_within_its_bounds() -> None:
    line = np.column_stack([np.arange(1000.0), np.zeros((1000, 2))])  # the fifth nearest point is at the distance 3
    assert gap_between(line, 0.0, 100.0) == 12.0
    assert gap_between(line, 0.0, 5.0) == 5.0
    assert gap_between(line, 20.0, 100.0) == 20.0


def test_points_are_counted_by_their_observers() -> None:
    seen = [np.array([0, 2], dtype=np.int32), np.array([2], dtype=np.int32), np.array([], dtype=np.int32)]
    assert count_observers(seen, 4).tolist() == [1, 0, 2, 0]


def test_a_camera_contains_its_pixels_up_to_the_border() -> None:
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), width=20, height=10, fov_x=60)
    pixels = np.array([[[0, 0], [19.9, 9.9], [20, 5]], [[5, 10], [-0.1, 5], [np.nan, 5]]])
    assert camera.size == (20, 10)
    assert camera.contains(pixels).tolist() == [[True, True, False], [False, False, False]]
