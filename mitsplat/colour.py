"""Colours: the transfer function between linear light and display-encoded values, and the whites of temperatures."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 luminance of linear sRGB."""
_XYZ_FROM_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Of linear sRGB (IEC 61966-2-1)."""
_WHITE = (0.3127, 0.3290)
"""Chromaticity of sRGB's white."""
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""From tristimulus values to cone responses."""


def encode_srgb(linear: npt.ArrayLike) -> Float64Array:
    """Display-encoded values of linear ones (IEC 61966-2-1), continued above 1 and clipped below 0."""
    linear = np.maximum(np.asarray(linear, dtype=np.float64), 0.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: npt.ArrayLike) -> Float64Array:
    """Linear values of display-encoded ones (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, dtype=np.float64)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4)


def hue_matrix(degrees: float) -> Float64Array:
    """Rotation of linear sRGB about the grey axis, shape (3, 3)."""
    angle = np.radians(degrees)
    axis = np.full((3, 3), 1 / 3)
    k = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    matrix: Float64Array = np.cos(angle) * np.eye(3) + (1 - np.cos(angle)) * axis + np.sin(angle) * k
    return matrix


def saturation_matrix(factor: float) -> Float64Array:
    """Matrix on linear sRGB that scales the distance from the grey of the same luminance, shape (3, 3)."""
    grey = np.broadcast_to(LUMINANCE.astype(np.float64), (3, 3))
    matrix: Float64Array = factor * np.eye(3) + (1 - factor) * grey
    return matrix


@lru_cache(maxsize=256)
def black_body_colour(kelvin: float) -> tuple[float, float, float]:
    """Linear sRGB of a black body (Kang et al. 2002), of luminance 1; a negative component counts as 0."""
    rgb = np.maximum(np.linalg.inv(_XYZ_FROM_RGB) @ _xyz(*_planckian_xy(kelvin)), 0.0)
    red, green, blue = (rgb / (LUMINANCE @ rgb)).tolist()
    return red, green, blue


@lru_cache(maxsize=64)
def white_balance_matrix(kelvin: float) -> Float64Array:
    """Matrix (3, 3) on linear sRGB that shows daylight of a temperature as white, of luminance 1.

    A von Kries adaptation in Bradford's cone space (Lam 1985).
    """
    seen, shown = _BRADFORD @ _xyz(*_daylight_xy(kelvin)), _BRADFORD @ _xyz(*_WHITE)
    matrix = np.linalg.inv(_XYZ_FROM_RGB) @ (np.linalg.inv(_BRADFORD) @ np.diag(shown / seen) @ _BRADFORD)
    matrix = matrix @ _XYZ_FROM_RGB
    return np.asarray(matrix / (LUMINANCE @ matrix @ np.ones(3)), dtype=np.float64)


def _xyz(x: float, y: float) -> Float64Array:
    """Tristimulus values of a chromaticity, of luminance 1."""
    return np.array([x * (1 / y), 1.0, (1 - (x + y)) * (1 / y)])


def _planckian_xy(kelvin: float) -> tuple[float, float]:
    """Chromaticity of a black body of 1667 to 25000 K (Kang et al. 2002)."""
    square, cube = np.square(kelvin), np.power(kelvin, 3)
    if kelvin <= 4000:
        x = -0.2661239 * 10**9 / cube - 0.2343589 * 10**6 / square + 0.8776956 * 10**3 / kelvin + 0.179910
    else:
        x = -3.0258469 * 10**9 / cube + 2.1070379 * 10**6 / square + 0.2226347 * 10**3 / kelvin + 0.24039
    square, cube = np.square(x), np.power(x, 3)
    if kelvin <= 2222:
        return x, -1.1063814 * cube - 1.34811020 * square + 2.18555832 * x - 0.20219683
    if kelvin <= 4000:
        return x, -0.9549476 * cube - 1.37418593 * square + 2.09137015 * x - 0.16748867
    return x, 3.0817580 * cube - 5.8733867 * square + 3.75112997 * x - 0.37001483


def _daylight_xy(kelvin: float) -> tuple[float, float]:
    """Chromaticity of daylight of 4000 to 25000 K (CIE 15, illuminants D)."""
    square, cube = np.square(kelvin), np.power(kelvin, 3)
    if kelvin <= 7000:
        x = -4.607 * 10**9 / cube + 2.9678 * 10**6 / square + 0.09911 * 10**3 / kelvin + 0.244063
    else:
        x = -2.0064 * 10**9 / cube + 1.9018 * 10**6 / square + 0.24748 * 10**3 / kelvin + 0.23704
    return x, -3.000 * np.square(x) + 2.870 * x - 0.275
