"""Occlusion of the object in a photo, compared with the overlap area of discs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsplat.arrays import Float64Array
from mitsplat.capture.isolation.occluding_points import occluded_part
from mitsplat.geometry.camera import Camera


def ball(middle: tuple[float, float, float], radius: float = 0.04, count: int = 800) -> Float64Array:
    """Sample points on a ball [m], shape (N, 3)."""
    points = np.random.default_rng(count).normal(size=(count, 3))
    return points * radius / np.linalg.norm(points, axis=1, keepdims=True) + middle


def hidden_share(camera: Camera, own: Float64Array, others: list[Float64Array]) -> float:
    occluded, possibly_occluded, pixels = occluded_part(camera, own, others)
    assert occluded <= possibly_occluded and pixels.shape == (480, 640) and (pixels.any() or possibly_occluded == 0)
    return occluded


CAMERA = Camera.look_at((0, -5, 0), (0, 0, 0), width=640, height=480, fov_x=3)
"""Camera at such a distance that balls are projected to discs."""


@pytest.mark.parametrize("aside", [0.0, 0.02, 0.04, 0.06, 0.1])
def test_the_hidden_share_of_a_ball_is_the_overlap_of_two_discs(aside: float) -> None:
    own, before, behind = ball((0, 0, 0)), ball((aside, -0.2, 0)), ball((aside, 0.2, 0))
    # Two discs of radius r with centres d apart overlap in 2 r^2 acos(d / 2r) - d sqrt(r^2 - d^2 / 4).
    half = min(aside / 0.08, 1.0)
    shared = (2 * np.arccos(half) - 2 * half * np.sqrt(1 - half**2)) / np.pi
    assert hidden_share(CAMERA, own, [before]) == pytest.approx(shared, abs=0.05)
    assert hidden_share(CAMERA, own, [behind]) == 0
    assert hidden_share(CAMERA, own, [before, behind, before]) == pytest.approx(shared, abs=0.05)


@pytest.mark.parametrize("axis", [0, 2])
def test_an_object_before_one_end_hides_this_end(axis: int) -> None:
    """The outline of two balls of radius r at a distance d has an area of pi r^2 + 2 r d."""
    ends = [sign * 0.05 * np.eye(3)[axis] for sign in (-1, 1)]
    own = np.concatenate([ball(tuple(end)) for end in ends])
    disc = np.pi * 0.04**2
    before = ball(tuple(ends[1] + (0, -0.2, 0)))
    assert hidden_share(CAMERA, own, [before]) == pytest.approx(disc / (disc + 0.08 * 0.1), abs=0.05)
    assert hidden_share(CAMERA, own, [before - (0, 6, 0)]) == 0  # behind the camera


def test_an_object_before_the_middle_of_the_other_hides_it() -> None:
    """It is not in front of the nearest point."""
    assert hidden_share(CAMERA, ball((0, 0, 0)), [ball((0, -0.02, 0), 0.01)]) == pytest.approx(1 / 16, abs=0.03)


def test_a_ring_around_the_object_hides_only_with_its_front() -> None:
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.column_stack([0.07 * np.cos(turns), 0.07 * np.sin(turns), np.full(400, -0.035)])
    camera = Camera.look_at((0, -0.4, 0.25), (0, 0, 0), width=640, height=480, fov_x=40)
    assert hidden_share(camera, ball((0, 0, 0)), [ring]) < 0.1


def test_too_few_points_give_no_hidden_share() -> None:
    assert hidden_share(CAMERA, ball((0, 0, 0)), []) == 0
    assert hidden_share(CAMERA, ball((0, 0, 0)), [ball((0, -0.2, 0))[:3]]) == 0
    assert hidden_share(CAMERA, ball((0, -6, 0)), [ball((0, -0.2, 0))]) == 0


def test_thirty_points_are_enough_to_hide_a_share() -> None:
    """Objects without texture have about 30 sparse points. The surface between them still occludes."""
    assert hidden_share(CAMERA, ball((0, 0, 0)), [ball((0.02, -0.2, 0), 0.03, count=30)]) > 0.2


def test_hidden_pixels_are_those_of_the_occluder_and_a_rim() -> None:
    _, possibly_occluded, pixels = occluded_part(
        CAMERA, ball((0, 0, 0)), [ball((0.05, -0.2, 0)), ball((-0.05, 0.2, 0))]
    )
    assert 0.3 < possibly_occluded < 0.6
    y, x = np.mgrid[0:480, 0:640] + 0.5
    (middle,), _ = CAMERA.project(np.array([[0.05, -0.2, 0]]))
    away = np.hypot(x - middle[0], y - middle[1]) / (0.04 / 4.8 * CAMERA.fx)
    near = np.abs(x - 320) < 0.04 / 5 * CAMERA.fx  # pixels of the object
    assert pixels[near & (away < 0.97)].all() and not pixels[near & (away > 1.3)].any()


def test_a_can_with_points_on_its_rims_only_may_hide_the_object() -> None:
    """The can has points only on its rims."""
    turns = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rims = [np.column_stack([0.04 * np.cos(turns), 0.04 * np.sin(turns) - 0.2, np.full(60, z)]) for z in (-0.04, 0.04)]
    occluded, possibly_occluded, _ = occluded_part(CAMERA, ball((0, 0, 0)), [np.concatenate(rims)])
    assert occluded < 0.7 and possibly_occluded > 0.95


@pytest.mark.filterwarnings("error")
def test_points_beyond_the_fold_of_the_lens_do_not_change_the_outline() -> None:
    """A wrong camera can see points of the object at angles that its distortion does not describe."""
    camera = replace(CAMERA, distortion=(-30.0, 0.0, 0.0, 0.0))
    beyond = np.array([[4.0, 0.0, 0.0], [-4.0, 0.1, 0.0]])
    assert np.isnan(camera.project(beyond)[0]).all()
    own, before = ball((0, 0, 0)), [ball((0.04, -0.2, 0))]
    share = hidden_share(camera, own, before)
    assert 0.1 < share < 0.6
    assert hidden_share(camera, np.vstack([own, beyond]), before) == share
    assert hidden_share(camera, np.vstack([beyond, beyond]), before) == 0
