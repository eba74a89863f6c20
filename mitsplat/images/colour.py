"""Colour: the sRGB transfer function, colour matrices and colour temperatures."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from PIL import Image

from mitsplat.arrays import Float64Array

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 luminance weights of linear sRGB."""

_XYZ_FROM_SRGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Linear sRGB to CIE 1931 XYZ (IEC 61966-2-1)."""
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""CIE 1931 XYZ to Bradford's cone space (Lam 1985)."""


def encode_srgb(linear: npt.ArrayLike) -> Float64Array:
    """Encode linear values for display (IEC 61966-2-1). The curve continues above 1; values below 0 are clipped."""
    linear = np.maximum(np.asarray(linear, dtype=np.float64), 0.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: npt.ArrayLike) -> Float64Array:
    """Decode display-encoded values to linear values (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, dtype=np.float64)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4)


def hue_matrix(degrees: float) -> Float64Array:
    """Return the matrix (3, 3) that rotates linear sRGB about the grey axis, and adds grey to keep the luminance."""
    angle = np.radians(degrees)
    axis = np.full((3, 3), 1 / 3)
    k = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    rotation = np.cos(angle) * np.eye(3) + (1 - np.cos(angle)) * axis + np.sin(angle) * k
    matrix: Float64Array = rotation + (LUMINANCE - LUMINANCE @ rotation)
    return matrix


def saturation_matrix(factor: float) -> Float64Array:
    """Return the matrix on linear sRGB that scales the distance from the grey of equal luminance, shape (3, 3)."""
    grey = np.broadcast_to(LUMINANCE.astype(np.float64), (3, 3))
    matrix: Float64Array = factor * np.eye(3) + (1 - factor) * grey
    return matrix


def chroma_matrix(factor: float, degrees: float) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that scales chroma along one hue axis by ``factor``.

    The axis is at an angle from red. Chroma along the perpendicular axis is divided by ``factor``; greys stay
    unchanged.
    """
    angle = np.radians(degrees)
    red, across = np.array([2, -1, -1]) / np.sqrt(6), np.array([0, 1, -1]) / np.sqrt(2)
    along = np.cos(angle) * red + np.sin(angle) * across
    beside = np.cos(angle) * across - np.sin(angle) * red
    matrix: Float64Array = np.full((3, 3), 1 / 3) + factor * np.outer(along, along) + np.outer(beside, beside) / factor
    return matrix


@lru_cache(maxsize=256)
def temperature_colour(kelvin: float) -> tuple[float, float, float]:
    """Return the linear sRGB colour of light of a colour temperature, with luminance 1.

    Negative components, of light below 1900 K, become 0.
    """
    rgb = np.maximum(np.linalg.inv(_XYZ_FROM_SRGB) @ _temperature_xyz(kelvin), 0.0)
    red, green, blue = (rgb / (LUMINANCE @ rgb)).tolist()
    return red, green, blue


@lru_cache(maxsize=64)
def white_balance_matrix(kelvin: float) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that maps light of a colour temperature to white."""
    return _adaptation_matrix(_temperature_xyz(kelvin))


def neutral_matrix(light: npt.ArrayLike) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that maps the colour of a light to white."""
    return _adaptation_matrix(_XYZ_FROM_SRGB @ np.asarray(light, dtype=np.float64))


def _temperature_xyz(kelvin: float) -> Float64Array:
    """Return the XYZ of the reference illuminant of a colour temperature (ANSI/IES TM-30), with Y = 1.

    It is a black body up to 4000 K, daylight from 5000 K, and mixed linearly in between.
    """
    share = np.clip((kelvin - 4000.0) / 1000.0, 0.0, 1.0)
    mixed = np.zeros(3)
    for weight, chromaticity in ((1 - share, _black_body_xy), (share, _daylight_xy)):
        if weight:
            x, y = chromaticity(kelvin)
            mixed += weight * np.array([x / y, 1.0, (1 - x - y) / y])
    return mixed


def _black_body_xy(kelvin: float) -> tuple[float, float]:
    """Return the CIE 1931 chromaticity of a black body (Kang et al. 2002)."""
    if kelvin <= 4000:
        x = np.polyval([-0.2661239e9, -0.2343589e6, 0.8776956e3, 0.179910], 1 / kelvin)
    else:
        x = np.polyval([-3.0258469e9, 2.1070379e6, 0.2226347e3, 0.24039], 1 / kelvin)
    if kelvin <= 2222:
        y = np.polyval([-1.1063814, -1.34811020, 2.18555832, -0.20219683], x)
    elif kelvin <= 4000:
        y = np.polyval([-0.9549476, -1.37418593, 2.09137015, -0.16748867], x)
    else:
        y = np.polyval([3.0817580, -5.8733867, 3.75112997, -0.37001483], x)
    return float(x), float(y)


def _daylight_xy(kelvin: float) -> tuple[float, float]:
    """Return the CIE 1931 chromaticity of daylight from 4000 K (CIE 15)."""
    if kelvin <= 7000:
        x = np.polyval([-4.6070e9, 2.9678e6, 0.09911e3, 0.244063], 1 / kelvin)
    else:
        x = np.polyval([-2.0064e9, 1.9018e6, 0.24748e3, 0.237040], 1 / kelvin)
    return float(x), float(np.polyval([-3.0, 2.87, -0.275], x))


def _adaptation_matrix(xyz: Float64Array) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that maps a colour to white; sRGB's white keeps its luminance.

    It is a von Kries adaptation in Bradford's cone space (Lam 1985).
    """
    cones = _BRADFORD @ _XYZ_FROM_SRGB
    adapt = np.diag(cones.sum(axis=1) / (_BRADFORD @ (xyz / xyz[1])))
    matrix = np.linalg.inv(cones) @ adapt @ cones
    return np.asarray(matrix / (LUMINANCE @ matrix @ np.ones(3)), dtype=np.float64)


def eight_bit(image: Image.Image) -> Image.Image:
    """Convert to RGB with 8 bits per channel. Transparent pixels keep their colour, 16-bit grey its upper byte."""
    if image.mode.startswith("I"):
        return Image.fromarray((np.asarray(image).astype(np.int64) // 256).clip(0, 255).astype(np.uint8)).convert("RGB")
    return image.convert("RGB")
