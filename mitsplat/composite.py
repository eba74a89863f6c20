"""Layers to picture: shadow, highlight, white balance, exposure, tone curve, noise."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mitsplat.render import Layers
from mitsplat.spec import Composite

FloatArray = npt.NDArray[np.float32]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 luminance of linear sRGB."""

BACKGROUND = 0.18
"""Linear grey where a scene shows nothing."""

CURVE_STEPS = 1 << 14
"""Entries of the tone curve's table, evenly spaced in the square root of the input."""

CURVE_WHITE = 16.0
"""Linear input at the end of the table."""


@dataclass(frozen=True)
class ImageShadow:
    """Parameters of the published image-space shadow (Niżeniec and Iwanowski, section 4.2).

    The shadow map is normalised, blurred, bent by a sigmoid and multiplied; where it is brightest, light is added.

    Attributes:
        blur: Standard deviation of the Gaussian blur [px at a width of 1280].
        slope: Steepness of the sigmoid.
        midpoint: Value of the normalised map that the sigmoid takes to one half.
        darkest: Factor in full shadow.
        highlight_start: Value of the normalised map above which the highlight starts.
        highlight_gain: Linear value that the highlight adds at most.
    """

    blur: float = 5.0
    slope: float = 10.0
    midpoint: float = 0.5
    darkest: float = 0.35
    highlight_start: float = 0.85
    highlight_gain: float = 0.06


def light_image(layers: Layers, composite: Composite, *, image_shadow: ImageShadow = ImageShadow()) -> FloatArray:
    """Linear picture (H, W, 3) from captured colour, shadow and highlight, over a grey background."""
    if composite.shadow == "image":
        factor, shine = shadow_from_image(layers.light @ LUMINANCE, image_shadow)
        lit = layers.captured * factor[..., None]
        if composite.highlight:
            lit += (shine * layers.alpha)[..., None]
    else:
        lit = layers.captured if composite.shadow == "none" else layers.captured * layers.light
        if composite.highlight:
            lit = lit + layers.highlight * layers.alpha[..., None]
    return np.asarray(lit + (BACKGROUND * (1 - layers.alpha))[..., None], dtype=np.float32)


def shadow_from_image(shadow_map: FloatArray, parameters: ImageShadow = ImageShadow()) -> tuple[FloatArray, FloatArray]:
    """Factor and highlight (H, W) that the published chain makes of a shadow map (H, W)."""
    import cv2

    brightest = float(np.percentile(shadow_map, 99.0))
    normalised = np.clip(shadow_map / max(brightest, 1e-6), 0.0, 1.0).astype(np.float32)
    soft = cv2.GaussianBlur(normalised, (0, 0), parameters.blur * shadow_map.shape[1] / 1280)

    def sigmoid(x: npt.ArrayLike) -> FloatArray:
        return np.asarray(1 / (1 + np.exp(-parameters.slope * (np.asarray(x) - parameters.midpoint))), dtype=np.float32)

    low, high = sigmoid(0.0), sigmoid(1.0)
    factor = parameters.darkest + (1 - parameters.darkest) * (sigmoid(soft) - low) / (high - low)
    shine = (
        np.clip((soft - parameters.highlight_start) / (1 - parameters.highlight_start), 0, 1)
        * parameters.highlight_gain
    )
    return factor.astype(np.float32), shine.astype(np.float32)


def develop(
    linear: FloatArray, draws: Mapping[str, float], *, tone: Literal["neutral", "filmic"] = "neutral", seed: int = 0
) -> npt.NDArray[np.uint8]:
    """Linear picture (H, W, 3) to display-encoded bytes, as a camera would develop it.

    Args:
        linear: Linear sRGB, 1 = display white.
        draws: ``exposure`` [stops], ``white_balance`` [K], ``hue`` [degrees], ``saturation``, ``noise`` [1 sigma of the
            encoded range]; what is missing changes nothing.
        tone: ``neutral`` shows captured colours unchanged; ``filmic`` rolls highlights off.
        seed: Seed of the noise.
    """
    matrix = colour_matrix(
        exposure=draws.get("exposure", 0.0),
        white_balance=draws.get("white_balance", 6504.0),
        hue=draws.get("hue", 0.0),
        saturation=draws.get("saturation", 1.0),
    )
    if not np.array_equal(matrix, np.eye(3)):
        linear = linear @ matrix.T.astype(np.float32)
    position = np.sqrt(np.clip(linear, 0.0, CURVE_WHITE) / CURVE_WHITE) * (CURVE_STEPS - 1)
    encoded = tone_curve(tone)[np.rint(position).astype(np.int32)]
    noise = draws.get("noise", 0.0)
    if noise > 0:
        rng = np.random.default_rng(seed)
        encoded = encoded + np.float32(noise) * rng.standard_normal(encoded.shape, dtype=np.float32)
    return np.asarray(np.rint(np.clip(encoded, 0.0, 1.0) * 255.0), dtype=np.uint8)


def colour_matrix(
    *, exposure: float = 0.0, white_balance: float = 6504.0, hue: float = 0.0, saturation: float = 1.0
) -> npt.NDArray[np.float64]:
    """One 3x3 matrix on linear sRGB for exposure, white balance, hue and saturation.

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
    return np.asarray(matrix * 2.0**exposure, dtype=np.float64)


def _colour() -> Any:
    """colour-science, without its warning that plots need matplotlib."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


@lru_cache(maxsize=64)
def _adaptation(kelvin: float) -> npt.NDArray[np.float64]:
    colour = _colour()
    xyz_from_rgb = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
    white = colour.xy_to_XYZ(colour.temperature.CCT_to_xy(kelvin, method="CIE Illuminant D Series"))
    target = colour.xy_to_XYZ(colour.RGB_COLOURSPACES["sRGB"].whitepoint)
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(white, target, transform="Bradford")
    matrix = np.linalg.inv(xyz_from_rgb) @ adapt @ xyz_from_rgb
    return np.asarray(matrix / (LUMINANCE @ matrix @ np.ones(3)), dtype=np.float64)


@lru_cache(maxsize=2)
def tone_curve(tone: Literal["neutral", "filmic"]) -> FloatArray:
    """Display-encoded values of linear inputs ``CURVE_WHITE * (i / (CURVE_STEPS - 1))^2``, by sRGB's transfer.

    ``filmic`` is Hable's curve (2010, "Filmic tonemapping operators", Uncharted 2), scaled so that 0.18 stays 0.18.
    """
    colour = _colour()
    x = CURVE_WHITE * (np.arange(CURVE_STEPS) / (CURVE_STEPS - 1)) ** 2
    if tone == "filmic":

        def hable(v: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
            return (v * (0.15 * v + 0.05) + 0.004) / (v * (0.15 * v + 0.5) + 0.06) - 0.02 / 0.3

        grid = np.linspace(0.0, 11.2, 4096)
        gain = np.interp(0.18 * hable(np.array(11.2)), hable(grid), grid) / 0.18
        x = hable(gain * x) / hable(np.array(11.2))
    encoded = colour.cctf_encoding(np.clip(x, 0.0, 1.0), function="sRGB")
    return np.asarray(encoded, dtype=np.float32)
