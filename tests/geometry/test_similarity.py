"""Similarity transforms: one rule and one message for cameras, captures, splats, assets and surfaces."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import homogeneous_matrix, split_similarity, transform_points
from mitsplat.reconstruct.registration import invert_transform
from mitsplat.surroundings.supports import Support

CAMERA = Camera(64, 48, 80.0, 80.0, 32.0, 24.0, np.eye(4))
SPLATS = Splats([[0.1, 0.2, 0.3]], [[0, 0, 0, 1]], [[0.1, 0.1, 0.1]], [0.5], [[[0, 0, 0]]])


def file_of(tmp_path: Path, matrix: object) -> None:
    np.savetxt(tmp_path / "m.txt", np.asarray(matrix))
    invert_transform(tmp_path / "m.txt")


def capture_of(tmp_path: Path) -> Capture:
    (tmp_path / "a.png").write_bytes(b"")
    return Capture(
        (Photo("a.png", tmp_path / "a.png", CAMERA),), np.array([[0.1, 0.2, 0.3]]), np.zeros((1, 3), np.uint8)
    )


USES: dict[str, Callable[[Path, object], object]] = {
    "function": lambda _, matrix: split_similarity(matrix),
    "camera": lambda _, matrix: CAMERA.transformed(matrix),
    "splats": lambda _, matrix: SPLATS.transformed(matrix),
    "asset": lambda _, matrix: Asset(name="a", class_name="a", splats=SPLATS, mesh=trimesh.creation.box()).transformed(
        matrix
    ),
    "capture": lambda path, matrix: capture_of(path).transformed(matrix),
    "support": lambda _, matrix: Support(np.eye(4), (1, 1), 0.0, 0.0, 1.0, 1.0).transformed(matrix),
    "file": file_of,
}
SHEARED = np.eye(4) + 0.1 * np.eye(4, k=1) * [[1], [1], [0], [0]]
TRANSPOSED = np.eye(4)
TRANSPOSED[3, :3] = (0.1, 0.2, 0.3)
WRONG = {
    "mirrored": (np.diag([1.0, 1.0, -1.0, 1.0]), "neither mirror nor flatten (got determinant -1): is one axis inv"),
    "flat": (np.diag([1.0, 1.0, 0.0, 1.0]), "neither mirror nor flatten (got determinant 0): is an axis missing?"),
    "uneven": (np.diag([1.0, 1.0, 2.0, 1.0]), "must scale uniformly and not shear (got axes of lengths 1, 1, 2)"),
    "slightly uneven": (np.diag([1.0, 1.0, 1.001, 1.0]), "must scale uniformly and not shear"),
    "sheared": (SHEARED, "must scale uniformly and not shear"),
    "projective": (np.diag([1.0, 1.0, 1.0, 2.0]), "must have the last row 0 0 0 1 (got [0.0, 0.0, 0.0, 2.0])"),
    "mirrored weight": (np.diag([1.0, 1.0, 1.0, -1.0]), "must have the last row 0 0 0 1 (got [0.0, 0.0, 0.0, -1.0])"),
    "transposed": (TRANSPOSED, "is it transposed, with the translation there?"),
    "not finite": (np.full((4, 4), np.nan), "a transform must be a finite 4x4 matrix"),
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("case", WRONG)
def test_other_transforms_are_refused_with_one_message(tmp_path: Path, use: str, case: str) -> None:
    matrix, message = WRONG[case]
    with pytest.raises(InputError) as raised:
        USES[use](tmp_path, matrix)
    assert message in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("use", [name for name in USES if name != "file"])
def test_other_shapes_are_refused(tmp_path: Path, use: str) -> None:
    for matrix in (np.eye(3), np.eye(4)[:3], np.eye(4).ravel()):
        with pytest.raises(InputError, match="must be a finite 4x4 matrix"):
            USES[use](tmp_path, matrix)


@pytest.mark.parametrize("use", USES)
def test_similarities_in_single_precision_are_accepted(tmp_path: Path, use: str) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = 0.013 * Rotation.from_euler("xyz", (20, -50, 130), degrees=True).as_matrix()
    matrix[:3, 3] = (3, -2, 0.5)
    USES[use](tmp_path, matrix.astype(np.float32))


def test_parts_of_a_similarity_multiply_to_it() -> None:
    turn = Rotation.from_euler("xyz", (20, -50, 130), degrees=True).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2.5 * turn, (3, -2, 0.5)
    rotation, scale, translation = split_similarity(matrix)
    np.testing.assert_allclose(rotation, turn, atol=1e-12)
    assert scale == pytest.approx(2.5, rel=1e-12) and translation.tolist() == [3, -2, 0.5]


def test_a_moved_camera_and_moved_points_keep_their_pixels(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = 0.4 * Rotation.from_euler("xyz", (20, -50, 130), degrees=True).as_matrix()
    matrix[:3, 3] = (3, -2, 0.5)
    for entries, tolerance in ((matrix, 1e-9), (matrix.astype(np.float32), 1e-4)):
        capture = capture_of(tmp_path)
        moved = capture.transformed(entries)
        before, depth = CAMERA.project(capture.points)
        after, moved_depth = moved.photos[0].camera.project(moved.points)
        np.testing.assert_allclose(after, before, atol=tolerance)
        np.testing.assert_allclose(moved_depth, 0.4 * depth, rtol=1e-6)
        assert moved.photos[0].camera.near == pytest.approx(0.4 * CAMERA.near)


def test_a_homogeneous_matrix_maps_points_by_its_linear_part_and_translation() -> None:
    rng = np.random.default_rng(0)
    linear, translation, points = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=(5, 3))
    expected = np.einsum("ij,nj->ni", linear, points) + translation
    np.testing.assert_allclose(transform_points(homogeneous_matrix(linear, translation), points), expected)
