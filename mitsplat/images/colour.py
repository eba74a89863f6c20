"""Colour: the sRGB transfer function, colour matrices and colour temperatures."""

from __future__ import annotations

import io
import warnings
from functools import lru_cache
from types import ModuleType

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageCms

from mitsplat.arrays import Float64Array

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 luminance weights of linear sRGB."""


_EQUAL_COLOURS = 2
"""Maximum difference of 8-bit colours between sRGB and a profile that counts as sRGB."""


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
    rgb = np.maximum(np.linalg.inv(_xyz_from_srgb()) @ _temperature_xyz(kelvin), 0.0)
    red, green, blue = (rgb / (LUMINANCE @ rgb)).tolist()
    return red, green, blue


@lru_cache(maxsize=64)
def white_balance_matrix(kelvin: float) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that maps light of a colour temperature to white."""
    return _adaptation_matrix(_temperature_xyz(kelvin))


def neutral_matrix(light: npt.ArrayLike) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that maps the colour of a light to white."""
    return _adaptation_matrix(_xyz_from_srgb() @ np.asarray(light, dtype=np.float64))


def _temperature_xyz(kelvin: float) -> Float64Array:
    """Return the XYZ of the reference illuminant of a colour temperature (ANSI/IES TM-30), with Y = 1.

    It is a black body up to 4000 K (Kang et al. 2002), daylight from 5000 K (CIE 15), and mixed linearly in between.
    """
    colour = _colour_science()
    share = np.clip((kelvin - 4000.0) / 1000.0, 0.0, 1.0)
    parts = [(1 - share, "Kang 2002"), (share, "CIE Illuminant D Series")]
    xyz: Float64Array = sum(
        weight * colour.xy_to_XYZ(colour.temperature.CCT_to_xy(kelvin, method=method))
        for weight, method in parts
        if weight
    )
    return xyz


def _adaptation_matrix(xyz: Float64Array) -> Float64Array:
    """Return the matrix (3, 3) on linear sRGB that maps a colour to white; sRGB's white keeps its luminance.

    It is a von Kries adaptation in Bradford's cone space (Lam 1985).
    """
    colour, space = _colour_science(), _xyz_from_srgb()
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(
        xyz / xyz[1], space.sum(axis=1), transform="Bradford"
    )
    matrix = np.linalg.inv(space) @ adapt @ space
    return np.asarray(matrix / (LUMINANCE @ matrix @ np.ones(3)), dtype=np.float64)


def _xyz_from_srgb() -> Float64Array:
    """Return the matrix (3, 3) from linear sRGB to XYZ."""
    return np.asarray(_colour_science().RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ, dtype=np.float64)


def _colour_science() -> ModuleType:
    """Import colour-science without its warning that plots need Matplotlib."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour  # the import takes a second and warns
    return colour


def eight_bit(image: Image.Image) -> Image.Image:
    """Convert to RGB with 8 bits per channel. Transparent pixels keep their colour, 16-bit grey its upper byte."""
    if image.mode.startswith("I"):
        return Image.fromarray((np.asarray(image).astype(np.int64) // 256).clip(0, 255).astype(np.uint8)).convert("RGB")
    if "transparency" in image.info:  # Pillow asks for this intermediate mode
        image = image.convert("RGBA")
    return image.convert("RGB")


def in_srgb(image: Image.Image) -> Image.Image:
    """Return an image with the colours of its ICC profile as sRGB; the same image if it has none or that of sRGB.

    Cameras store photographs in wider colour spaces, such as Display P3 or Adobe RGB. Images of printing colours
    (CMYK) and grey images become RGB. Damaged profiles are ignored, except for CMYK.

    Raises:
        ValueError: If an image of CMYK has no profile that can be read. Its colours are unknown then.
    """
    profile = image.info.get("icc_profile")
    converted = _from_profile(image, profile) if profile and image.mode in ("RGB", "RGBA", "L", "CMYK") else image
    if converted.mode == "CMYK":
        raise ValueError("its colours are CMYK without a readable profile: export it as RGB")
    return converted


def _from_profile(image: Image.Image, profile: bytes) -> Image.Image:
    """Return an image in sRGB; the same image if the profile is that of sRGB, or damaged."""
    bands = np.mgrid[(slice(0, 256, 51),) * min(3, len(image.getbands()))]
    levels = bands.reshape(len(bands), 1, -1).T.astype(np.uint8)
    probe = Image.fromarray(levels if len(bands) > 1 else levels[..., 0]).convert(image.mode)
    try:
        transform = ImageCms.buildTransform(
            ImageCms.ImageCmsProfile(io.BytesIO(profile)),
            ImageCms.createProfile("sRGB"),
            *(image.mode, "RGBA" if image.mode == "RGBA" else "RGB"),
            renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
        )
        shown = np.asarray(transform.apply(probe).convert("RGB")).astype(int)
        if image.mode != "CMYK" and np.abs(shown - levels).max() <= _EQUAL_COLOURS:
            return image
        converted = transform.apply(image)
    except (ImageCms.PyCMSError, OSError):
        return image
    converted.info = {**image.info, **converted.info}  # with EXIF
    return converted
