"""Camera response: shadow and highlight, then lens, sensor, colour, tone curve and compression of a camera."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import ByteImage, Float32Array, Float64Array
from mitsplat.frames.image_filters import (
    PixelFlow,
    apply_chromatic_aberration,
    blur_along_flow,
    columns_and_rows,
    correlate,
    motion_kernel,
    opaque_float,
    pixel_index,
)
from mitsplat.images.colour import (
    LUMINANCE,
    chroma_matrix,
    encode_srgb,
    hue_matrix,
    neutral_matrix,
    saturation_matrix,
    white_balance_matrix,
)
from mitsplat.renderer.layers import Layers, device_array, host_array
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.runtime.variant import one_at_a_time
from mitsplat.scene.spec.image_spec import DAYLIGHT, CameraExposure, Composite

Tone: TypeAlias = Literal["neutral", "filmic"]

BACKGROUND = 0.18
"""Linear grey of pixels in which a scene has no surface."""

FULL_WELL, READ_NOISE = 20000.0, 3.0
"""Electrons of a pixel at display white and ISO 100, and read noise [electrons], 1 sigma."""

CURVE_STEPS = 1 << 14
"""Entries of the tone curve's table, evenly spaced in the square root of the input."""

GREY = 118.0
"""Mean byte value (of 255) of a metered picture: middle grey of the standard output sensitivity (ISO 12232)."""

_METERED_PIXELS = 1 << 14
_MAX_METERING = 30.0
"""Maximum correction by metering, in both directions [stops]."""

WHITE = (math.pi,) * 3
"""Irradiance at which a white surface has radiance 1, by channel [W/m^2]."""

LUMINOUS_EFFICACY = 179.0
"""Luminance of radiance 1 [lm/W]: that of equal-energy white light in the visible range (Ward 1994, "The RADIANCE
lighting simulation and rendering system").
"""

SATURATION_LUMINANCE = 78.0 / (0.65 * 100.0)
"""Luminance of picture value 1 at EV 0 and ISO 100 [cd/m^2]: saturation-based speed 78 / H of ISO 12232, with the
exposure H = 0.65 L shutter / f-number^2 behind a typical lens.
"""

CURVE_WHITE = 16.0
"""Linear input at the end of the table."""

_SHADOW_BLUR = 5.0
"""Standard deviation of the blur of image-space shadows [px at a width of 1280]."""

_SHADOW_SLOPE = 10.0
"""Steepness of the sigmoid of image-space shadows, which is one half at half of the brightest light."""

DARKEST_SHADOW = 0.35
"""Factor of image-space shadows in full shadow."""

_HIGHLIGHT_START = 0.85
"""Fraction of the brightest light above which image-space shadows add a highlight."""

HIGHLIGHT_GAIN = 0.06
"""Maximum linear value of this highlight."""


@one_at_a_time
def lit_picture(layers: Layers, composite: Composite) -> Float32Array:
    """Compute the linear picture (H, W, 3) with the configured shadows over a grey background."""
    return host_array(apply_light(layers, composite), layers.shape)


def apply_light(layers: Layers, composite: Composite, background: mi.Color3f | float = BACKGROUND) -> mi.Color3f:
    """Compute the linear picture over a background on the device, flat and row-major."""
    alpha = layers.device_array("alpha")
    lit = layers.device_array("rgb" if composite.shadow == "traced" else "captured")
    if composite.shadow == "image":
        red, green, blue = layers.device_array("light")
        luminance = red * LUMINANCE[0] + green * LUMINANCE[1] + blue * LUMINANCE[2]
        maps = shadow_from_image(host_array(luminance, layers.shape))
        factor, highlight = (device_array(values) for values in maps)
        lit = lit * factor
        if composite.highlight:
            lit += highlight * alpha
    return lit + background * (1 - alpha)


def shadow_from_image(shadow_map: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Compute the factor and the highlight (H, W) of the image-space shadow from a shadow map (H, W).

    The map is the luminance of the traced light. It is normalised, blurred, and mapped by a sigmoid to the factor of
    the image. Where the map is brightest, a highlight is added (Niżeniec and Iwanowski, section 4.2).
    """
    brightest = float(np.percentile(shadow_map, 99.0))
    normalised = np.clip(shadow_map / max(brightest, 1e-6), 0.0, 1.0).astype(np.float32)
    soft = cv2.GaussianBlur(normalised, (0, 0), _SHADOW_BLUR * shadow_map.shape[1] / 1280)

    def sigmoid(x: npt.ArrayLike) -> Float32Array:
        return np.asarray(1 / (1 + np.exp(-_SHADOW_SLOPE * (np.asarray(x) - 0.5))), dtype=np.float32)

    low, high = sigmoid(0.0), sigmoid(1.0)
    factor = DARKEST_SHADOW + (1 - DARKEST_SHADOW) * (sigmoid(soft) - low) / (high - low)
    above_start = np.clip((soft - _HIGHLIGHT_START) / (1 - _HIGHLIGHT_START), 0, 1)
    return factor.astype(np.float32), (above_start * HIGHLIGHT_GAIN).astype(np.float32)


@one_at_a_time
def develop(
    linear: Float32Array,
    draws: Mapping[str, float],
    composite: Composite | None = None,
    *,
    seed: int = 0,
    exposure_flow: PixelFlow | None = None,
    white: Sequence[float] = WHITE,
    light: Sequence[float] = WHITE,
) -> ByteImage:
    """Convert a linear picture (H, W, 3) to display-encoded bytes with a camera model.

    Args:
        linear: Linear sRGB, 1 = display white.
        draws: ``exposure`` [stops], ``vignetting`` [stops in the corners], ``chromatic_aberration`` [px in the
            corners, red outwards and blue inwards], ``motion_blur`` [px] along ``motion_angle`` [degrees], ``iso``,
            ``white_balance`` [K], ``chroma_stretch`` along ``chroma_angle`` [degrees], ``hue`` [degrees],
            ``saturation``, ``sharpening`` [factor of the difference to a blur of 1 px], ``jpeg`` [quality]. A missing
            entry has no effect.
        composite: Tone curve, exposure, to which the draw ``exposure`` is added, and white balance. By default, the
            picture is neither exposed nor balanced.
        seed: Seed of the noise, below 2^64. The noise is a function of seed, row-major index and channel of a pixel.
        exposure_flow: Motion of every pixel during the exposure; None for no motion.
        white: Irradiance at which a white surface has the value 1, by channel [W/m^2]. Exposures of cameras use it.
        light: Irradiance that an automatic white balance makes neutral, by channel [W/m^2].
    """
    height, width = linear.shape[:2]
    composite, uploaded = composite or Composite(exposure="fixed"), device_array(linear)
    return start_development(
        uploaded, (height, width), draws, composite, seed=seed, exposure_flow=exposure_flow, white=white, light=light
    ).image()


def start_development(
    linear: mi.Color3f,
    shape: tuple[int, int],
    draws: Mapping[str, float],
    composite: Composite,
    *,
    seed: int,
    exposure_flow: PixelFlow | None,
    white: Sequence[float],
    light: Sequence[float],
) -> Development:
    """Start to :func:`develop` a picture on the device, flat and row-major over ``shape``."""
    balance = _white_point_matrix(composite, np.divide(light, white))
    if composite.exposure != "fixed":
        stops = (
            metered_exposure(linear, shape, composite.tone, LUMINANCE @ balance)
            if composite.exposure == "auto"
            else camera_exposure(composite.exposure, white)
        )
        draws = {**draws, "exposure": draws.get("exposure", 0.0) + stops}
    linear = _apply_lens(linear, shape, draws)
    if exposure_flow is not None:
        linear = blur_along_flow(linear, shape, exposure_flow)
    if draws.get("motion_blur", 0.0):
        linear = correlate(linear, shape, motion_kernel(draws["motion_blur"], draws.get("motion_angle", 0.0)))
    if "iso" in draws:
        linear = add_noise(linear, shape, draws["iso"], seed)
    matrix = colour_matrix(draws) @ balance
    if not np.array_equal(matrix, np.eye(3)):
        linear = mi.Color3f(*[sum(opaque_float(m) * c for m, c in zip(row, linear, strict=True)) for row in matrix])
    jpeg = round(draws["jpeg"]) if "jpeg" in draws else None
    return Development(_encode_bytes(linear, shape, composite.tone), shape, draws.get("sharpening", 0.0), jpeg)


def _encode_bytes(linear: mi.Color3f, shape: tuple[int, int], tone: Tone) -> mi.UInt8:
    """Encode a linear picture by the tone curve's table, with three bytes per pixel."""
    position = dr.sqrt(dr.clip(linear, 0.0, CURVE_WHITE) / CURVE_WHITE) * (CURVE_STEPS - 1)
    table, data = _byte_curve(tone, str(mi.variant())), dr.empty(mi.UInt8, 3 * shape[0] * shape[1])
    for channel in range(3):
        entry = dr.minimum(mi.UInt32(dr.round(position[channel])), CURVE_STEPS - 1)  # also bounds NaN
        value = dr.gather(mi.UInt32, table, entry)
        dr.scatter(data, mi.UInt8(value), 3 * pixel_index(shape) + channel, mode=dr.ReduceMode.Permute)
    dr.eval(data)
    return data


@dataclass(frozen=True, eq=False)
class Development:
    """Result of a development that may still run on the device.

    Attributes:
        data: Bytes on the device, flat and row-major, in the order red, green, blue.
        shape: Height and width [px].
        sharpening: Factor of the unsharp mask, the difference of the encoded picture to its Gaussian blur of 1 px.
        jpeg: Quality of the simulated JPEG compression, or None.
    """

    data: mi.UInt8
    shape: tuple[int, int]
    sharpening: float
    jpeg: int | None

    def image(self) -> ByteImage:
        """Wait for the picture and return it on the host, (H, W, 3)."""
        image = self.data.numpy().reshape(*self.shape, 3)
        if self.sharpening:
            blur = cv2.GaussianBlur(image, (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)
            image = np.asarray(cv2.addWeighted(image, 1 + self.sharpening, blur, -self.sharpening, 0), dtype=np.uint8)
        return image if self.jpeg is None else _jpeg_compressed(image, self.jpeg)


def metered_exposure(linear: mi.Color3f, shape: tuple[int, int], tone: Tone, weights: Float64Array) -> float:
    """Compute the exposure [stops], within 30 stops, at which the encoded luminance has the mean :data:`GREY`.

    The luminance is that after white balance: ``weights`` (3,) times linear sRGB before it. The mean is taken after
    encoding, so that clipped lamps weigh no more than white paper. It is estimated from evenly spaced pixels.
    """
    num_pixels = shape[0] * shape[1]
    step = max(1, num_pixels // _METERED_PIXELS)
    while math.gcd(step, shape[1]) > 1:  # a common divisor would leave columns out
        step += 1
    sampled_pixels = dr.arange(mi.UInt32, 0, num_pixels, step)
    dr.eval(linear)
    luminance = np.maximum(np.float32(weights) @ dr.gather(mi.Color3f, linear, sampled_pixels).numpy(), 0.0)
    curve = 255.0 * np.clip(tone_curve(tone), 0.0, 1.0)

    def mean(stops: float) -> float:
        step = np.sqrt(np.minimum(luminance * 2.0**stops, CURVE_WHITE) / CURVE_WHITE) * (CURVE_STEPS - 1)
        return float(curve[np.rint(step).astype(int)].mean())

    low, high = -_MAX_METERING, _MAX_METERING
    for _ in range(18):
        middle = (low + high) / 2
        low, high = (middle, high) if mean(middle) < GREY else (low, middle)
    return (low + high) / 2


def camera_exposure(exposure: CameraExposure, white: Sequence[float] = WHITE) -> float:
    """Compute the exposure [stops] of a camera for pictures of irradiance ``white`` by channel [W/m^2] at value 1."""
    luminance = LUMINOUS_EFFICACY * float(LUMINANCE @ np.asarray(white)) / math.pi
    return math.log2(luminance / SATURATION_LUMINANCE) - exposure.value


def _white_point_matrix(composite: Composite, light: Float64Array) -> Float64Array:
    """Return the 3x3 matrix on linear sRGB of the white balance; ``light`` is the colour of a white surface."""
    if composite.white_balance == "auto":
        return neutral_matrix(light)
    return np.eye(3) if composite.white_balance == DAYLIGHT else white_balance_matrix(composite.white_balance)


def _apply_lens(linear: mi.Color3f, shape: tuple[int, int], draws: Mapping[str, float]) -> mi.Color3f:
    """Apply chromatic aberration, exposure and vignetting."""
    if draws.get("chromatic_aberration", 0.0):
        linear = apply_chromatic_aberration(linear, shape, draws["chromatic_aberration"])
    if draws.get("exposure", 0.0):
        linear = linear * opaque_float(2.0 ** draws["exposure"])
    if draws.get("vignetting", 0.0):
        (height, width), (column, row) = shape, columns_and_rows(shape)
        x, y = mi.Float(column) + (0.5 - width / 2), mi.Float(row) + (0.5 - height / 2)
        share = (x * x + y * y) / (0.25 * (height**2 + width**2))
        linear = linear * dr.exp2(opaque_float(-draws["vignetting"]) * share)
    return linear


def add_noise(linear: mi.Color3f, shape: tuple[int, int], iso: float, seed: int) -> mi.Color3f:
    """Add shot and read noise: a variance of N + r^2 for N electrons and a read noise r (EMVA 1288, section 2).

    Display white fills the wells at ISO 100. The Poisson noise of N is approximated as normal. The random numbers are a
    function of the pixel index (Philox 4x32, Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"), so
    that they do not depend on the order of evaluation.
    """
    electrons = FULL_WELL * 100.0 / iso
    numbers = mi.Philox4x32(dr.opaque(mi.UInt64, seed), pixel_index(shape)).next_float32x4_normal()
    shot, read = opaque_float(1 / electrons), opaque_float((READ_NOISE / electrons) ** 2)
    return linear + dr.sqrt(dr.maximum(linear, 0.0) * shot + read) * mi.Color3f(numbers.x, numbers.y, numbers.z)


def _jpeg_compressed(image: ByteImage, quality: int) -> ByteImage:
    """Return the picture after JPEG compression."""
    done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OSError(f"OpenCV could not encode an image of shape {image.shape} as jpg")
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)[..., ::-1])


def colour_matrix(draws: Mapping[str, float]) -> Float64Array:
    """Compute a 3x3 matrix on linear sRGB for white balance, chroma, hue and saturation, in this order.

    White balance is a Bradford adaptation from light of the given temperature to sRGB's white. Chroma is a factor
    and an angle of :func:`mitsplat.images.colour.chroma_matrix`. Hue rotates colours about the grey axis and keeps
    their luminance. Saturation scales their distance from the grey of the same luminance.
    """
    matrix = np.eye(3)
    if draws.get("white_balance", DAYLIGHT) != DAYLIGHT:
        matrix = white_balance_matrix(float(draws["white_balance"]))
    if draws.get("chroma_stretch", 1.0) != 1.0:
        matrix = chroma_matrix(draws["chroma_stretch"], draws.get("chroma_angle", 0.0)) @ matrix
    if draws.get("hue", 0.0):
        matrix = hue_matrix(draws["hue"]) @ matrix
    if draws.get("saturation", 1.0) != 1.0:
        matrix = saturation_matrix(draws["saturation"]) @ matrix
    return np.asarray(matrix, dtype=np.float64)


@lru_cache(maxsize=2)
def tone_curve(tone: Tone) -> Float32Array:
    """Tabulate encoded values of linear inputs ``CURVE_WHITE * (i / (CURVE_STEPS - 1))^2``, with sRGB's transfer.

    ``filmic`` is Hable's curve (2010, "Filmic tonemapping operators", Uncharted 2), scaled so that 0.18 stays 0.18.
    """
    x = CURVE_WHITE * (np.arange(CURVE_STEPS) / (CURVE_STEPS - 1)) ** 2
    if tone == "filmic":

        def hable(v: Float64Array) -> Float64Array:
            return (v * (0.15 * v + 0.05) + 0.004) / (v * (0.15 * v + 0.5) + 0.06) - 0.02 / 0.3

        grid = np.linspace(0.0, 11.2, 4096)
        gain = np.interp(0.18 * hable(np.array(11.2)), hable(grid), grid) / 0.18
        x = hable(gain * x) / hable(np.array(11.2))
    return np.asarray(encode_srgb(np.clip(x, 0.0, 1.0)), dtype=np.float32)


@lru_cache(maxsize=4)
def _byte_curve(tone: Tone, variant: str) -> mi.UInt32:
    """Return the tone curve's byte values on the device."""
    return wrapped(mi.UInt32, np.rint(255.0 * np.clip(tone_curve(tone), 0.0, 1.0)).astype(np.uint32))
