"""Uncovered squares of a board, detected in drawn photos."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsplat.capture.boards.board_mask import bare_squares
from mitsplat.geometry.camera import Camera
from tests.capture.test_metric_frame import BOARD, draw, ring

ALL = BOARD.columns * BOARD.rows


PAPER = 20  # dots of white margin around the board, as on printed boards


@pytest.fixture(scope="module", params=[0, 3])
def photo(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Camera, np.ndarray]:
    camera = ring(width=480)[request.param]
    sheet = cv2.copyMakeBorder(BOARD.draw(200), PAPER, PAPER, PAPER, PAPER, cv2.BORDER_CONSTANT, value=255)
    path = draw(sheet, 200 / BOARD.square, camera, tmp_path_factory.mktemp("photo"), "photo.png")
    return camera, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def squares_of(found: np.ndarray, camera: Camera) -> set[tuple[int, int]]:
    """Return row and column of the squares whose centres are marked."""
    middles = {
        (row, column): (column + 0.5 - BOARD.columns / 2, BOARD.rows / 2 - row - 0.5, 0)
        for row in range(BOARD.rows)
        for column in range(BOARD.columns)
    }
    pixels, _ = camera.project(BOARD.square * np.array(list(middles.values())))
    return {place for place, (x, y) in zip(middles, pixels.astype(int), strict=True) if found[y, x]}


def test_all_squares_of_a_bare_board_are_found_in_even_and_dim_light(photo: tuple[Camera, np.ndarray]) -> None:
    camera, grey = photo
    x = np.linspace(0.5, 1, grey.shape[1])
    dim = np.random.default_rng(0).normal(20 + 0.6 * x * grey, 3).clip(0, 255).astype(np.uint8)
    for image in (grey, dim):
        assert len(squares_of(bare_squares(BOARD, np.eye(4), camera, image), camera)) == ALL


def test_the_pose_of_the_board_and_of_the_camera_have_one_world(photo: tuple[Camera, np.ndarray]) -> None:
    camera, grey = photo
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_euler("zyx", [50, -20, 100], degrees=True).as_matrix()
    moved[:3, 3] = 0.3, -0.2, 0.5
    other = replace(camera, world_from_camera=moved @ camera.world_from_camera)
    found = bare_squares(BOARD, np.eye(4), camera, grey)
    assert found.any() and (bare_squares(BOARD, moved, other, grey) != found).sum() < 10


def test_bare_squares_cover_the_image_of_the_board(photo: tuple[Camera, np.ndarray]) -> None:
    camera, grey = photo
    half = 0.5 * BOARD.square * np.array([BOARD.columns, BOARD.rows, 0])
    corners, _ = camera.project(half * [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    moments = cv2.moments(corners.astype(np.float32))
    middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    found = np.argwhere(bare_squares(BOARD, np.eye(4), camera, grey))[:, ::-1]
    np.testing.assert_allclose(found.mean(axis=0) + 0.5, middle, atol=0.2)


@pytest.mark.parametrize("grey_of_it", [5, 50, 120, 180, 250])
def test_a_square_with_a_covered_corner_is_not_bare(photo: tuple[Camera, np.ndarray], grey_of_it: int) -> None:
    """An occluder of any brightness covers corners of the squares (1, 2) to (2, 3)."""
    camera, grey = photo
    corners = BOARD.square * np.array([[-0.35, -0.3, 0], [0.3, -0.3, 0], [0.3, 0.4, 0], [-0.35, 0.4, 0]])
    covered = grey.copy()
    outline = camera.project(corners)[0]
    cv2.fillConvexPoly(covered, np.rint(outline).astype(np.int32), grey_of_it)
    found = bare_squares(BOARD, np.eye(4), camera, covered)
    thing = np.zeros_like(covered)
    cv2.fillConvexPoly(thing, np.rint(outline).astype(np.int32), 1)
    assert not found[thing > 0].any()
    places = squares_of(found, camera)
    assert not places & {(row, column) for row in (1, 2) for column in (2, 3)}
    assert len(places) >= ALL - 6


def test_images_without_the_board_have_no_bare_squares(photo: tuple[Camera, np.ndarray]) -> None:
    camera, grey = photo
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (12, 16)).astype(np.uint8)
    for image in (np.full_like(grey, 30), cv2.resize(coarse, grey.shape[::-1]), grey[::-1, ::-1].copy()):
        assert not bare_squares(BOARD, np.eye(4), camera, image).any()
