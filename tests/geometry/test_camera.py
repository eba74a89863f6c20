"""Camera models against OpenCV's functions."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import cv2
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.formats.colmap import camera_model
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.geometry.lens import Lens, turning_slope
from mitsplat.renderer.layers import describe_sensor
from mitsplat.runtime.variant import ensure_variant

PINHOLE = Camera.look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0), width=640, height=480, fov_x=60)
BENT = (0.02, -0.01, 0.004, -0.001)
FISHEYE = replace(PINHOLE, fx=300.0, fy=290.0, cx=330.0, cy=235.0, distortion=BENT, lens="fisheye")


def test_fisheye_projection_agrees_with_opencv() -> None:
    angle, turn = np.meshgrid(np.linspace(0, 1.3, 14), np.linspace(0, 2 * np.pi, 9))
    slope = np.tan(angle.ravel())
    points = np.stack([slope * np.cos(turn.ravel()), slope * np.sin(turn.ravel()), np.ones_like(slope)], axis=1)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), FISHEYE.intrinsics, np.array(FISHEYE.distortion)
    )
    pixels, depth = FISHEYE.project(points)
    np.testing.assert_allclose(pixels, expected.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(depth, 1.0)


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), BENT])
def test_rays_of_a_fisheye_project_to_their_pixels(distortion: tuple[float, ...]) -> None:
    camera = replace(FISHEYE, distortion=distortion)
    x, y = np.meshgrid(np.linspace(0, 640, 9), np.linspace(0, 480, 7))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    slopes = camera.ray_slopes(pixels)
    back, _ = camera.project(np.column_stack([slopes, np.ones(len(slopes))]))
    np.testing.assert_allclose(back, pixels, atol=1e-6)


def test_unprojected_points_project_to_their_pixels_and_depths() -> None:
    camera = replace(FISHEYE, distortion=BENT, world_from_camera=look_at_pose((1, 2, 3), (0, 0.2, 0.1)))
    rng = np.random.default_rng(0)
    pixels, depth = rng.uniform((0, 0), (640, 480), (50, 2)), rng.uniform(0.1, 5, 50)
    back, z = camera.project(camera.unproject(pixels, depth))
    np.testing.assert_allclose(back, pixels, atol=1e-6)
    np.testing.assert_allclose(z, depth, rtol=1e-9)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"distortion": (0.1, 0.0)}, "must have 4 coefficients"),
        ({"fx": 200.0}, "at most 85 degrees"),
        ({"distortion": (-0.5, 0.0, 0.0, 0.0)}, "its distortion stops growing"),
    ],
)
def test_an_invalid_fisheye_is_refused(changes: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        replace(FISHEYE, **changes)


@pytest.mark.parametrize("width", [0, 10.5, 200_000])
def test_an_invalid_image_size_is_refused(width: float) -> None:
    with pytest.raises(ValueError, match=rf"whole numbers of 1 to 16384 px \(got {width}x480\)"):
        Camera(width, 480, 100.0, 100.0, 5.0, 240.0, np.eye(4))  # type: ignore[arg-type]


@pytest.mark.parametrize("changes", [{"fx": np.eye(3)}, {"cy": "240"}, {"cy": None}])
def test_intrinsics_that_are_no_numbers_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"(fx|cy) must be a number"):
        replace(PINHOLE, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("fov_x", [-10.0, 0.0, 180.0, 400.0])
def test_a_field_of_view_of_no_pinhole_camera_is_refused(fov_x: float) -> None:
    with pytest.raises(ValueError, match="fov_x must be between 0 and 180 degrees"):
        Camera.look_at((0, 0, 1), (0, 0, 0), width=8, height=6, fov_x=fov_x)


@pytest.mark.parametrize(
    ("forward", "up", "upwards"),
    [((0, 0, -1), (0, 0, 1), (0, 1, 0)), ((0, 2, 0), (0, 1, 0), (0, 0, 1)), ((0, -3, 0), (0, 1, 0), (0, 0, 1))],
)
def test_the_upper_edge_of_a_view_along_the_upper_direction(
    forward: tuple[float, ...], up: tuple[float, ...], upwards: tuple[float, ...]
) -> None:
    np.testing.assert_allclose(look_at_pose((0, 0, 0), forward, up)[:3, 1], -np.array(upwards))


def test_a_field_of_view_in_radians_is_reported() -> None:
    with pytest.warns(UserWarning, match=r"fov_x is 0\.86 degrees: is it in radians\? Then it is 49\.3 degrees"):
        Camera.look_at((0, 0, 1), (0, 0, 0), width=64, height=48, fov_x=0.86)


def test_positions_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match=r"must be finite \(got \[0.0, 0.0, nan\]"):
        look_at_pose((0, 0, np.nan), (0, 0, 0))


def test_the_sensor_plugin_traces_the_rays_of_the_camera() -> None:
    ensure_variant()
    from mitsplat.renderer.rays.sensors import view_of

    x, y = np.meshgrid(np.linspace(1, 639, 9), np.linspace(1, 479, 7))
    u, v = view_of(mi.load_dict(describe_sensor(FISHEYE))).slopes(mi.Float(x.ravel()), mi.Float(y.ravel()))
    expected = FISHEYE.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    np.testing.assert_allclose(np.stack([u, v], axis=1), expected, rtol=2e-5, atol=1e-5)


def test_the_sensor_plugin_renders_the_image_of_mitsubas_perspective_sensor() -> None:
    ensure_variant()
    camera = Camera.look_at((0.3, -3, 1), (0, 0, 0), width=32, height=24, fov_x=50)
    ours = describe_sensor(camera)
    theirs = {"type": "perspective", "fov": 50.0, "to_world": ours["to_world"], "film": ours["film"]}
    pictures = []
    for sensor in (ours, theirs):
        scene = {"type": "scene", "sensor": sensor, "ball": {"type": "sphere"}, "sky": {"type": "constant"}}
        pictures.append(np.array(mi.render(mi.load_dict({**scene, "integrator": {"type": "depth"}}), spp=64))[..., 0])
    assert 0.1 < (pictures[0] > 0).mean() < 0.9
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.02


@pytest.mark.parametrize("wrong", [{"distortion": "0.1"}, {"lens": "mirror"}, {"lens": "fisheye"}])
def test_the_sensor_plugin_refuses_invalid_lenses(wrong: dict[str, str]) -> None:
    ensure_variant()
    with pytest.raises((InputError, RuntimeError), match=r"opencv_camera.*(coefficients|lens)"):
        mi.load_dict({**describe_sensor(PINHOLE), **wrong})


@pytest.mark.parametrize(
    ("distortion", "lens", "model", "parameters"),
    [
        ((), "opencv", "PINHOLE", ()),
        (BENT, "opencv", "OPENCV", BENT),
        ((*BENT, 0.003), "opencv", "FULL_OPENCV", (*BENT, 0.003, 0, 0, 0)),
        ((*BENT, 0.003, 0.02, 0.01, 0.002), "opencv", "FULL_OPENCV", (*BENT, 0.003, 0.02, 0.01, 0.002)),
        (BENT, "fisheye", "OPENCV_FISHEYE", BENT),
    ],
)
def test_the_colmap_model_has_the_coefficients_of_the_lens(
    distortion: tuple[float, ...], lens: Lens, model: str, parameters: tuple[float, ...]
) -> None:
    name, *numbers = camera_model(replace(FISHEYE, distortion=distortion, lens=lens)).split()
    assert name == model
    assert [*map(float, numbers)] == [640, 480, 300, 290, 330, 235, *parameters]


def test_colmap_has_no_thin_prism_distortion() -> None:
    with pytest.raises(InputError, match="a lens without thin-prism distortion"):
        camera_model(replace(PINHOLE, distortion=(*BENT, 0.0, 0.0, 0.0, 0.0, 0.001, 0.0, 0.0, 0.0)))


THIN = replace(PINHOLE, aperture_radius=0.002, focus_distance=0.008, near=0.004)
"""A lens focused nearer than the default minimum depth of cameras."""


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE, THIN, replace(PINHOLE, fy=1000 / 3, cx=317.1, distortion=BENT)])
def test_json_keeps_every_field_of_a_camera(camera: Camera) -> None:
    back = Camera.from_json(json.loads(json.dumps(camera.to_json())))
    for field in fields(Camera):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(camera, field.name))
        assert type(getattr(back, field.name)) is type(getattr(camera, field.name))


@pytest.mark.parametrize(
    ("distortion", "turn"),
    [
        ((-0.3, 0.0, 0.0, 0.0), 1 / np.sqrt(0.9)),
        ((0.1, 0.02, 0.0, 0.0), np.inf),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0), 1.0),
    ],
)
def test_the_turning_slope_is_the_root_of_the_derivative(distortion: tuple[float, ...], turn: float) -> None:
    """r - 0.3 r^3 has its maximum at r^2 = 1 / 0.9, r / (1 + r^2) at r = 1; positive coefficients have none."""
    assert turning_slope(distortion) == pytest.approx(turn, rel=1e-9)


def test_points_beyond_the_turn_of_a_barrel_distortion_are_not_in_the_image() -> None:
    camera = Camera(640, 480, 700.0, 700.0, 320.0, 240.0, np.eye(4), (-0.3, 0.0, 0.0, 0.0))
    slopes = np.array([0.0, 0.5, 1.0, 1.05, 1.7, 3.0])
    pixels, depth = camera.project(np.column_stack([slopes, np.zeros(6), np.ones(6)]))
    assert np.isnan(pixels[4:]).all()
    assert (depth == 1.0).all()
    np.testing.assert_allclose(pixels[:4, 0], 320 + 700 * (slopes[:4] - 0.3 * slopes[:4] ** 3), rtol=1e-9)
    points = np.array([[3.0, 0.0, 1.0], [0.1, 0.0, -1.0], [0.5, 0.0, 1.0]])
    assert np.isnan(camera.project(points)[0]).all(axis=1).tolist() == [True, True, False]
