"""Photometric loss of 3DGS, L1 + D-SSIM, on the device, with its gradient.

SSIM is that of Wang et al. 2004 with an 11 x 11 Gaussian window of 1.5 px, zero beyond the borders.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

RADIUS, SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2

_taps = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
_WEIGHTS = tuple(float(w) for w in _taps / _taps.sum())


def photometric_loss(
    seen: list[mi.Float], target: list[mi.Float], width: int, height: int, ssim_share: float
) -> mi.Float:
    """Compute ``(1 - s) L1 + s (1 - SSIM)`` of two pictures (Kerbl et al. 2023, eq. 7).

    The loss has gradients to the first picture.

    Args:
        seen: Flat row-major arrays of red, green and blue.
        target: Target picture, in the same form.
        width: Width of the pictures [px].
        height: Height of the pictures [px].
        ssim_share: s, in [0, 1].
    """
    loss = mi.Float(0)
    for a, b in zip(seen, target, strict=True):
        loss += (1 - ssim_share) / 3 * dr.mean(dr.abs(a - b))
    if ssim_share == 0:
        return loss
    targets = [dr.detach(b) for b in target]
    # The lambda hides the arguments without gradient from Dr.Jit.
    return loss + ssim_share * (1 - dr.custom(_Ssim, seen, lambda: (targets, width, height)))


class _Ssim(dr.CustomOp):
    """Mean SSIM of one picture against a fixed one."""

    def eval(self, seen: list[mi.Float], context: Callable[[], tuple[list[mi.Float], int, int]]) -> mi.Float:
        target, self.width, self.height = context()
        pixel = dr.arange(mi.UInt32, self.width * self.height)
        self.pictures = _pack([*(dr.detach(x) for x in seen), *target, 0, 0], pixel)
        value, self.slopes = dr.empty(mi.Float, dr.width(pixel)), dr.empty(mi.Float, 12 * dr.width(pixel))

        def moments(index: mi.UInt32, inside: mi.Bool) -> list[mi.Float]:
            p = dr.gather(mi.ArrayXf, self.pictures, index, inside, shape=(8, dr.width(index)))
            x, y = [p[0], p[1], p[2]], [p[3], p[4], p[5]]
            pairs = list(zip(x, y, strict=True))
            return [*x, *y, *(a * a for a in x), *(b * b for b in y), *(a * b for a, b in pairs)]

        def finish(index: mi.UInt32, means: list[mi.Float]) -> None:
            values, slopes = zip(*(_ssim_of(*means[c::3]) for c in range(3)), strict=True)
            dr.scatter(value, sum(values) / 3, index, mode=dr.ReduceMode.Permute)
            by_kind = [slope for kind in zip(*slopes, strict=True) for slope in kind]
            dr.scatter(self.slopes, mi.ArrayXf([*by_kind, 0, 0, 0]), index)

        _blur(moments, finish, self.width, self.height)
        return dr.mean(value)

    def backward(self) -> None:
        size = self.width * self.height
        gain = self.grad_out() / (3 * size)
        gradient = [dr.empty(mi.Float, size) for _ in range(3)]

        def slopes(index: mi.UInt32, inside: mi.Bool) -> list[mi.Float]:
            return list(dr.gather(mi.ArrayXf, self.slopes, index, inside, shape=(12, dr.width(index))))[:9]

        def finish(index: mi.UInt32, means: list[mi.Float]) -> None:
            p = dr.gather(mi.ArrayXf, self.pictures, index, shape=(8, dr.width(index)))
            for c, (by_mean, by_square, by_product) in enumerate(zip(means[:3], means[3:6], means[6:], strict=True)):
                slope = gain * (by_mean + 2 * p[c] * by_square + p[3 + c] * by_product)
                dr.scatter(gradient[c], slope, index, mode=dr.ReduceMode.Permute)

        _blur(slopes, finish, self.width, self.height)
        self.set_grad_in("seen", gradient)

    def name(self) -> str:
        return "ssim"


def _ssim_of(mx: mi.Float, my: mi.Float, xx: mi.Float, yy: mi.Float, xy: mi.Float) -> tuple[mi.Float, list[mi.Float]]:
    """Return SSIM and its derivatives by the means of x, x^2 and xy.

    Arguments are a window's means of x, y, x^2, y^2 and xy.
    """
    a1, a2 = 2 * mx * my + _C1, 2 * (xy - mx * my) + _C2
    b1, b2 = mx * mx + my * my + _C1, xx - mx * mx + yy - my * my + _C2
    scale = dr.rcp(b1 * b2)
    value = a1 * a2 * scale
    by_square, by_product = -value / b2, 2 * a1 * scale
    by_mean = 2 * my * a2 * scale - 2 * mx * value / b1 - 2 * mx * by_square - my * by_product
    return value, [by_mean, by_square, by_product]


def _pack(planes: list[mi.Float], pixel: mi.UInt32) -> mi.Float:
    """Interleave planes per pixel, so that one fetch reads all of them."""
    packed = dr.empty(mi.Float, len(planes) * dr.width(pixel))
    dr.scatter(packed, mi.ArrayXf(planes), pixel)
    dr.eval(packed)
    return packed


_Read = Callable[["mi.UInt32", "mi.Bool"], "list[mi.Float]"]
_Write = Callable[["mi.UInt32", "list[mi.Float]"], None]


def _blur(read: _Read, write: _Write, width: int, height: int) -> None:
    """Compute means of several values per pixel in Gaussian windows, zero beyond the borders.

    Args:
        read: Function that returns the values of pixels, from their numbers and an inside mask.
        write: Function that receives pixel numbers and the means there.
        width: Width of the picture [px].
        height: Height of the picture [px].
    """
    pixel = dr.arange(mi.UInt32, width * height)
    y = pixel // width
    x = pixel - y * width
    along_x = _window(read, pixel, x, 1, width)
    count = -(-len(along_x) // 4) * 4
    rows = _pack([*along_x, *[0] * (count - len(along_x))], pixel)

    def load(index: mi.UInt32, inside: mi.Bool) -> list[mi.Float]:
        return list(dr.gather(mi.ArrayXf, rows, index, inside, shape=(count, dr.width(index))))

    write(pixel, _window(load, pixel, y, width, height)[: len(along_x)])
    dr.eval()


def _window(read: _Read, pixel: mi.UInt32, place: mi.UInt32, step: int, length: int) -> list[mi.Float]:
    """Return weighted means around each pixel along one axis.

    ``place`` is the pixel's coordinate on the axis, and ``length`` the size of the axis.
    """
    sums: list[mi.Float] = []
    for offset, weight in zip(range(-RADIUS, RADIUS + 1), _WEIGHTS, strict=True):
        inside = (mi.Int32(place) + offset >= 0) & (mi.Int32(place) + offset < length)
        values = read(mi.UInt32(mi.Int32(pixel) + offset * step), inside)
        sums = [dr.fma(weight, v, s) for v, s in zip(values, sums or [0.0] * len(values), strict=True)]
    return sums
