"""Camera motion blur and chromatic aberration against closed forms and a slow twin."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mitsplat.frames.camera_response import develop
from mitsplat.frames.image_filters import apply_chromatic_aberration, blur_along_flow
from mitsplat.renderer.layers import device_array, host_array

SHAPE = 23, 31


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


def test_a_picture_is_blurred_before_it_is_encoded() -> None:
    linear = np.random.default_rng(2).random((*SHAPE, 3)).astype(np.float32)
    swept = np.full(SHAPE, 3.0, np.float32), np.full(SHAPE, -1.5, np.float32)
    blurred = host_array(blur_along_flow(device_array(linear), SHAPE, swept), SHAPE)
    got = develop(linear, {}, exposure_flow=swept)
    np.testing.assert_array_equal(got, develop(blurred, {}))
    assert np.abs(got.astype(float) - develop(linear, {})).mean() > 20


@pytest.mark.parametrize("corner", [1.5, -2.0])
def test_chromatic_aberration_magnifies_red_and_reduces_blue(corner: float) -> None:
    """On a linear ramp, where interpolation is exact, red at a point equals green nearer to the centre by the shift."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    linear = np.repeat((0.3 + 0.02 * x + 0.01 * y)[..., None], 3, axis=2).astype(np.float32)
    got = host_array(apply_chromatic_aberration(device_array(linear), SHAPE, corner), SHAPE)
    np.testing.assert_array_equal(got[..., 1], linear[..., 1])
    share = corner / (np.hypot(*SHAPE) / 2)
    beyond = share * (0.02 * (x - 15) + 0.01 * (y - 11))
    inside = slice(3, -3), slice(3, -3)
    np.testing.assert_allclose(got[..., 0][inside], (linear[..., 0] - beyond)[inside], atol=1e-6)
    np.testing.assert_allclose(got[..., 2][inside], (linear[..., 2] + beyond)[inside], atol=1e-6)
