"""Blur by the camera's own motion, and colours that a lens draws apart: against closed forms and a slow twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mitsplat.frames.camera_response import develop
from mitsplat.frames.flow import exposure_flow, optical_flow
from mitsplat.frames.image_filters import apply_chromatic_aberration, blur_along_flow
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import device_array, host_array
from mitsplat.scene.planning.viewpoints import handheld_transform

SHAPE = 23, 31


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.01, -0.005)])
def test_pixel_motion_agrees_with_projections_of_the_moved_camera(distortion: tuple[float, ...]) -> None:
    """Slowly, by optical flow to where the camera is before and after the middle of the exposure."""
    camera = Camera.look_at((0.3, -0.5, 0.4), (0, 0, 0), width=80, height=60, fov_x=60, distortion=distortion)
    depth = np.random.default_rng(0).uniform(0.4, 2.0, (60, 80))
    motion = {"exposure": 1e-3, "velocity": [0.2, -0.3, 0.4], "rotation": [20.0, -30.0, 10.0]}
    half = 0.5e-3 * np.concatenate([motion["velocity"], motion["rotation"]])
    poses = (camera.world_from_camera @ handheld_transform(way) for way in (-half, half))
    ends = [optical_flow(depth, camera, replace(camera, world_from_camera=pose)) for pose in poses]
    exact = ends[1].astype(np.float64) - ends[0]
    inside = slice(1, -1), slice(1, -1)  # at the border the lens's gradient is one-sided
    for axis, got in enumerate(exposure_flow(depth, camera, motion)):
        np.testing.assert_allclose(got[inside], exact[..., axis][inside], atol=2e-4)
        assert np.abs(got).max() > 0.02


def test_pixels_without_depth_move_by_rotation_only() -> None:
    camera = Camera.look_at((0.3, -0.5, 0.4), (0, 0, 0), width=80, height=60, fov_x=60)
    motion = {"exposure": 0.01, "velocity": [1.0, 2.0, 3.0], "rotation": [0.0, 30.0, 0.0]}
    right, down = exposure_flow(np.zeros((60, 80)), camera, motion)
    x, y = (np.mgrid[:60, :80][::-1] + 0.5 - np.reshape([40, 30], (2, 1, 1))) / camera.fx
    np.testing.assert_allclose(right, -np.radians(0.3) * camera.fx * (1 + x * x), rtol=1e-5)
    np.testing.assert_allclose(down, -np.radians(0.3) * camera.fx * x * y, rtol=1e-5, atol=1e-6)


def test_each_pixel_is_blurred_along_its_own_motion() -> None:
    rng = np.random.default_rng(1)
    linear = rng.random((*SHAPE, 3)).astype(np.float32)
    swept = rng.uniform(-9, 9, (2, *SHAPE)).astype(np.float32)
    got = host_array(blur_along_flow(device_array(linear), SHAPE, tuple(swept)), SHAPE)
    count = 1 + 2 * int(np.ceil(np.hypot(*swept).max() / 2))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    times = (np.arange(count) + 0.5) / count - 0.5
    seen = [[y + time * swept[1], x + time * swept[0]] for time in times]
    for channel in range(3):
        expected = np.mean([map_coordinates(linear[..., channel], at, order=1, mode="nearest") for at in seen], axis=0)
        np.testing.assert_allclose(got[..., channel], expected, atol=1e-5)


def test_a_still_camera_gives_no_blur() -> None:
    linear = np.random.default_rng(2).random((*SHAPE, 3)).astype(np.float32)
    still = np.zeros((2, *SHAPE), np.float32)
    np.testing.assert_array_equal(develop(linear, {}, exposure_flow=(still[0], still[1])), develop(linear, {}))


@pytest.mark.parametrize("corner", [1.5, -2.0])
def test_chromatic_aberration_magnifies_red_and_reduces_blue(corner: float) -> None:
    """Of a slope, whose interpolation is exact, red at a point is what green is nearer to the middle by its shift."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    linear = np.repeat((0.3 + 0.02 * x + 0.01 * y)[..., None], 3, axis=2).astype(np.float32)
    got = host_array(apply_chromatic_aberration(device_array(linear), SHAPE, corner), SHAPE)
    np.testing.assert_array_equal(got[..., 1], linear[..., 1])
    share = corner / (np.hypot(*SHAPE) / 2)
    beyond = share * (0.02 * (x - 15) + 0.01 * (y - 11))
    inside = slice(3, -3), slice(3, -3)
    np.testing.assert_allclose(got[..., 0][inside], (linear[..., 0] - beyond)[inside], atol=1e-6)
    np.testing.assert_allclose(got[..., 2][inside], (linear[..., 2] + beyond)[inside], atol=1e-6)
