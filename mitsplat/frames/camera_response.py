"""Layers to picture: shadow and highlight, then lens, sensor, colour, tone curve and compression of a camera."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.colour import LUMINANCE, colour_science
from mitsplat.render.layers import Layers
from mitsplat.scene.spec import Composite, ImageShadow, Sensor

BACKGROUND = 0.18
"""Linear grey where a scene shows nothing."""

SENSOR = Sensor()

CURVE_STEPS = 1 << 14
"""Entries of the tone curve's table, evenly spaced in the square root of the input."""

CURVE_WHITE = 16.0
"""Linear input at the end of the table."""


def light_image(layers: Layers, composite: Composite) -> Float32Array:
    """Linear picture (H, W, 3) with the shadows asked for, over a grey background."""
    if composite.shadow == "image":
        factor, shine = shadow_from_image(layers.light @ LUMINANCE, composite.image_shadow)
        lit = layers.captured * factor[..., None]
        if composite.highlight:
            lit += (shine * layers.alpha)[..., None]
    else:
        lit = layers.captured if composite.shadow == "none" else layers.rgb
    return np.asarray(lit + (BACKGROUND * (1 - layers.alpha))[..., None], dtype=np.float32)


def shadow_from_image(shadow_map: Float32Array, parameters: ImageShadow) -> tuple[Float32Array, Float32Array]:
    """Factor and highlight (H, W) that the published chain makes of a shadow map (H, W)."""
    brightest = float(np.percentile(shadow_map, 99.0))
    normalised = np.clip(shadow_map / max(brightest, 1e-6), 0.0, 1.0).astype(np.float32)
    soft = cv2.GaussianBlur(normalised, (0, 0), parameters.blur * shadow_map.shape[1] / 1280)

    def sigmoid(x: npt.ArrayLike) -> Float32Array:
        return np.asarray(1 / (1 + np.exp(-parameters.slope * (np.asarray(x) - parameters.midpoint))), dtype=np.float32)

    low, high = sigmoid(0.0), sigmoid(1.0)
    factor = parameters.darkest + (1 - parameters.darkest) * (sigmoid(soft) - low) / (high - low)
    shine = (
        np.clip((soft - parameters.highlight_start) / (1 - parameters.highlight_start), 0, 1)
        * parameters.highlight_gain
    )
    return factor.astype(np.float32), shine.astype(np.float32)


def develop(
    linear: Float32Array,
    draws: Mapping[str, float],
    *,
    tone: Literal["neutral", "filmic"] = "neutral",
    sensor: Sensor = SENSOR,
    seed: int = 0,
) -> npt.NDArray[np.uint8]:
    """Linear picture (H, W, 3) to display-encoded bytes, as a camera would develop it.

    Args:
        linear: Linear sRGB, 1 = display white.
        draws: ``exposure`` [stops], ``vignetting`` [stops in the corners], ``motion_blur`` [px] along ``motion_angle``
            [degrees], ``iso``, ``white_balance`` [K], ``hue`` [degrees], ``saturation``, ``jpeg`` [quality]; what is
            missing changes nothing.
        tone: ``neutral`` shows captured colours unchanged; ``filmic`` rolls highlights off.
        sensor: What turns ``iso`` into noise.
        seed: Seed of the noise.
    """
    linear = _through_lens(linear, draws)
    if "iso" in draws:
        linear = _sensed(linear, draws["iso"], sensor, seed)
    matrix = colour_matrix(
        white_balance=draws.get("white_balance", 6504.0),
        hue=draws.get("hue", 0.0),
        saturation=draws.get("saturation", 1.0),
    )
    if not np.array_equal(matrix, np.eye(3)):
        linear = linear @ matrix.T.astype(np.float32)
    position = np.sqrt(np.clip(linear, 0.0, CURVE_WHITE) / CURVE_WHITE) * (CURVE_STEPS - 1)
    encoded = tone_curve(tone)[np.rint(position).astype(np.int32)]
    image = np.asarray(np.rint(np.clip(encoded, 0.0, 1.0) * 255.0), dtype=np.uint8)
    return _compressed(image, round(draws["jpeg"])) if "jpeg" in draws else image


def _through_lens(linear: Float32Array, draws: Mapping[str, float]) -> Float32Array:
    """Exposed, darker towards the corners, and blurred along a straight line by the camera's motion."""
    height, width = linear.shape[:2]
    if draws.get("exposure", 0.0):
        linear = linear * np.float32(2.0 ** draws["exposure"])
    if draws.get("vignetting", 0.0):
        y, x = np.ogrid[:height, :width]
        square = (x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2
        share = square / (0.25 * (height**2 + width**2))
        linear = linear * np.exp2(-draws["vignetting"] * share).astype(np.float32)[..., None]
    if draws.get("motion_blur", 0.0):
        kernel = motion_kernel(draws["motion_blur"], draws.get("motion_angle", 0.0))
        blurred = cv2.filter2D(np.ascontiguousarray(linear), -1, kernel, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(blurred, dtype=np.float32)
    return np.asarray(linear, dtype=np.float32)


def motion_kernel(length: float, angle: float) -> Float32Array:
    """Weights (K, K) of a line of ``length`` [px] through the middle, ``angle`` [degrees] above the x axis."""
    reach = int(np.ceil(length / 2))
    along = (np.arange(64 * (reach + 1)) + 0.5) / (64 * (reach + 1)) - 0.5
    x, y = (length * along * f(np.radians(angle)) + reach for f in (np.cos, lambda a: -np.sin(a)))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - (x - column)) * np.abs(1 - dy - (y - row))
            inside = weight > 0
            np.add.at(kernel, (row[inside] + dy, column[inside] + dx), weight[inside])
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def _sensed(linear: Float32Array, iso: float, sensor: Sensor, seed: int) -> Float32Array:
    """With shot and read noise: a variance of N + read_noise^2 for N electrons (EMVA 1288, section 2).

    Display white fills the wells at ISO 100. The Poisson noise of N is taken as normal.
    """
    electrons = np.float32(sensor.full_well * 100.0 / iso)
    rng = np.random.default_rng(seed)
    deviation = np.sqrt(np.maximum(linear, 0.0) / electrons + np.float32((sensor.read_noise / electrons) ** 2))
    return np.asarray(linear + deviation * rng.standard_normal(linear.shape, dtype=np.float32), dtype=np.float32)


def _compressed(image: npt.NDArray[np.uint8], quality: int) -> npt.NDArray[np.uint8]:
    """The picture after JPEG compression."""
    done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OSError(f"OpenCV could not encode an image of shape {image.shape} as jpg")
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)[..., ::-1])


def colour_matrix(*, white_balance: float = 6504.0, hue: float = 0.0, saturation: float = 1.0) -> Float64Array:
    """One 3x3 matrix on linear sRGB for white balance, hue and saturation.

    White balance is a Bradford adaptation from the daylight of that temperature to sRGB's white; hue turns colours
    about the grey axis; saturation scales their distance from the grey of the same luminance.
    """
    matrix = np.eye(3)
    if white_balance != 6504.0:
        matrix = _adaptation(float(white_balance))
    if hue:
        angle = np.radians(hue)
        axis = np.full((3, 3), 1 / 3)
        k = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
        matrix = (np.cos(angle) * np.eye(3) + (1 - np.cos(angle)) * axis + np.sin(angle) * k) @ matrix
    if saturation != 1.0:
        grey = np.broadcast_to(LUMINANCE.astype(np.float64), (3, 3))
        matrix = (saturation * np.eye(3) + (1 - saturation) * grey) @ matrix
    return np.asarray(matrix, dtype=np.float64)


@lru_cache(maxsize=64)
def _adaptation(kelvin: float) -> Float64Array:
    colour = colour_science()
    xyz_from_rgb = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
    white = colour.xy_to_XYZ(colour.temperature.CCT_to_xy(kelvin, method="CIE Illuminant D Series"))
    target = colour.xy_to_XYZ(colour.RGB_COLOURSPACES["sRGB"].whitepoint)
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(white, target, transform="Bradford")
    matrix = np.linalg.inv(xyz_from_rgb) @ adapt @ xyz_from_rgb
    return np.asarray(matrix / (LUMINANCE @ matrix @ np.ones(3)), dtype=np.float64)


@lru_cache(maxsize=2)
def tone_curve(tone: Literal["neutral", "filmic"]) -> Float32Array:
    """Display-encoded values of linear inputs ``CURVE_WHITE * (i / (CURVE_STEPS - 1))^2``, by sRGB's transfer.

    ``filmic`` is Hable's curve (2010, "Filmic tonemapping operators", Uncharted 2), scaled so that 0.18 stays 0.18.
    """
    colour = colour_science()
    x = CURVE_WHITE * (np.arange(CURVE_STEPS) / (CURVE_STEPS - 1)) ** 2
    if tone == "filmic":

        def hable(v: Float64Array) -> Float64Array:
            return (v * (0.15 * v + 0.05) + 0.004) / (v * (0.15 * v + 0.5) + 0.06) - 0.02 / 0.3

        grid = np.linspace(0.0, 11.2, 4096)
        gain = np.interp(0.18 * hable(np.array(11.2)), hable(grid), grid) / 0.18
        x = hable(gain * x) / hable(np.array(11.2))
    encoded = colour.cctf_encoding(np.clip(x, 0.0, 1.0), function="sRGB")
    return np.asarray(encoded, dtype=np.float32)
