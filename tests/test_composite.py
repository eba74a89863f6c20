"""Development of linear pictures: identities and the published shadow chain."""

from __future__ import annotations

import numpy as np
import pytest

from mitsplat.composite import ImageShadow, colour_matrix, develop, shadow_from_image, tone_curve


def encode(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def test_neutral_development_shows_captured_colours_unchanged() -> None:
    encoded = np.arange(256, dtype=np.float64) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    image = develop(np.repeat(linear[None, :, None], 3, axis=2).astype(np.float32), {})
    np.testing.assert_array_equal(image[0, :, 0], np.arange(256))


def test_one_stop_doubles_linear_light() -> None:
    linear = np.full((2, 2, 3), 0.1, np.float32)
    np.testing.assert_allclose(develop(linear, {"exposure": 1.0}) / 255, encode(np.full((2, 2, 3), 0.2)), atol=0.003)


def test_hue_turns_and_keeps_grey() -> None:
    matrix = colour_matrix(hue=120.0)
    np.testing.assert_allclose(matrix @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(matrix @ [1, 1, 1], [1, 1, 1], atol=1e-12)


def test_saturation_zero_is_grey_of_equal_luminance() -> None:
    grey = colour_matrix(saturation=0.0) @ [0.2, 0.6, 0.1]
    np.testing.assert_allclose(grey, 0.2126 * 0.2 + 0.7152 * 0.6 + 0.0722 * 0.1, rtol=1e-6)


def test_white_balance_for_a_warm_light_makes_white_cooler() -> None:
    red, _, blue = colour_matrix(white_balance=4500.0) @ [1, 1, 1]
    assert blue > 1 > red
    np.testing.assert_allclose(colour_matrix(white_balance=6504.0), np.eye(3))


@pytest.mark.parametrize("tone", ["neutral", "filmic"])
def test_tone_curves_rise_from_black_to_white(tone: str) -> None:
    curve = tone_curve(tone)
    assert curve[0] == pytest.approx(0, abs=2e-3)
    assert (np.diff(curve) >= 0).all()
    assert curve[-1] <= 1


def test_filmic_keeps_mid_grey() -> None:
    image = develop(np.full((1, 1, 3), 0.18, np.float32), {}, tone="filmic")
    assert abs(int(image[0, 0, 0]) - 118) <= 1


def test_noise_has_the_stated_deviation_and_comes_from_the_seed() -> None:
    linear = np.full((64, 64, 3), 0.2, np.float32)
    a, b, c = (develop(linear, {"noise": 0.02}, seed=s) for s in (1, 1, 2))
    assert a.tobytes() == b.tobytes() != c.tobytes()
    assert np.std(a / 255.0) == pytest.approx(0.02, rel=0.05)


def test_published_shadow_is_darkest_in_shadow_and_one_in_light() -> None:
    shadow_map = np.ones((64, 128), np.float32)
    shadow_map[:, :40] = 0.0
    parameters = ImageShadow(blur=20.0, darkest=0.4)
    factor, shine = shadow_from_image(shadow_map, parameters)
    assert factor[32, 2] == pytest.approx(0.4, abs=0.01)
    assert factor[32, 120] == pytest.approx(1.0, abs=0.01)
    assert (np.diff(factor[32]) >= -1e-6).all()
    assert shine[32, 2] == 0 and shine[32, 120] == pytest.approx(parameters.highlight_gain, rel=0.01)
