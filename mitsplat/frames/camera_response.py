"""Camera response: shadow and highlight, then lens, sensor, colour, tone curve and compression of a camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import ByteImage, Float32Array, Float64Array
from mitsplat.images.colour import (
    LUMINANCE,
    chroma_matrix,
    encode_srgb,
    hue_matrix,
    saturation_matrix,
    white_balance_matrix,
)
from mitsplat.renderer.layers import Layers, device_array, host_array
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.runtime.variant import one_at_a_time
from mitsplat.scene.spec.image_spec import Composite, ImageShadow, Sensor

Tone: TypeAlias = Literal["neutral", "filmic"]

BACKGROUND = 0.18
"""Linear grey of pixels in which a scene has no surface."""

SENSOR = Sensor()

CURVE_STEPS = 1 << 14
"""Entries of the tone curve's table, evenly spaced in the square root of the input."""

GREY = 118.0
"""Mean byte value (of 255) of a metered picture: middle grey of the standard output sensitivity (ISO 12232)."""

_METERED_PIXELS = 1 << 14
_MAX_METERING = 6.0
"""Maximum correction by metering, in both directions [stops]."""

_MAX_MOTION = 256.0
"""Length of a motion path up to which its samples are at most one pixel apart [px]."""

CURVE_WHITE = 16.0
"""Linear input at the end of the table."""


@one_at_a_time
def light_image(layers: Layers, composite: Composite) -> Float32Array:
    """Compute the linear picture (H, W, 3) with the configured shadows over a grey background."""
    return host_array(light_layers(layers, composite), layers.shape)


def light_layers(layers: Layers, composite: Composite, behind: Any = BACKGROUND) -> Any:
    """Compute the linear picture on the device over the background ``behind``, as flat row-major Color3f."""
    alpha = layers.device_array("alpha")
    lit = layers.device_array("rgb" if composite.shadow == "traced" else "captured")
    if composite.shadow == "image":
        red, green, blue = layers.device_array("light")
        luminance = red * LUMINANCE[0] + green * LUMINANCE[1] + blue * LUMINANCE[2]
        found = shadow_from_image(host_array(luminance, layers.shape), composite.image_shadow)
        factor, shine = (device_array(values) for values in found)
        lit = lit * factor
        if composite.highlight:
            lit += shine * alpha
    return lit + behind * (1 - alpha)


def shadow_from_image(shadow_map: Float32Array, parameters: ImageShadow) -> tuple[Float32Array, Float32Array]:
    """Compute the factor and the highlight (H, W) of the published image-space chain from a shadow map (H, W)."""
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


@one_at_a_time
def develop(
    linear: Float32Array,
    draws: Mapping[str, float],
    *,
    tone: Tone = "neutral",
    sensor: Sensor = SENSOR,
    seed: int = 0,
    swept: tuple[Float32Array, Float32Array] | None = None,
    metered: bool = False,
) -> ByteImage:
    """Convert a linear picture (H, W, 3) to display-encoded bytes with a camera model.

    Args:
        linear: Linear sRGB, 1 = display white.
        draws: ``exposure`` [stops], ``vignetting`` [stops in the corners], ``chromatic_aberration`` [px in the
            corners, red outwards and blue inwards], ``motion_blur`` [px] along ``motion_angle`` [degrees], ``iso``,
            ``white_balance`` [K], ``chroma_stretch`` along ``chroma_angle`` [degrees], ``hue`` [degrees],
            ``saturation``, ``sharpening`` [factor of the difference to a blur of 1 px], ``jpeg`` [quality]. A missing
            entry has no effect.
        tone: ``neutral`` shows captured colours unchanged; ``filmic`` rolls highlights off.
        sensor: Sensor parameters that determine the noise at ``iso``.
        seed: Seed of the noise, below 2^64. The noise is a function of seed, row-major index and channel of a pixel.
        swept: Motion of every pixel to the right and down during the exposure [px], each (H, W); None for no motion.
        metered: Automatic exposure, see :func:`metered_exposure`; ``exposure`` is added to it.
    """
    height, width = linear.shape[:2]
    options: dict[str, Any] = {"tone": tone, "sensor": sensor, "seed": seed, "swept": swept, "metered": metered}
    return develop_layers(device_array(linear), (height, width), draws, **options).image()


def develop_layers(
    linear: Any,
    shape: tuple[int, int],
    draws: Mapping[str, float],
    *,
    tone: Tone,
    sensor: Sensor,
    seed: int,
    swept: tuple[Float32Array, Float32Array] | None = None,
    metered: bool = False,
) -> Development:
    """Start to :func:`develop` a picture on the device (Color3f, flat, row-major over ``shape``)."""
    height, width = shape
    pixel = dr.arange(mi.UInt32, height * width)
    if metered:
        draws = {**draws, "exposure": draws.get("exposure", 0.0) + metered_exposure(linear, height * width, tone)}
    linear = _through_lens(linear, pixel, shape, draws)
    if swept is not None:
        linear = _smeared(linear, pixel, shape, swept)
    if draws.get("motion_blur", 0.0):
        kernel = motion_kernel(draws["motion_blur"], draws.get("motion_angle", 0.0))
        linear = blurred(linear, pixel, shape, kernel)
    if "iso" in draws:
        linear = sensed(linear, pixel, draws["iso"], sensor, seed)
    matrix = colour_matrix(
        white_balance=draws.get("white_balance", 6504.0),
        hue=draws.get("hue", 0.0),
        saturation=draws.get("saturation", 1.0),
        chroma=(draws.get("chroma_stretch", 1.0), draws.get("chroma_angle", 0.0)),
    )
    if not np.array_equal(matrix, np.eye(3)):
        linear = mi.Color3f(*[sum(_opaque(m) * c for m, c in zip(row, linear, strict=True)) for row in matrix])
    position = dr.sqrt(dr.clip(linear, 0.0, CURVE_WHITE) / CURVE_WHITE) * (CURVE_STEPS - 1)
    table, data = _byte_curve(tone, str(mi.variant())), dr.empty(mi.UInt8, 3 * height * width)
    for c in range(3):
        entry = dr.minimum(mi.UInt32(dr.round(position[c])), CURVE_STEPS - 1)  # also bounds NaN
        value = dr.gather(mi.UInt32, table, entry)
        dr.scatter(data, mi.UInt8(value), 3 * pixel + c, mode=dr.ReduceMode.Permute)
    dr.eval(data)
    jpeg = round(draws["jpeg"]) if "jpeg" in draws else None
    return Development(data, shape, draws.get("sharpening", 0.0), jpeg)


@dataclass(frozen=True, eq=False)
class Development:
    """Result of a development that may still run on the device.

    Attributes:
        data: Bytes on the device, flat and row-major, in the order red, green, blue.
        shape: Height and width [px].
        sharpening: Factor of the unsharp mask, the difference of the encoded picture to its Gaussian blur of 1 px.
        jpeg: Quality of the simulated JPEG compression, or None.
    """

    data: Any
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


def _opaque(value: float) -> Any:
    """Return a value that may change between frames without recompilation; a literal becomes part of the kernel."""
    return dr.opaque(mi.Float, float(value))


def metered_exposure(linear: Any, count: int, tone: Tone) -> float:
    """Compute the exposure [stops], within 6 stops, at which the encoded luminance has the mean :data:`GREY`.

    The mean is taken after encoding, so that clipped lamps weigh no more than white paper.

    Args:
        linear: Picture on the device (Color3f, flat); evenly spaced pixels are sampled.
        count: Number of its pixels.
        tone: Tone curve of the encoding.
    """
    sampled_pixels = dr.arange(mi.UInt32, 0, count, max(1, count // _METERED_PIXELS))
    dr.eval(linear)
    sampled_colours = dr.gather(mi.Color3f, linear, sampled_pixels).numpy()
    luminance = np.maximum(LUMINANCE @ sampled_colours, 0.0)
    curve = 255.0 * np.clip(tone_curve(tone), 0.0, 1.0)

    def mean(stops: float) -> float:
        step = np.sqrt(np.minimum(luminance * 2.0**stops, CURVE_WHITE) / CURVE_WHITE) * (CURVE_STEPS - 1)
        return float(curve[np.rint(step).astype(int)].mean())

    low, high = -_MAX_METERING, _MAX_METERING
    for _ in range(16):
        middle = (low + high) / 2
        low, high = (middle, high) if mean(middle) < GREY else (low, middle)
    return (low + high) / 2


def _through_lens(linear: Any, pixel: Any, shape: tuple[int, int], draws: Mapping[str, float]) -> Any:
    """Apply chromatic aberration, exposure and vignetting."""
    height, width = shape
    if draws.get("chromatic_aberration", 0.0):
        linear = _drawn_apart(linear, pixel, shape, draws["chromatic_aberration"])
    if draws.get("exposure", 0.0):
        linear = linear * _opaque(2.0 ** draws["exposure"])
    if draws.get("vignetting", 0.0):
        row = pixel // width
        x, y = mi.Float(pixel - row * width) + (0.5 - width / 2), mi.Float(row) + (0.5 - height / 2)
        share = (x * x + y * y) / (0.25 * (height**2 + width**2))
        linear = linear * dr.exp2(_opaque(-draws["vignetting"]) * share)
    return linear


def _drawn_apart(linear: Any, pixel: Any, shape: tuple[int, int], corner: float) -> Any:
    """Magnify red about the image centre so that it moves by ``corner`` [px] in the corners; reduce blue likewise."""
    height, width = shape
    picture = dr.ravel(mi.Vector4f(*linear, 0.0))
    dr.eval(picture)
    row = pixel // width
    x, y = mi.Float(pixel - row * width), mi.Float(row)
    along = _opaque(corner / float(np.hypot(width, height) / 2))
    x_out, y_out = along * (x + (0.5 - width / 2)), along * (y + (0.5 - height / 2))
    red, blue = (_bilinear(picture, shape, x + sign * x_out, y + sign * y_out) for sign in (-1.0, 1.0))
    return mi.Color3f(red.x, linear[1], blue.z)


def _bilinear(picture: Any, shape: tuple[int, int], x: Any, y: Any) -> Any:
    """Interpolate a picture bilinearly at columns and rows [px]; border values extend beyond the border."""
    height, width = shape
    x, y = dr.clip(x, 0.0, width - 1.0), dr.clip(y, 0.0, height - 1.0)
    left, top = dr.minimum(mi.UInt32(x), max(0, width - 2)), dr.minimum(mi.UInt32(y), max(0, height - 2))
    right, down = x - mi.Float(left), y - mi.Float(top)
    one, line = min(1, width - 1), min(1, height - 1) * width
    corner = top * width + left

    def at(offset: int) -> Any:
        return dr.gather(mi.Vector4f, picture, corner + offset)

    upper = at(0) * (1 - right) + at(one) * right
    lower = at(line) * (1 - right) + at(line + one) * right
    return upper * (1 - down) + lower * down


def _smeared(linear: Any, pixel: Any, shape: tuple[int, int], swept: tuple[Float32Array, Float32Array]) -> Any:
    """Average the picture over the exposure along each pixel's motion.

    All of the light that passes through a pixel is assumed to move with the pixel's own velocity.
    """
    width = shape[1]
    picture = dr.ravel(mi.Vector4f(*linear, 0.0))
    right, down = (wrapped(mi.Float, np.ascontiguousarray(way.ravel(), dtype=np.float32)) for way in swept)
    longest = min(float(np.hypot(*swept).max()), _MAX_MOTION)
    count = dr.opaque(mi.UInt32, 1 + 2 * int(np.ceil(longest / 2)))
    row = pixel // width
    x, y = mi.Float(pixel - row * width), mi.Float(row)
    dr.eval(picture, right, down)

    def add(number: Any, total: Any) -> tuple[Any, Any]:
        time = (mi.Float(number) + 0.5) / mi.Float(count) - 0.5
        seen = _bilinear(picture, shape, x + time * right, y + time * down)
        return number + 1, total + mi.Color3f(seen.x, seen.y, seen.z)

    state = mi.UInt32(0), mi.Color3f(0)
    return dr.while_loop(state, lambda number, _: number < count, add, label="motion")[1] / mi.Float(count)


def blurred(linear: Any, pixel: Any, shape: tuple[int, int], kernel: Float32Array) -> Any:
    """Correlate the picture with a kernel (K, K); border values extend beyond the border."""
    height, width = shape
    picture = dr.ravel(mi.Vector4f(*linear, 0.0))  # a CPU gathers four neighbours as fast as one
    rows, columns = np.nonzero(kernel)
    reach = kernel.shape[0] // 2
    lines = np.stack([columns - reach, rows - reach, kernel[rows, columns], np.zeros_like(rows)], axis=-1)
    taps, count = wrapped(mi.Float, lines.astype(np.float32)), dr.opaque(mi.UInt32, len(rows))
    row = pixel // width
    x, y = mi.Int32(pixel - row * width), mi.Int32(row)
    dr.eval(picture, taps)

    def add(number: Any, total: Any) -> tuple[Any, Any]:
        tap = dr.gather(mi.Vector4f, taps, number)
        column, line = dr.clip(x + mi.Int32(tap.x), 0, width - 1), dr.clip(y + mi.Int32(tap.y), 0, height - 1)
        seen = dr.gather(mi.Vector4f, picture, mi.UInt32(line * width + column))
        return number + 1, total + tap.z * mi.Color3f(seen.x, seen.y, seen.z)

    state = mi.UInt32(0), mi.Color3f(0)
    return dr.while_loop(state, lambda number, _: number < count, add, label="motion blur")[1]


def motion_kernel(length: float, angle: float) -> Float32Array:
    """Compute the weights (K, K) of a centred line of ``length`` [px], ``angle`` [degrees] above the x axis."""
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


def sensed(linear: Any, pixel: Any, iso: float, sensor: Sensor, seed: int) -> Any:
    """Add shot and read noise: a variance of N + read_noise^2 for N electrons (EMVA 1288, section 2).

    Display white fills the wells at ISO 100. The Poisson noise of N is approximated as normal. The random numbers are a
    function of the pixel index (Philox 4x32, Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"), so
    that they do not depend on the order of evaluation.
    """
    electrons = sensor.full_well * 100.0 / iso
    numbers = mi.Philox4x32(dr.opaque(mi.UInt64, seed), pixel).next_float32x4_normal()
    shot, read = _opaque(1 / electrons), _opaque((sensor.read_noise / electrons) ** 2)
    return linear + dr.sqrt(dr.maximum(linear, 0.0) * shot + read) * mi.Color3f(numbers.x, numbers.y, numbers.z)


def _jpeg_compressed(image: ByteImage, quality: int) -> ByteImage:
    """Return the picture after JPEG compression."""
    done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OSError(f"OpenCV could not encode an image of shape {image.shape} as jpg")
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)[..., ::-1])


def colour_matrix(
    *,
    white_balance: float = 6504.0,
    hue: float = 0.0,
    saturation: float = 1.0,
    chroma: tuple[float, float] = (1.0, 0.0),
) -> Float64Array:
    """Compute a 3x3 matrix on linear sRGB for white balance, chroma, hue and saturation, in this order.

    White balance is a Bradford adaptation from daylight of the given temperature to sRGB's white. Chroma is a factor
    and an angle of :func:`mitsplat.images.colour.chroma_matrix`. Hue rotates colours about the grey axis. Saturation
    scales their distance from the grey of the same luminance.
    """
    matrix = np.eye(3)
    if white_balance != 6504.0:
        matrix = white_balance_matrix(float(white_balance))
    if chroma[0] != 1.0:
        matrix = chroma_matrix(*chroma) @ matrix
    if hue:
        matrix = hue_matrix(hue) @ matrix
    if saturation != 1.0:
        matrix = saturation_matrix(saturation) @ matrix
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
def _byte_curve(tone: Tone, variant: str) -> Any:
    """Return the tone curve's byte values on the device."""
    return wrapped(mi.UInt32, np.rint(255.0 * np.clip(tone_curve(tone), 0.0, 1.0)).astype(np.uint32))
