"""Where lens distortion folds, coefficients as OpenCV returns them, and thin-prism distortion against OpenCV."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.geometry.lens import (
    Lens,
    distortion_coefficients,
    opencv_distort,
    turning_angle,
    turning_slope,
    undistort,
)
from mitsplat.renderer.layers import describe_sensor
from mitsplat.runtime.variant import ensure_variant

PRISM = (-0.21, 0.06, 0.001, -0.002, -0.01, 0.02, 0.01, 0.003, 0.004, -0.002, 0.003, 0.001)


def camera(fov: float, distortion: Any, lens: Lens = "opencv", **changes: Any) -> Camera:
    """Return a camera of 640x480 px with a horizontal field of view of the undistorted image [degrees]."""
    focal = 320 / np.tan(np.radians(fov) / 2)
    return replace(Camera(640, 480, focal, focal, 320.0, 240.0, np.eye(4)), distortion=distortion, lens=lens, **changes)


def points(slopes: np.ndarray) -> np.ndarray:
    return np.column_stack([slopes, np.ones(len(slopes))])


@pytest.mark.parametrize("k1", [-0.05, -0.1, -1.0])
def test_the_turning_angle_of_a_fisheye_is_the_root_of_the_derivative(k1: float) -> None:
    """a + k1 a^3 has its maximum at a^2 = -1 / (3 k1)."""
    assert turning_angle((k1, 0.0, 0.0, 0.0)) == pytest.approx(1 / np.sqrt(-3 * k1), rel=1e-9)
    assert turning_angle((-k1, 0.0, 0.0, 0.0)) == np.inf


@pytest.mark.parametrize(
    "distortion",
    [(-0.25, 0, 0, 0), (-0.4, 0.15, 0, 0, -0.03), (0, 0, 0, 0, 0, 1, 0, 0), (0.1, -0.2, 0, 0), PRISM[:8]],
)
def test_the_distorted_radius_grows_up_to_the_turning_slope_only(distortion: tuple[float, ...]) -> None:
    turn = turning_slope(distortion)
    slope = np.linspace(0, 0.999 * turn, 500)
    shown, _ = cv2.projectPoints(
        points(np.column_stack([slope, 0 * slope])), np.zeros(3), np.zeros(3), np.eye(3), np.float64(distortion)
    )
    beyond, _ = cv2.projectPoints(
        np.float64([[turn, 0, 1], [1.001 * turn, 0, 1]]), np.zeros(3), np.zeros(3), np.eye(3), np.float64(distortion)
    )
    if not any(distortion[2:4]):
        assert (np.diff(shown[:, 0, 0]) > 0).all()
        assert beyond[1, 0, 0] <= beyond[0, 0, 0]


@pytest.mark.parametrize(
    ("fov", "distortion", "lens", "sentence"),
    [
        (90, (-0.25, 0, 0, 0), "opencv", r"stops growing at 49.1 degrees .* 0.77 focal .* at \(0, 0\) is at 1.25"),
        (90, (-0.35, 0, 0, 0), "opencv", "the image needs rays that the lens model does not have"),
        (60, (-112, 0, 0, 0), "opencv", r"k1 = -112 has no unit: is it in pixels"),
        (60, (-0.3, 0.1, -0.4, 0.001, 0.0005), "opencv", r"is the order k1, k2, p1, p2, k3\?"),
        (60, (0, 0, 0, 0, 0, 3.0, 0, 0), "opencv", "stops growing at"),
        (60, (0, 0, 0, 0, 0, -9.0, -9.0, 0), "opencv", "the image needs rays"),
        (60, (-0.1, 0, 0, 0, 0, 0, 0, 0, -0.5, 0, -0.5, 0), "opencv", "no ray is distorted to the pixel"),
        (80, (-0.5, 0, 0, 0), "fisheye", r"stops growing at 46.8 degrees from the axis, which is 0.544 focal lengths"),
        (130, (0, 0, 0, 0), "fisheye", r"at most 85 degrees .*, which is 1.48 focal lengths"),
    ],
)
def test_an_image_that_needs_rays_beyond_a_fold_is_refused(
    fov: float, distortion: tuple[float, ...], lens: Lens, sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence) as caught:
        camera(fov, distortion, lens)
    assert "\n" not in str(caught.value) and str(caught.value).endswith("?")


@pytest.mark.parametrize(
    ("fov", "distortion", "lens"),
    [
        (60, (-0.25, 0, 0, 0), "opencv"),
        (75, (-0.3, 0.09, 0.001, -0.001, -0.01), "opencv"),
        (110, (5.0, 3.0, 0, 0, 0.1, 5.2, 4.0, 0.5), "opencv"),
        (70, (0.3, 0.1, 0, 0), "opencv"),
        (70, PRISM, "opencv"),
        (95, (0.02, -0.01, 0.004, -0.001), "fisheye"),
        (50, (-0.1, 0, 0, 0), "fisheye"),
    ],
)
def test_every_pixel_of_an_accepted_lens_has_the_ray_that_projects_to_it(
    fov: float, distortion: tuple[float, ...], lens: Lens
) -> None:
    """On the host in double precision, and in the sensor of the renderer."""
    made = camera(fov, distortion, lens, cx=310.0, cy=250.5)
    x, y = np.meshgrid(np.linspace(0, 640, 17), np.linspace(0, 480, 13))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    slopes = made.ray_slopes(pixels)
    np.testing.assert_allclose(made.project(points(slopes))[0], pixels, atol=1e-6)
    ensure_variant()
    from mitsplat.renderer.rays.sensors import view_of

    u, v = view_of(mi.load_dict(describe_sensor(made))).slopes(mi.Float(x.ravel()), mi.Float(y.ravel()))
    np.testing.assert_allclose(np.stack([u, v], axis=1), slopes, rtol=1e-4, atol=2e-5)


def test_positions_beyond_a_fold_have_no_ray() -> None:
    distortion = (-0.25, 0.0, 0.0, 0.0)
    inside = undistort(np.array([[0.7, 0.0], [0.0, 0.769]]), distortion, "opencv")
    assert np.linalg.norm(inside, axis=1).max() < turning_slope(distortion)
    assert np.isnan(undistort(np.array([[0.7699, 0.0], [0.6, 0.6], [3.0, 0.0]]), distortion, "opencv")).all()
    assert np.isnan(undistort(np.array([[0.6, 0.0]]), (-0.5, 0.0, 0.0, 0.0), "fisheye")).all()


def test_points_beyond_the_turn_of_a_fisheye_are_not_in_the_image() -> None:
    """The distortion folds at 57.3 degrees; a point at 80 degrees would be in the image again."""
    made = camera(40, (-1 / 3, 0.0, 0.0, 0.0), "fisheye")
    angle = np.radians([50.0, 57.0, 58.0, 80.0, 89.9])
    pixels, _ = made.project(points(np.column_stack([np.tan(angle), 0 * angle])))
    assert np.isnan(pixels).any(axis=1).tolist() == [False, False, True, True, True]


def test_the_jacobian_of_the_distortion_is_its_derivative() -> None:
    """Central differences with a step h have an error of the order of h^2."""
    u, v = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 20))
    h = 1e-5
    for k in (PRISM[:8], PRISM):
        jacobian = opencv_distort(u, v, k)[2]
        along_u, along_v = (
            [(after - before) / (2 * h) for after, before in zip(*ends, strict=True)]
            for ends in (
                (opencv_distort(u + h, v, k)[:2], opencv_distort(u - h, v, k)[:2]),
                (opencv_distort(u, v + h, k)[:2], opencv_distort(u, v - h, k)[:2]),
            )
        )
        np.testing.assert_allclose(jacobian, [along_u[0], along_v[0], along_u[1], along_v[1]], atol=1e-9)


@pytest.mark.parametrize(("distortion", "lens"), [(PRISM, "opencv"), ((0.02, -0.01, 0.004, -0.001), "fisheye")])
def test_the_jacobian_on_the_device_is_the_derivative(distortion: tuple[float, ...], lens: Lens) -> None:
    """Single precision: differences over 2 h = 0.02 have an error below 1e-3."""
    ensure_variant()
    from mitsplat.renderer.rays.sensors import view_of

    view = view_of(mi.load_dict(describe_sensor(camera(70, distortion, lens))))
    u, v = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 20))
    h = 0.01

    def shown(du: float, dv: float) -> np.ndarray:
        return np.array(view.distort(mi.Float(u + du), mi.Float(v + dv))[:2])

    (a, c), (b, d) = ((shown(*step) - shown(*(-np.array(step)))) / (2 * h) for step in ((h, 0.0), (0.0, h)))
    np.testing.assert_allclose(np.array(view.distort(mi.Float(u), mi.Float(v))[2]), [a, b, c, d], atol=1e-3)


def test_thin_prism_projection_agrees_with_opencv() -> None:
    made = camera(70, PRISM)
    u, v = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.5, 0.5, 7))
    world = points(np.stack([u.ravel(), v.ravel()], axis=1))
    expected, _ = cv2.projectPoints(world, np.zeros(3), np.zeros(3), made.intrinsics, np.array(PRISM))
    np.testing.assert_allclose(made.project(world)[0], expected.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(made.ray_slopes(expected.reshape(-1, 2)), world[:, :2], atol=1e-9)


@pytest.mark.parametrize("count", [4, 5, 8, 12])
@pytest.mark.parametrize("shape", [(1, -1), (-1, 1), (-1,)])
def test_arrays_of_coefficients_are_accepted_in_each_shape_of_opencv(count: int, shape: tuple[int, ...]) -> None:
    values = np.array(PRISM[:count]).reshape(shape)
    assert camera(50, values).distortion == pytest.approx(PRISM[:count])
    assert camera(50, values.tolist()).distortion == pytest.approx(PRISM[:count])


def test_fourteen_coefficients_without_tilt_are_those_of_a_smaller_model() -> None:
    rational = np.zeros((1, 14))
    rational[0, :8] = PRISM[:8]
    assert distortion_coefficients(rational, "opencv") == PRISM[:8]
    assert distortion_coefficients([*PRISM, 0, 0], "opencv") == PRISM
    with pytest.raises(ValueError, match=r"must have no tilt of the sensor, tau_x and tau_y \(got \[0.01, 0.0\]\)"):
        distortion_coefficients([*PRISM, 0.01, 0], "opencv")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (np.zeros(6), r"must have 0, 4, 5, 8, 12 or 14 coefficients \(got 6\)"),
        (np.zeros(9), r"must have 0, 4, 5, 8, 12 or 14 coefficients \(got 9\)"),
        (np.zeros((2, 4)), r"must be a list of coefficients \(got an array of shape \(2, 4\)\)"),
        ([0, np.nan, 0, 0], "must have finite coefficients"),
        ("k1 k2", "must be a list of numbers"),
    ],
)
def test_other_coefficients_are_refused(values: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=rf"^distortion {sentence}"):
        camera(50, values)


def test_calibrations_of_opencv_are_accepted_as_they_are_returned() -> None:
    """Views of a known board give arrays of the shapes (1, 5), (1, 14) and (4, 1), and the camera that made them."""
    x, y = np.meshgrid(np.arange(9) * 0.03, np.arange(7) * 0.03)
    board = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    poses = [look_at_pose(eye, (0.12, 0.09, 0)) for eye in ((0.1, -0.1, 0.3), (0.35, 0, 0.25), (-0.1, 0.2, 0.28))]
    for lens, flags, shape in (
        ("opencv", 0, (1, 5)),
        ("opencv", cv2.CALIB_RATIONAL_MODEL, (1, 14)),
        ("fisheye", cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW, (4, 1)),
    ):
        true = camera(70, (-0.1, 0.02, 0, 0), lens)  # type: ignore[arg-type]
        pixels = [replace(true, world_from_camera=pose).project(board)[0] for pose in poses]
        found = [one.astype(np.float32).reshape(1, -1, 2) for one in pixels]
        boards = [board.astype(np.float32).reshape(1, -1, 3)] * 3
        calibrate = cv2.calibrateCamera if lens == "opencv" else cv2.fisheye.calibrate
        _, matrix, distortion, *_ = calibrate(boards, found, (640, 480), None, None, flags=flags)
        assert distortion.shape == shape
        made = Camera(
            *(640, 480, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], poses[0]),
            distortion=distortion,  # type: ignore[arg-type]
            lens=lens,  # type: ignore[arg-type]
        )
        np.testing.assert_allclose(made.project(board)[0], pixels[0], atol=0.5)


def test_an_undistorted_fisheye_shows_the_same_directions() -> None:
    """The image encodes the direction of every pixel. After undistortion, each pixel must encode its own direction."""
    made = camera(70, (0.02, -0.01, 0.004, -0.001), "fisheye").resized(160, 120)
    y, x = np.mgrid[:120, :160] + 0.5
    grid = np.column_stack([x.ravel(), y.ravel()])
    code = 128 + 100 * made.ray_slopes(grid).reshape(120, 160, 2)
    shown, pinhole = made.undistorted(np.dstack([np.rint(code), 0 * x]).astype(np.uint8))
    assert pinhole.is_pinhole and not made.is_pinhole
    expected = 128 + 100 * pinhole.ray_slopes(grid).reshape(120, 160, 2)
    error = (shown[..., :2] - expected)[2:-2, 2:-2]
    assert np.abs(error).max() < 1.5  # a pixel is 0.9 of the code
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.02  # roundings cancel in the mean; a shift does not


POSE = np.array([[0, 0, -1, 0.1], [1, 0, 0, 0.2], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])


def test_a_camera_of_opengl_sees_what_is_before_it() -> None:
    """A camera of OpenGL looks along its -z axis, with +y up."""
    made = Camera.from_opengl(POSE, width=640, height=480, fx=500, fy=510, cx=300, cy=250)
    ahead, up, right = -POSE[:3, 2], POSE[:3, 1], POSE[:3, 0]
    pixels, depth = made.project(POSE[:3, 3] + 2 * ahead + [0 * up, 0.2 * up, 0.2 * right])
    np.testing.assert_allclose(depth, 2)
    np.testing.assert_allclose(pixels, [[300, 250], [300, 250 - 51], [350, 250]])
    assert Camera.from_opengl(np.eye(4), width=64, height=48, fx=50, fy=50, cx=32, cy=24).project([[0, 0, -1]])[1] == 1


@pytest.mark.parametrize(
    ("pose", "cause"),
    [
        (POSE.T, "is it transposed, with the translation in the last row?"),
        (np.diag([1, 1, -1, 1.0]) @ POSE, "is one axis inverted, or are two exchanged?"),
        (np.diag([0.001, 0.001, 0.001, 1]) @ POSE, "is a scale, such as metres per millimetre, part of the matrix?"),
        (np.diag([1, 1, 1, 1000.0]) @ POSE, "is it scaled?"),
        (np.diag([1, 1, 1, -1.0]) @ POSE, "is it scaled?"),
        (
            POSE + 0.01 * np.eye(4)[::-1] * ([1], [1], [1], [0]),
            "are its entries rounded, or rows and columns mixed up?",
        ),
    ],
)
def test_matrices_that_are_no_pose_are_refused_with_the_likely_cause(pose: np.ndarray, cause: str) -> None:
    for make in (lambda: Camera(640, 480, 500.0, 500.0, 320.0, 240.0, pose),
                 lambda: Camera.from_opengl(pose, width=640, height=480, fx=500, fy=500, cx=320, cy=240)):  # fmt: skip
        with pytest.raises(ValueError, match=r"^world_from_camera must ") as caught:
            make()
        assert str(caught.value).endswith(cause) and "\n" not in str(caught.value)
