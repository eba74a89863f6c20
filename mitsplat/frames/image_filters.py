"""Filters of a linear picture on the device: chromatic aberration and motion blur.

Pictures are flat and row-major over ``shape``, height and width [px]. Values of the border extend beyond it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float32Array
from mitsplat.renderer.rays.device_arrays import wrapped

PixelFlow: TypeAlias = tuple[Float32Array, Float32Array]
"""Motion of every pixel to the right and down [px], each (H, W)."""

_MAX_MOTION = 256.0
"""Length of a motion path up to which its samples are at most one pixel apart [px]."""


def opaque_float(value: float) -> mi.Float:
    """Return a value that may change between frames without recompilation; a literal becomes part of the kernel."""
    return dr.opaque(mi.Float, float(value))


def pixel_index(shape: tuple[int, int]) -> mi.UInt32:
    """Return the row-major index of every pixel."""
    return dr.arange(mi.UInt32, shape[0] * shape[1])


def columns_and_rows(shape: tuple[int, int]) -> tuple[mi.UInt32, mi.UInt32]:
    """Return column and row of every pixel."""
    pixel = pixel_index(shape)
    row = pixel // shape[1]
    return pixel - row * shape[1], row


def _stored(linear: mi.Color3f) -> mi.Float:
    """Store a picture with four floats per pixel: a CPU gathers four neighbours as fast as one."""
    picture = dr.ravel(mi.Vector4f(*linear, 0.0))
    dr.eval(picture)
    return picture


def apply_chromatic_aberration(linear: mi.Color3f, shape: tuple[int, int], corner: float) -> mi.Color3f:
    """Magnify red about the image centre so that it moves by ``corner`` [px] in the corners; reduce blue likewise."""
    height, width = shape
    picture = _stored(linear)
    x, y = (mi.Float(index) for index in columns_and_rows(shape))
    along = opaque_float(corner / float(np.hypot(width, height) / 2))
    x_out, y_out = along * (x + (0.5 - width / 2)), along * (y + (0.5 - height / 2))
    red, blue = (_bilinear(picture, shape, x + sign * x_out, y + sign * y_out) for sign in (-1.0, 1.0))
    return mi.Color3f(red.x, linear[1], blue.z)


def _bilinear(picture: mi.Float, shape: tuple[int, int], x: mi.Float, y: mi.Float) -> mi.Vector4f:
    """Interpolate a stored picture at columns and rows [px]."""
    height, width = shape
    x, y = dr.clip(x, 0.0, width - 1.0), dr.clip(y, 0.0, height - 1.0)
    left, top = dr.minimum(mi.UInt32(x), max(0, width - 2)), dr.minimum(mi.UInt32(y), max(0, height - 2))
    right, down = x - mi.Float(left), y - mi.Float(top)
    next_column, next_row = min(1, width - 1), min(1, height - 1) * width
    corner = top * width + left

    def at(offset: int) -> mi.Vector4f:
        return dr.gather(mi.Vector4f, picture, corner + offset)

    upper = at(0) * (1 - right) + at(next_column) * right
    lower = at(next_row) * (1 - right) + at(next_row + next_column) * right
    return upper * (1 - down) + lower * down


def _sum_samples(count: mi.UInt32, sample: Callable[[mi.UInt32], mi.Color3f], label: str) -> mi.Color3f:
    """Sum the samples 0 to ``count`` - 1 in a loop on the device."""

    def add(number: mi.UInt32, total: mi.Color3f) -> tuple[mi.UInt32, mi.Color3f]:
        return number + 1, total + sample(number)

    state = mi.UInt32(0), mi.Color3f(0)
    return dr.while_loop(state, lambda number, _: number < count, add, label=label)[1]


def blur_along_flow(linear: mi.Color3f, shape: tuple[int, int], exposure_flow: PixelFlow) -> mi.Color3f:
    """Average the picture over the exposure along each pixel's motion.

    All of the light that passes through a pixel is assumed to move with the pixel's own velocity.
    """
    picture = _stored(linear)
    right, down = (wrapped(mi.Float, np.asarray(values, dtype=np.float32)) for values in exposure_flow)
    longest = min(float(np.hypot(*exposure_flow).max()), _MAX_MOTION)
    count = dr.opaque(mi.UInt32, 1 + 2 * int(np.ceil(longest / 2)))
    x, y = (mi.Float(index) for index in columns_and_rows(shape))

    def sample(number: mi.UInt32) -> mi.Color3f:
        time = (mi.Float(number) + 0.5) / mi.Float(count) - 0.5
        colour = _bilinear(picture, shape, x + time * right, y + time * down)
        return mi.Color3f(colour.x, colour.y, colour.z)

    return _sum_samples(count, sample, "motion") / mi.Float(count)


def correlate(linear: mi.Color3f, shape: tuple[int, int], kernel: Float32Array) -> mi.Color3f:
    """Correlate the picture with a kernel (K, K)."""
    height, width = shape
    picture = _stored(linear)
    rows, columns = np.nonzero(kernel)
    reach = kernel.shape[0] // 2
    lines = np.stack([columns - reach, rows - reach, kernel[rows, columns], np.zeros_like(rows)], axis=-1)
    taps, count = wrapped(mi.Float, lines.astype(np.float32)), dr.opaque(mi.UInt32, len(rows))
    x, y = (mi.Int32(index) for index in columns_and_rows(shape))

    def sample(number: mi.UInt32) -> mi.Color3f:
        tap = dr.gather(mi.Vector4f, taps, number)
        column, row = dr.clip(x + mi.Int32(tap.x), 0, width - 1), dr.clip(y + mi.Int32(tap.y), 0, height - 1)
        colour = dr.gather(mi.Vector4f, picture, mi.UInt32(row * width + column))
        return tap.z * mi.Color3f(colour.x, colour.y, colour.z)

    return _sum_samples(count, sample, "motion blur")


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
