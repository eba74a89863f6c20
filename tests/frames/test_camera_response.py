"""Camera response: identities and the published processing chain of linear images."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import cv2
import drjit as dr
import numpy as np
import pytest
from scipy import stats

from mitsplat.frames.camera_response import (
    DARKEST_SHADOW,
    FULL_WELL,
    GREY,
    HIGHLIGHT_GAIN,
    READ_NOISE,
    add_noise,
    camera_exposure,
    colour_matrix,
    develop,
    lit_picture,
    shadow_from_image,
    tone_curve,
)
from mitsplat.frames.image_filters import correlate, motion_kernel
from mitsplat.images.colour import (
    LUMINANCE,
    decode_srgb,
    encode_srgb,
    neutral_matrix,
    temperature_colour,
    white_balance_matrix,
)
from mitsplat.renderer.layers import Layers, device_array, host_array
from mitsplat.scene.spec.image_spec import CameraExposure, Composite


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


def test_hue_rotates_chroma_and_keeps_grey_and_luminance() -> None:
    """A rotation by 120 degrees permutes the chroma, the difference from the mean of the channels."""
    matrix, colour = colour_matrix({"hue": 120.0}), np.array([0.7, 0.2, 0.1])
    turned = matrix @ colour
    np.testing.assert_allclose(turned - turned.mean(), np.roll(colour - colour.mean(), 1), atol=1e-12)
    np.testing.assert_allclose(matrix @ [1, 1, 1], [1, 1, 1], atol=1e-12)
    for angle in (-170.0, -6.0, 45.0, 120.0):
        assert LUMINANCE @ (colour_matrix({"hue": angle}) @ colour) == pytest.approx(LUMINANCE @ colour, rel=1e-6)
        back = colour_matrix({"hue": -angle}) @ colour_matrix({"hue": angle})
        np.testing.assert_allclose(back, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 50.0, 120.0])
def test_chroma_is_stretched_along_a_hue_and_its_opposite(angle: float) -> None:
    """Hues are angles about the grey axis; 120 degrees from red is green."""
    turned, across = colour_matrix({"hue": angle}) @ [1, 0, 0], colour_matrix({"hue": angle + 90}) @ [1, 0, 0]
    along, beside = turned - turned.mean(), across - across.mean()
    matrix = colour_matrix({"chroma_stretch": 1.5, "chroma_angle": angle})
    np.testing.assert_allclose(matrix @ along, 1.5 * along, atol=1e-12)
    np.testing.assert_allclose(matrix @ beside, beside / 1.5, atol=1e-12)
    np.testing.assert_allclose(matrix @ [1, 1, 1], [1, 1, 1], atol=1e-12)


def test_saturation_zero_is_grey_of_equal_luminance() -> None:
    grey = colour_matrix({"saturation": 0.0}) @ [0.2, 0.6, 0.1]
    np.testing.assert_allclose(grey, 0.2126 * 0.2 + 0.7152 * 0.6 + 0.0722 * 0.1, rtol=1e-6)


def test_white_balance_for_a_warm_light_makes_white_cooler() -> None:
    red, _, blue = colour_matrix({"white_balance": 4500.0}) @ [1, 1, 1]
    assert blue > 1 > red
    np.testing.assert_allclose(colour_matrix({"white_balance": 6504.0}), np.eye(3))


def test_nan_and_infinite_pixels_change_no_other_pixel() -> None:
    linear = np.full((4, 8, 3), 0.2, np.float32)
    linear[1, 2:5] = [[np.inf], [np.nan], [-np.inf]]
    for draws in ({}, {"iso": 100.0, "hue": 3.0}):
        image, clean = develop(linear, draws), develop(np.full_like(linear, 0.2), draws)
        clean[1, 2:5] = image[1, 2:5]
        np.testing.assert_array_equal(image, clean)
    assert develop(linear, {})[1, [2, 4]].tolist() == [[255] * 3, [0] * 3]


@pytest.mark.parametrize("tone", ["neutral", "filmic"])
def test_tone_curves_rise_from_black_to_white(tone: str) -> None:
    curve = tone_curve(tone)
    assert curve[0] == pytest.approx(0, abs=2e-3)
    assert (np.diff(curve) >= 0).all()
    assert curve[-1] <= 1


def test_filmic_keeps_mid_grey() -> None:
    image = develop(np.full((1, 1, 3), 0.18, np.float32), {}, Composite(tone="filmic"))
    assert abs(int(image[0, 0, 0]) - 118) <= 1


@pytest.mark.parametrize("iso", [100.0, 1600.0])
@pytest.mark.parametrize("level", [0.02, 0.18, 0.6])
def test_sensor_noise_has_the_variance_of_its_electrons(iso: float, level: float) -> None:
    """N = level * full well * 100 / ISO electrons: variance N + read noise squared, after the tone curve."""
    linear = np.full((128, 128, 3), level, np.float32)
    a, b, c = (develop(linear, {"iso": iso}, seed=s) for s in (1, 1, 2))
    assert a.tobytes() == b.tobytes() != c.tobytes()
    white = FULL_WELL * 100 / iso
    deviation = np.sqrt(level * white + READ_NOISE**2) / white
    encoded = encode(np.maximum(level + np.linspace(-4, 4, 4001) * deviation, 0))
    weight = np.exp(-0.5 * np.linspace(-4, 4, 4001) ** 2)
    middle = np.average(encoded, weights=weight)
    expected = np.sqrt(np.average((encoded - middle) ** 2, weights=weight) + 1 / (12 * 255**2))
    assert np.std(a / 255.0) == pytest.approx(expected, rel=0.03)
    assert np.mean(a / 255.0) == pytest.approx(middle, abs=1e-3)


def noise(shape: tuple[int, int], level: float, iso: float, seed: int) -> np.ndarray:
    """Return the sensor noise added to a uniform linear image of a given level, shape (H, W, 3)."""
    linear = device_array(np.full((*shape, 3), level, np.float32))
    return host_array(add_noise(linear, shape, iso, seed), shape).astype(np.float64) - level


@pytest.mark.parametrize(("level", "iso"), [(0.0, 3200.0), (0.18, 100.0), (0.6, 1600.0)])
def test_noise_is_normal_and_without_correlation(level: float, iso: float) -> None:
    """Mean 0 and variance N + read_noise^2 for N electrons; each statistic lies within 5 of its standard errors."""
    shape = 400, 500
    white = FULL_WELL * 100 / iso
    deviation = np.sqrt(level * white + READ_NOISE**2) / white
    frames = [noise(shape, level, iso, seed) / deviation for seed in (7, 8, 7 + 2**32)]
    count = frames[0].size
    for frame in frames:
        assert abs(frame.mean()) < 5 / np.sqrt(count)
        assert abs(frame.var() - 1) < 5 * np.sqrt(2 / count)
        assert abs(stats.skew(frame.ravel())) < 5 * np.sqrt(6 / count)
        assert abs(stats.kurtosis(frame.ravel())) < 5 * np.sqrt(24 / count)
        assert stats.kstest(frame.ravel(), "norm").pvalue > 1e-4
    first, second, far = frames
    pairs = [(first[..., a], first[..., b]) for a, b in ((0, 1), (0, 2), (1, 2))]
    pairs += [(first[:, 1:], first[:, :-1]), (first[1:], first[:-1]), (first[1:, 1:], first[:-1, :-1])]
    pairs += [(first, second), (first, far), (first[:, 1:], second[:, :-1])]
    for a, b in pairs:
        assert abs(np.mean(a * b)) < 5 / np.sqrt(a.size)
        # Products of values miss dependences with random sign; products of squares reveal them.
        assert abs(np.mean((a**2 - 1) * (b**2 - 1))) < 5 * 2 / np.sqrt(a.size)


def test_noise_of_a_pixel_depends_on_no_other_and_on_no_thread() -> None:
    linear = np.random.default_rng(3).random((300, 217, 3)).astype(np.float32)
    draws = {"iso": 1600.0, "exposure": 0.5}
    whole = develop(linear, draws, seed=5)
    np.testing.assert_array_equal(develop(linear[:41], draws, seed=5), whole[:41])
    threads = dr.thread_count()
    try:
        for count in (1, 2, 5):
            dr.set_thread_count(count)
            np.testing.assert_array_equal(develop(linear, draws, seed=5), whole)
    finally:
        dr.set_thread_count(threads)


def developed_slowly(linear: np.ndarray, draws: Mapping[str, float]) -> np.ndarray:
    """Develop a picture without noise, in double precision and without a table, shape (H, W, 3) in [0, 255]."""
    height, width = linear.shape[:2]
    linear = linear.astype(np.float64) * 2 ** draws["exposure"]
    for y, x in np.ndindex(height, width):
        square = (x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2
        linear[y, x] *= 2 ** (-draws["vignetting"] * square / ((height / 2) ** 2 + (width / 2) ** 2))
    kernel = motion_kernel(draws["motion_blur"], draws["motion_angle"]).astype(np.float64)
    linear = cv2.filter2D(linear, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return 255 * np.clip(encode(linear @ colour_matrix(draws).T), 0, 1)


def test_developed_images_equal_the_slow_twin() -> None:
    linear = np.random.default_rng(0).random((37, 53, 3)).astype(np.float32)
    draws = {"exposure": -0.4, "vignetting": 1.5, "motion_blur": 5.0, "motion_angle": 130.0}
    draws |= {"white_balance": 5200.0, "hue": 6.0, "saturation": 1.2}
    # Half a rounding step, plus the spacing of the table's entries.
    assert np.abs(develop(linear, draws) - developed_slowly(linear, draws)).max() < 0.5 + 0.05


@pytest.mark.parametrize("angle", [0.0, 75.0, 200.0])
@pytest.mark.parametrize("length", [0.7, 4.0, 19.0])
def test_motion_blur_is_a_correlation_beyond_replicated_borders(length: float, angle: float) -> None:
    shape = 23, 31
    linear = np.random.default_rng(1).random((*shape, 3)).astype(np.float32)
    kernel = motion_kernel(length, angle)
    got = host_array(correlate(device_array(linear), shape, kernel), shape)
    expected = cv2.filter2D(linear.astype(np.float64), -1, kernel.astype(np.float64), borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_other_draws_compile_no_new_kernels() -> None:
    linear = np.random.default_rng(2).random((30, 40, 3)).astype(np.float32)
    names = ("exposure", "vignetting", "motion_blur", "motion_angle", "iso", "white_balance", "hue", "saturation")
    names += ("chromatic_aberration", "chroma_stretch", "chroma_angle")
    drawn = [
        (0.3, 0.5, 3.0, 20.0, 200.0, 5000.0, 3.0, 1.1, 0.7, 1.2, 30.0),
        (-0.2, 0.9, 11.0, 80.0, 900.0, 7e3, -5.0, 0.9, -2.0, 0.9, 80.0),
    ]

    def kernels(draws: tuple[float, ...], seed: int) -> set[Any]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            flow = np.full((30, 40), 3.0 * seed, np.float32), np.full((30, 40), 1.0, np.float32)
            develop(linear, dict(zip(names, draws, strict=True)), seed=seed, exposure_flow=flow)
            return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    first, second = kernels(drawn[0], 1), kernels(drawn[1], 2)
    assert first and second == first


def test_vignetting_darkens_the_corner_by_its_stops_and_not_the_centre() -> None:
    linear = np.full((101, 201, 3), 0.4, np.float32)
    encoded = develop(linear, {"vignetting": 2.0}) / 255
    assert encoded[50, 100, 0] == pytest.approx(encode(np.array(0.4)), abs=0.004)
    assert encoded[0, 0, 0] == pytest.approx(encode(np.array(0.1)), abs=0.01)


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 215.0])
@pytest.mark.parametrize("length", [0.5, 3.0, 12.0])
def test_the_motion_kernel_is_a_line_of_its_length_and_angle(length: float, angle: float) -> None:
    """A uniform line of length L has variance L^2 / 12 along itself; bilinear weights add at most 1/4 px^2 each way."""
    kernel = motion_kernel(length, angle)
    reach = kernel.shape[0] // 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    along = x * np.cos(np.radians(angle)) - y * np.sin(np.radians(angle))
    across = x * np.sin(np.radians(angle)) + y * np.cos(np.radians(angle))
    assert kernel.sum() == pytest.approx(1, abs=1e-5)
    assert (kernel * x).sum() == pytest.approx(0, abs=1e-4) and (kernel * y).sum() == pytest.approx(0, abs=1e-4)
    assert 0 <= (kernel * along**2).sum() - length**2 / 12 < 0.26
    assert (kernel * across**2).sum() < 0.26


def test_motion_blur_keeps_even_pictures_and_spreads_points() -> None:
    even = np.full((20, 30, 3), 0.3, np.float32)
    draws = {"motion_blur": 6.0, "motion_angle": 40.0}
    assert np.array_equal(develop(even, draws), develop(even, {}))
    point = np.zeros((21, 21, 3), np.float32)
    point[10, 10] = 1
    smeared = develop(point, {"motion_blur": 6.0, "motion_angle": 0.0})[..., 0]
    assert np.flatnonzero(smeared.any(axis=0)).tolist() == list(range(7, 14))
    assert np.flatnonzero(smeared.any(axis=1)).tolist() == [10]


def test_sharpening_overshoots_an_edge_by_its_closed_form() -> None:
    """Next to a step, the blur takes the weight of the Gaussian beyond the step."""
    even = np.full((9, 21, 3), 0.3, np.float32)
    assert np.array_equal(develop(even, {"sharpening": 2.0}), develop(even, {}))
    even[:, 10:] = 0.1
    plain, sharp = (develop(even, draws)[4, :, 0].astype(float) for draws in ({}, {"sharpening": 0.8}))
    weights = np.exp(-0.5 * np.arange(-3, 4) ** 2)
    missed = (weights[4:].sum() / weights.sum()) * (plain[9] - plain[10])
    assert sharp[9] - plain[9] == pytest.approx(0.8 * missed, abs=1.5)
    assert plain[10] - sharp[10] == pytest.approx(0.8 * missed, abs=1.5)
    assert np.array_equal(sharp[:6], plain[:6]) and np.array_equal(sharp[14:], plain[14:])


def test_jpeg_of_low_quality_loses_detail_and_keeps_the_channels() -> None:
    rng = np.random.default_rng(0)
    linear = np.clip(0.3 + 0.1 * rng.normal(size=(64, 64, 1)) * (1, 1, 1) + (0.2, 0, 0), 0, 1).astype(np.float32)
    plain, fine, coarse = (develop(linear, draws).astype(float) for draws in ({}, {"jpeg": 98.0}, {"jpeg": 10.0}))
    assert np.abs(fine - plain).mean() < 3 < 0.4 * np.abs(coarse - plain).mean()


@pytest.mark.parametrize("kelvin", [2000.0, 2700.0, 3999.0, 4001.0, 4500.0, 6504.0, 12000.0])
def test_a_lamp_is_neutral_under_white_balance_for_its_temperature(kelvin: float) -> None:
    lamp = np.array(temperature_colour(kelvin))
    for balanced in (white_balance_matrix(kelvin) @ lamp, neutral_matrix(3 * lamp) @ lamp):
        assert np.ptp(balanced) < 0.005 * balanced.mean()
    picture = np.full((4, 4, 3), 0.2 * lamp, np.float32)
    for composite in (Composite(exposure="fixed", white_balance=kelvin), Composite(white_balance="auto")):
        image = develop(picture, {}, composite, light=lamp.tolist()).astype(int)
        assert np.ptp(image, axis=-1).max() <= 1


@pytest.mark.parametrize("kelvin", [1700.0, 2700.0, 4000.0])
def test_warm_lamps_have_the_colour_of_a_black_body(kelvin: float) -> None:
    """Chromaticity of Planck's spectrum with the CIE 1931 observer; the fit of Kang et al. is within 0.0015."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour

        expected = colour.XYZ_to_xy(colour.sd_to_XYZ(colour.sd_blackbody(kelvin)))
    seen = np.linalg.inv(white_balance_matrix(kelvin)) @ [1, 1, 1]
    xyz = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ @ seen
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), expected, atol=1.5e-3)


def test_colours_of_light_agree_with_colour_science() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colour warns on import if Matplotlib is missing
        import colour
    space = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
    white = space.sum(axis=1)
    for kelvin in (1700.0, 2222.0, 2223.0, 4000.0, 4500.0, 5000.0, 7000.0, 7001.0, 25000.0):
        share = np.clip((kelvin - 4000) / 1000, 0, 1)
        black, day = (
            colour.xy_to_XYZ(colour.temperature.CCT_to_xy(min(max(kelvin, low), 25000), method=method))
            for low, method in ((0, "Kang 2002"), (4000, "CIE Illuminant D Series"))
        )
        light = (1 - share) * black + share * day
        adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(light, white, transform="Bradford")
        expected = np.linalg.inv(space) @ adapt @ space
        expected /= LUMINANCE @ expected @ np.ones(3)
        np.testing.assert_allclose(white_balance_matrix(kelvin), expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(neutral_matrix(np.linalg.inv(space) @ light), expected, rtol=0, atol=1e-12)
        linear = np.maximum(np.linalg.inv(space) @ light, 0)
        np.testing.assert_allclose(temperature_colour(kelvin), linear / (LUMINANCE @ linear), rtol=1e-12)


def test_the_locus_of_colour_temperatures_is_continuous() -> None:
    for kelvin in (4000.0, 5000.0):
        np.testing.assert_allclose(temperature_colour(kelvin - 0.1), temperature_colour(kelvin + 0.1), atol=1e-3)


def test_temperature_colours_are_warm_below_daylight_and_of_luminance_one() -> None:
    warm, cool = np.array(temperature_colour(2700.0)), np.array(temperature_colour(9000.0))
    for colour in (warm, cool):
        assert colour @ [0.2126, 0.7152, 0.0722] == pytest.approx(1, rel=1e-6)
    assert warm[0] > warm[1] > warm[2] and cool[2] > cool[1] > cool[0]
    np.testing.assert_allclose(temperature_colour(6504.0), 1, atol=0.06)


def test_the_published_matrix_adapts_white() -> None:
    """Lindbloom's Bradford matrix from D50 to D65; daylight of 5003 K equals D50 within the published digits."""
    space = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    adapt = np.array(
        [[0.9555766, -0.0230393, 0.0631636], [-0.0282895, 1.0099416, 0.0210077], [0.0122982, -0.0204830, 1.3299098]]
    )
    expected = np.linalg.inv(space) @ adapt @ space
    np.testing.assert_allclose(white_balance_matrix(5003.0), expected / (LUMINANCE @ expected @ np.ones(3)), atol=2e-3)


def test_the_srgb_transfer_agrees_with_colour_science() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # colour warns on import if Matplotlib is missing
        import colour
    linear = np.linspace(0.0, 1.0, 1001)
    expected = colour.cctf_encoding(linear, function="sRGB")
    np.testing.assert_allclose(encode_srgb(linear), expected, rtol=1e-14, atol=0)
    np.testing.assert_allclose(decode_srgb(expected), linear, rtol=1e-12, atol=1e-15)


def test_published_shadow_is_darkest_in_shadow_and_one_in_light() -> None:
    shadow_map = np.ones((64, 128), np.float32)
    shadow_map[:, :40] = 0.0
    factor, highlight = shadow_from_image(shadow_map)
    assert factor[32, 2] == pytest.approx(DARKEST_SHADOW, abs=0.01)
    assert factor[32, 120] == pytest.approx(1.0, abs=0.01)
    assert (np.diff(factor[32]) >= -1e-6).all()
    assert highlight[32, 2] == 0 and highlight[32, 120] == pytest.approx(HIGHLIGHT_GAIN, rel=0.01)


def test_the_published_shadow_reaches_the_picture() -> None:
    light = np.ones((64, 128, 3), np.float32)
    light[:, :40] = 0.0
    layers = dict.fromkeys((f.name for f in fields(Layers)), np.zeros((64, 128), np.float32))
    layers |= {"captured": np.full((64, 128, 3), 0.5, np.float32), "alpha": np.ones((64, 128), np.float32)}
    layers = Layers(**{**layers, "light": light})
    picture = lit_picture(layers, Composite(shadow="image"))
    np.testing.assert_allclose(picture[32, 2], 0.5 * DARKEST_SHADOW, atol=0.005)
    np.testing.assert_allclose(picture[32, 120], 0.5 + HIGHLIGHT_GAIN, atol=0.005)


@pytest.mark.parametrize("tone", ["neutral", "filmic"])
@pytest.mark.parametrize("light", [0.05, 1.0, 20.0])
def test_metered_pictures_are_grey_on_average_in_any_light(light: float, tone: Any) -> None:
    grey = np.repeat(np.random.default_rng(0).uniform(0, light, (90, 160, 1)), 3, axis=2).astype(np.float32)
    metered = Composite(tone=tone, exposure="auto")
    assert develop(grey, {}, metered).mean() == pytest.approx(GREY, abs=1)
    assert develop(grey, {"exposure": -1.0}, metered).mean() < GREY - 20


def test_the_exposure_of_a_camera_saturates_at_the_luminance_of_iso_12232() -> None:
    """Value 1 needs H = 78 / S [lx s], and H = 0.65 L t / N^2 with L = 179 lm/W times radiance E / pi."""
    aperture, shutter, iso, irradiance = 4.0, 0.01, 200.0, 50.0
    exposure = CameraExposure(aperture=aperture, shutter=shutter, iso=iso)
    luminance = 179.0 * irradiance / np.pi
    stops = np.log2(0.65 * luminance * shutter / aperture**2 / (78.0 / iso))
    assert camera_exposure(exposure, (irradiance,) * 3) == pytest.approx(stops, abs=1e-6)
    ev = np.log2(aperture**2 / shutter * 100 / iso)
    assert camera_exposure(CameraExposure(ev=ev)) == pytest.approx(camera_exposure(exposure))
    picture = np.full((2, 2, 3), 0.2, np.float32)
    shown = develop(picture, {"exposure": 0.5}, Composite(exposure=exposure), white=(irradiance,) * 3)
    np.testing.assert_allclose(shown / 255, encode(np.full((2, 2, 3), 0.2 * 2 ** (stops + 0.5))), atol=0.003)


def test_metering_counts_a_lamp_as_white_at_most() -> None:
    room = np.full((90, 160, 3), 0.1, np.float32)
    room[:9, :16] = 1000.0
    lamp, paper = room.copy(), room.copy()
    paper[:9, :16] = 50.0
    metered = Composite(exposure="auto")
    assert np.array_equal(develop(lamp, {}, metered), develop(paper, {}, metered))


@pytest.mark.parametrize("size", [(1024, 1024), (16384, 96), (8, 8192)])
def test_metering_samples_all_columns_of_a_picture(size: tuple[int, int]) -> None:
    width, height = size
    stripes = np.where(np.arange(width) // max(1, width // 32) % 2, 0.5, 0.02).astype(np.float32)
    picture = np.broadcast_to(stripes[None, :, None], (height, width, 3)).copy()
    assert develop(picture, {}, Composite(exposure="auto")).mean() == pytest.approx(GREY, abs=1)


def test_metering_of_a_black_picture_stays_black() -> None:
    assert develop(np.zeros((9, 16, 3), np.float32), {}, Composite(exposure="auto")).max() == 0
