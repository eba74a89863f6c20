"""Blur by the camera's own motion, and colours that a lens draws apart: against closed forms and a slow twin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mitsplat.camera import Camera
from mitsplat.frames.camera_response import _drawn_apart, _smeared, develop
from mitsplat.frames.flow import swept_by
from mitsplat.render.layers import device_array, host_array

SHAPE = 23, 31


def test_pixels_move_by_the_motion_field() -> None:
    """Longuet-Higgins and Prazdny 1980, "The interpretation of a moving retinal image"."""
    camera = Camera.look_at((0.3, -0.5, 0.4), (0, 0, 0), width=40, height=30, fov_x=60)
    depth = np.random.default_rng(0).uniform(0.4, 2.0, (30, 40))
    depth[3:5, 7:9] = 0  # nothing: infinitely far
    motion = {"exposure": 1e-3, "velocity": [0.2, -0.3, 0.4], "rotation": [20.0, -30.0, 10.0]}
    right, down = swept_by(depth, camera, motion)
    x, y = (np.mgrid[:30, :40][::-1] + 0.5 - np.reshape([20, 15], (2, 1, 1))) / camera.fx
    (vx, vy, vz), (wx, wy, wz) = motion["velocity"], np.radians(motion["rotation"])
    near = np.divide(1, depth, where=depth > 0, out=np.zeros_like(depth))
    u = near * (x * vz - vx) + x * y * wx - (1 + x * x) * wy + y * wz
    v = near * (y * vz - vy) + (1 + y * y) * wx - x * y * wy - x * wz
    for got, rate in ((right, u), (down, v)):
        np.testing.assert_allclose(got, 1e-3 * camera.fx * rate, atol=2e-4)
        assert np.abs(got).max() > 0.01


def test_each_pixel_is_smeared_along_its_own_motion() -> None:
    rng = np.random.default_rng(1)
    linear = rng.random((*SHAPE, 3)).astype(np.float32)
    swept = rng.uniform(-9, 9, (2, *SHAPE)).astype(np.float32)
    got = host_array(_smeared(device_array(linear), dr.arange(mi.UInt32, 23 * 31), SHAPE, tuple(swept)), SHAPE)
    count = 1 + 2 * int(np.ceil(np.hypot(*swept).max() / 2))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    times = (np.arange(count) + 0.5) / count - 0.5
    seen = [[y + time * swept[1], x + time * swept[0]] for time in times]
    for channel in range(3):
        expected = np.mean([map_coordinates(linear[..., channel], at, order=1, mode="nearest") for at in seen], axis=0)
        np.testing.assert_allclose(got[..., channel], expected, atol=1e-5)


def test_a_camera_that_stands_still_blurs_nothing() -> None:
    linear = np.random.default_rng(2).random((*SHAPE, 3)).astype(np.float32)
    still = np.zeros((2, *SHAPE), np.float32)
    np.testing.assert_array_equal(develop(linear, {}, swept=(still[0], still[1])), develop(linear, {}))


@pytest.mark.parametrize("corner", [1.5, -2.0])
def test_red_is_magnified_and_blue_reduced_about_the_middle(corner: float) -> None:
    """Of a slope, whose interpolation is exact, red at a point is what green is nearer to the middle by its shift."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    linear = np.repeat((0.3 + 0.02 * x + 0.01 * y)[..., None], 3, axis=2).astype(np.float32)
    got = host_array(_drawn_apart(device_array(linear), dr.arange(mi.UInt32, 23 * 31), SHAPE, corner), SHAPE)
    np.testing.assert_array_equal(got[..., 1], linear[..., 1])
    share = corner / (np.hypot(*SHAPE) / 2)
    beyond = share * (0.02 * (x - 15) + 0.01 * (y - 11))
    inside = slice(3, -3), slice(3, -3)
    np.testing.assert_allclose(got[..., 0][inside], (linear[..., 0] - beyond)[inside], atol=1e-6)
    np.testing.assert_allclose(got[..., 2][inside], (linear[..., 2] + beyond)[inside], atol=1e-6)
