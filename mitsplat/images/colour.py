"""Colour: the sRGB transfer function, colour matrices and colour temperatures."""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from mitsplat.arrays import Float64Array

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 luminance weights of linear sRGB."""


def encode_srgb(linear: npt.ArrayLike) -> Float64Array:
    """Encode linear values for display (IEC 61966-2-1). The curve continues above 1; values below 0 are clipped."""
    linear = np.maximum(np.asarray(linear, dtype=np.float64), 0.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: npt.ArrayLike) -> Float64Array:
    """Decode display-encoded values to linear values (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, dtype=np.float64)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4)


def hue_matrix(degrees: float) -> Float64Array:
    """Return the rotation of linear sRGB about the grey axis, shape (3, 3)."""
    angle = np.radians(degrees)
    axis = np.full((3, 3), 1 / 3)
    k = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    matrix: Float64Array = np.cos(angle) * np.eye(3) + (1 - np.cos(angle)) * axis + np.sin(angle) * k
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
def black_body_colour(kelvin: float) -> tuple[float, float, float]:
    """Return the linear sRGB colour of a black body (Kang et al. 2002), with luminance 1.

    Negative components become 0.
    """
    colour = _colour_science()
    white = colour.xy_to_XYZ(colour.temperature.CCT_to_xy(kelvin, method="Kang 2002"))
    rgb = np.maximum(np.linalg.inv(colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ) @ white, 0.0)
    red, green, blue = (rgb / (LUMINANCE @ rgb)).tolist()
    return red, green, blue


@lru_cache(maxsize=64)
def white_balance_matrix(kelvin: float) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that maps daylight of a temperature (CIE 15) to white of luminance 1.

    It is a von Kries adaptation in Bradford's cone space (Lam 1985).
    """
    colour = _colour_science()
    space = colour.RGB_COLOURSPACES["sRGB"]
    seen = colour.xy_to_XYZ(colour.temperature.CCT_to_xy(kelvin, method="CIE Illuminant D Series"))
    shown = colour.xy_to_XYZ(space.whitepoint)
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(seen, shown, transform="Bradford")
    matrix = np.linalg.inv(space.matrix_RGB_to_XYZ) @ adapt @ space.matrix_RGB_to_XYZ
    return np.asarray(matrix / (LUMINANCE @ matrix @ np.ones(3)), dtype=np.float64)


def _colour_science() -> Any:
    """Import colour-science without its warning that plots need Matplotlib."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour  # the import takes a second and warns
    return colour


def eight_bit(image: Image.Image) -> Image.Image:
    """Convert to RGB with 8 bits per channel. Transparent pixels keep their colour, 16-bit grey its upper byte."""
    if image.mode.startswith("I"):
        return Image.fromarray((np.asarray(image).astype(np.int64) // 256).clip(0, 255).astype(np.uint8)).convert("RGB")
    return image.convert("RGB")
