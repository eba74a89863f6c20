"""Lens distortion of OpenCV's camera models: coefficients, distortion, its inverse, and where it folds.

Positions are slopes ``(x / z, y / z)`` of rays, and distorted positions in focal lengths from the principal point.
Functions of single coefficients work with host and device arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from mitsplat.arrays import Float64Array

Lens = Literal["opencv", "fisheye"]
"""OpenCV camera models: rational with tangential and thin-prism distortion, or fisheye."""

Real = Any
"""Number, or array of NumPy or Dr.Jit; formulas of lenses are written once for all of them."""

FISHEYE_MAX = float(np.radians(85.0))
"""Maximum angle between a fisheye ray and the optical axis [rad]. Rays are stored as slopes, which diverge at 90
degrees.
"""

COUNTS: dict[Lens, tuple[int, ...]] = {"opencv": (0, 4, 5, 8, 12), "fisheye": (4,)}
"""Possible numbers of distortion coefficients."""

NEWTON_STEPS = 8
"""Number of steps of Newton's method that invert the distortion of a pixel on the device."""
_GRID = 33
"""Number of tested points along each side of an image."""
_LARGE, _LARGE_TANGENTIAL = 5.0, 0.015
"""Magnitudes of k1 and of p1 and p2 above which coefficients are probably wrong."""


def distortion_coefficients(values: npt.ArrayLike, lens: Lens) -> tuple[float, ...]:
    """Return distortion coefficients in OpenCV's order, see :func:`flat_coefficients`.

    Raises:
        ValueError: If there is another number of coefficients, one is not finite, or the sensor is tilted. The message
            is a rule that begins with "must".
    """
    flat = flat_coefficients(values)
    try:
        found = tuple(map(float, flat))
    except (TypeError, ValueError):
        raise ValueError(f"must be a list of numbers (got {values!r})") from None
    if not np.isfinite(found).all():
        raise ValueError(f"must have finite coefficients (got {list(found)})")
    if len(found) == 14:
        raise ValueError(
            f"must have no tilt of the sensor, tau_x and tau_y (got {list(found[12:])}): calibrate without "
            "cv2.CALIB_TILTED_MODEL"
        )
    if len(found) not in COUNTS[lens]:
        if lens == "fisheye":
            raise ValueError(f"must have 4 coefficients, k1, k2, k3, k4 of cv2.fisheye (got {len(found)})")
        raise ValueError(f"must have 0, 4, 5, 8, 12 or 14 coefficients (got {len(found)})")
    return found


def flat_coefficients(values: Any) -> tuple[Any, ...]:
    """Return the coefficients of a list or an array of OpenCV, such as (1, 5) or (14, 1).

    Coefficients after the eighth (thin prism and tilt) that are zero are left out, because OpenCV adds them. The types
    of the values are not checked.

    Raises:
        ValueError: If they are masked or not in one row or column. The message is a rule that begins with "must".
    """
    if np.ma.is_masked(values):
        raise ValueError("must have no masked coefficients")
    array = np.array(values, dtype=object)
    if max(array.shape, default=1) != array.size:
        raise ValueError(f"must be a list of coefficients (got an array of shape {array.shape})")
    flat = tuple(array.ravel().tolist())
    if len(flat) in (12, 14) and not any(flat[8:]):
        return flat[:8]
    return flat[:12] if len(flat) == 14 and not any(flat[12:]) else flat


def is_pinhole(distortion: Sequence[float], lens: Lens) -> bool:
    """Return True if a lens does not distort."""
    return lens == "opencv" and not any(distortion)


def opencv_distort(u: Real, v: Real, k: Sequence[Real]) -> tuple[Real, Real, tuple[Real, Real, Real, Real]]:
    """Apply OpenCV's distortion to slopes; return them with the Jacobian (du'/du, du'/dv, dv'/du, dv'/dv).

    Source: OpenCV documentation, "Camera Calibration and 3D Reconstruction", rational and thin-prism model.

    Args:
        u: Slopes along x.
        v: Slopes along y.
        k: Coefficients k1, k2, p1, p2, k3, k4, k5, k6[, s1, s2, s3, s4].
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = k[:8]
    r2 = u * u + v * v
    top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    slope = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / bottom
    pu = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    pv = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    cross = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
    a, d = radial + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u, radial + 2 * v * v * slope + 6 * p1 * v + 2 * p2 * u
    if len(k) == 8:
        return pu, pv, (a, cross, cross, d)
    s1, s2, s3, s4 = k[8:]
    prism_u, prism_v = 2 * s1 + 4 * s2 * r2, 2 * s3 + 4 * s4 * r2
    jacobian = a + prism_u * u, cross + prism_u * v, cross + prism_v * u, d + prism_v * v
    return pu + r2 * (s1 + s2 * r2), pv + r2 * (s3 + s4 * r2), jacobian


def fisheye_radius(angle: Real, k: Sequence[Real]) -> Real:
    """Return the distance from the principal point [focal lengths] of rays at an angle to the axis [rad]."""
    square = angle * angle
    return angle * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))


def fisheye_rate(angle: Real, k: Sequence[Real]) -> Real:
    """Return the derivative of :func:`fisheye_radius`."""
    square = angle * angle
    return 1 + square * (3 * k[0] + square * (5 * k[1] + square * (7 * k[2] + square * 9 * k[3])))


def padded(distortion: Sequence[float]) -> tuple[float, ...]:
    """Return 8 or 12 coefficients of OpenCV's lens; absent ones are zero."""
    return (*distortion, *(0.0,) * ((8 if len(distortion) <= 8 else 12) - len(distortion)))


@lru_cache(maxsize=64)
def turning_slope(distortion: tuple[float, ...]) -> float:
    """Return the ray slope at which OpenCV's radial distortion stops growing; infinity if it always grows.

    The distorted radius is ``r N(s) / D(s)`` with ``s = r^2``, ``N = 1 + k1 s + k2 s^2 + k3 s^3`` and ``D = 1 + k4 s +
    k5 s^2 + k6 s^3``. Its derivative has the sign of ``N D + 2 s (N' D - N D')``. Poles (``D = 0``) end the valid range
    too. Tangential and thin-prism distortion are small and are left out.
    """
    k1, k2, _, _, k3, k4, k5, k6 = padded(distortion)[:8]
    top, bottom, s = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6]), Polynomial([0, 1])
    rate = top * bottom + 2 * s * (top.deriv() * bottom - top * bottom.deriv())
    return float(np.sqrt(min(_first_root(rate), _first_root(bottom))))


@lru_cache(maxsize=64)
def turning_angle(distortion: tuple[float, ...]) -> float:
    """Return the angle to the axis at which a fisheye's distortion stops growing [rad]; infinity if it always grows.

    The root of :func:`fisheye_rate`, a polynomial of the squared angle.
    """
    k1, k2, k3, k4 = distortion
    return float(np.sqrt(_first_root(Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))))


def _first_root(polynomial: Polynomial) -> float:
    """Return the smallest positive root; infinity if there is none."""
    roots = polynomial.trim().roots()
    real = roots[np.isreal(roots)].real
    return float(min(real[real > 0], default=np.inf))


def largest_slope(distortion: tuple[float, ...], lens: Lens) -> float:
    """Return the slope up to which a lens has rays."""
    if lens == "fisheye":
        return float(np.tan(min(turning_angle(distortion), FISHEYE_MAX)))
    return turning_slope(distortion)


def radial_distance(slope: Real, distortion: tuple[float, ...], lens: Lens) -> Real:
    """Return the distance from the principal point of a ray, without tangential and thin-prism distortion."""
    if lens == "fisheye":
        return fisheye_radius(np.arctan(slope), distortion)
    k1, k2, _, _, k3, k4, k5, k6 = padded(distortion)[:8]
    s = slope * slope
    with np.errstate(divide="ignore", over="ignore"):
        return slope * np.divide(1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6)))


def undistort(positions: Float64Array, distortion: tuple[float, ...], lens: Lens) -> Float64Array:
    """Return the slopes of the rays at distorted positions; both have shape (N, 2). NaN where the lens has no ray."""
    radius = np.linalg.norm(positions, axis=1)
    end = largest_slope(distortion, lens)
    if not np.isfinite(end):
        end = max(1.0, float(radius.max(initial=0)))
        while radial_distance(end, distortion, lens) < 1.1 * radius.max(initial=0):
            end *= 2
    # The radial part alone gives the start of Newton's method.
    grid = np.tan(np.linspace(0, np.arctan(end), 1025))[:-1]
    start = np.interp(radius, radial_distance(grid, distortion, lens), grid)
    if lens == "fisheye":
        angle = np.minimum(_newton_angle(radius, np.arctan(start), distortion, 20), np.arctan(end))
        angle[~(np.abs(fisheye_radius(angle, distortion) - radius) < 1e-9)] = np.nan
        return np.asarray(positions * (np.tan(angle) / np.maximum(radius, 1e-12))[:, None], dtype=np.float64)
    slopes = positions * (start / np.maximum(radius, 1e-12))[:, None]
    slopes, away, determinant = _newton(positions, slopes, padded(distortion), 30)
    with np.errstate(invalid="ignore"):
        found = (away < 1e-9 * (1 + radius)) & (determinant > 0)
        found &= np.linalg.norm(slopes, axis=1) < turning_slope(distortion)
    return np.where(found[:, None], slopes, np.nan)


def _newton(
    positions: Float64Array, start: Float64Array, k: tuple[float, ...], steps: int
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Invert OpenCV's distortion; return slopes (N, 2), their errors (N,) and the determinants of Jacobians (N,)."""
    (x, y), (u, v) = positions.T, start.T
    with np.errstate(all="ignore"):
        for step in range(steps + 1):
            pu, pv, (a, b, c, d) = opencv_distort(u, v, k)
            ru, rv, determinant = x - pu, y - pv, a * d - b * c
            if step < steps:
                u, v = u + (d * ru - b * rv) / determinant, v + (a * rv - c * ru) / determinant
        return np.stack([u, v], axis=1), np.hypot(ru, rv), determinant


def _newton_angle(radius: Float64Array, start: Float64Array, k: tuple[float, ...], steps: int) -> Float64Array:
    """Return the angles to the axis [rad] of a fisheye's rays at distances from the principal point, both (N,)."""
    angle = start
    with np.errstate(all="ignore"):
        for _ in range(steps):
            angle = angle - (fisheye_radius(angle, k) - radius) / fisheye_rate(angle, k)
    return angle


def _on_device(positions: Float64Array, distortion: tuple[float, ...], lens: Lens) -> Float64Array:
    """Return the slopes (N, 2) that the device computes, which starts at the distorted positions."""
    if lens == "opencv":
        return _newton(positions, positions, padded(distortion), NEWTON_STEPS)[0]
    radius = np.linalg.norm(positions, axis=1)
    angle = np.clip(_newton_angle(radius, radius, distortion, NEWTON_STEPS), 0, FISHEYE_MAX)
    return np.asarray(positions * (np.tan(angle) / np.maximum(radius, 1e-12))[:, None], dtype=np.float64)


@lru_cache(maxsize=64)
def lens_fault(
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
    distortion: tuple[float, ...],
    lens: Lens,
) -> str:
    """Return a sentence if an image needs rays that its lens model does not have; empty if it does not.

    Args:
        size: Image width and height [px].
        focal: Focal lengths [px].
        centre: Principal point [px].
        distortion: Coefficients of the lens.
        lens: Lens model.
    """
    if not distortion:
        return ""
    x, y = np.meshgrid(np.linspace(0, size[0], _GRID), np.linspace(0, size[1], _GRID))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    positions = (pixels - centre) / focal
    radius = np.linalg.norm(positions, axis=1)
    worst = int(np.argmax(radius))
    slope = largest_slope(distortion, lens)
    limit = np.inf if np.isinf(slope) else radial_distance(slope, distortion, lens)
    where = f"the border at ({pixels[worst, 0]:g}, {pixels[worst, 1]:g}) is at {radius[worst]:.3g}"
    if lens == "fisheye" and turning_angle(distortion) >= FISHEYE_MAX:
        if radius[worst] <= limit:
            return ""
        return (
            f"a fisheye lens must show at most 85 degrees to each side, which is {limit:.3g} focal lengths from the "
            f"principal point, but {where}: is the focal length in pixels, and of this image size?"
        )
    if radius[worst] >= limit:
        return (
            "the image needs rays that the lens model does not have: its distortion stops growing at "
            f"{np.degrees(np.arctan(slope)):.3g} degrees from the axis, which is {limit:.3g} focal lengths from the "
            f"principal point, but {where}: {likely_cause(distortion, lens)}"
        )
    # Tangential and thin-prism distortion have no closed form.
    slopes = undistort(positions, distortion, lens)
    error = np.abs(slopes - _on_device(positions, distortion, lens)).max(axis=1)
    if (bad := ~(error < 1e-4 * (1 + (slopes**2).sum(axis=1)))).any():
        x, y = pixels[int(np.argmax(bad))]
        return (
            f"the image needs rays that the lens model does not have: no ray is distorted to the pixel ({x:g}, {y:g}): "
            f"{likely_cause(distortion, lens)}"
        )
    return ""


def likely_cause(distortion: tuple[float, ...], lens: Lens) -> str:
    """Return the likely cause of a distortion that folds inside an image."""
    k1, _, *tangential = distortion[:4]
    if lens == "opencv":
        if len(distortion) <= 5 and abs(k1) > _LARGE:
            return f"k1 = {k1:g} has no unit: is it in pixels or millimetres, or are the coefficients in another order?"
        if max(map(abs, tangential)) > _LARGE_TANGENTIAL:
            return f"p1, p2 = {tangential[0]:g}, {tangential[1]:g} are large: is the order k1, k2, p1, p2, k3?"
    return (
        "is the calibration of another image size or lens, of images without points near the corners, or of the other "
        "lens model (opencv, fisheye)?"
    )
