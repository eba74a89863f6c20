"""Equirectangular panoramas of radiance as scene files show them: directions, solid angles, irradiance, files.

Rows go from the zenith down to the nadir. Columns go clockwise as seen from above, from azimuth 90 degrees (+y) at the
left border over 0 (+x) to -90 (-y) in the middle: what Mitsuba's ``envmap`` is when it is turned z up and ``rotate_z``
is zero. Azimuths count from +x, counter-clockwise, as those of cameras and lights do.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.errors import InputError
from mitsplat.images.untrusted_images import check_images
from mitsplat.runtime.variant import ensure_variant
from mitsplat.storage.files import library_errors, write_file

HDR_SUFFIXES = (".exr", ".hdr", ".pfm")
"""Of files that hold radiance."""


def directions(height: int, width: int, rotate_z: float = 0.0) -> Float32Array:
    """Unit vectors to the centres of a panorama's pixels, shape (H, W, 3), turned about the vertical [degrees]."""
    polar = np.pi * (np.arange(height) + 0.5)[:, None] / height
    azimuth = np.radians(90.0 + rotate_z) - 2 * np.pi * (np.arange(width) + 0.5) / width
    level = np.sin(polar)
    parts = level * np.cos(azimuth), level * np.sin(azimuth), np.broadcast_to(np.cos(polar), (height, width))
    return np.stack(parts, axis=-1).astype(np.float32)


def solid_angles(height: int, width: int) -> Float64Array:
    """Solid angle of a pixel of each row [sr], shape (H, 1): exact, so that they sum to 4 pi."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return 2 * np.pi / width * (edges[:-1] - edges[1:])[:, None]


def level_weights(height: int, width: int) -> Float64Array:
    """Irradiance of a horizontal plane by a unit of radiance in a pixel of each row [sr], shape (H, 1); they sum to pi.

    The cosine's integral over the pixel above the horizon, ``dphi / 2 (sin(t1)^2 - sin(t0)^2)`` of polar angles t.
    """
    edges = np.sin(np.minimum(np.pi * np.arange(height + 1) / height, np.pi / 2)) ** 2
    return np.pi / width * np.diff(edges)[:, None]


def level_irradiance(panorama: Float32Array) -> Float64Array:
    """Irradiance of a horizontal plane that faces up [W/m^2], shape (3,)."""
    return np.asarray((panorama * level_weights(*panorama.shape[:2])[..., None]).sum(axis=(0, 1)))


def resized(radiance: Float32Array, height: int, width: int) -> Float32Array:
    """An image of radiance, (H, W, 3), in fewer pixels, by the mean of areas."""
    return np.asarray(cv2.resize(radiance, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


def unit_vector(azimuth: float, elevation: float) -> Float64Array:
    """The direction of an azimuth and an elevation [degrees]."""
    turn, rise = np.radians([azimuth, elevation])
    return np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])


def angles(direction: npt.ArrayLike) -> tuple[float, float]:
    """Azimuth, 0 to 360, and elevation [degrees] of a direction."""
    x, y, z = np.asarray(direction, dtype=np.float64)
    return float(np.degrees(np.arctan2(y, x)) % 360), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def read_panorama(path: Path) -> Float32Array:
    """The radiance of an HDR panorama, shape (H, W, 3).

    Raises:
        InputError: If the file is none of HDR, cannot be read, holds what is no number, is not twice as wide as high,
            or has no light above the horizon.
    """
    panorama = read_radiance(path)
    height, width = panorama.shape[:2]
    if width != 2 * height:
        raise InputError(f"{path}: a panorama must be twice as wide as high, all around (got {width} x {height} px)")
    if not level_irradiance(panorama).any():
        raise InputError(f"{path}: a panorama must have light above the horizon (got none)")
    return panorama


def read_radiance(path: Path) -> Float32Array:
    """Linear RGB of an HDR image as Mitsuba reads it, shape (H, W, 3); what is negative counts as 0.

    Raises:
        InputError: If the file is none of HDR, cannot be read, or holds what is no number.
    """
    if path.suffix.lower() not in HDR_SUFFIXES:
        raise InputError(
            f"{path}: a panorama must be HDR, {', '.join(HDR_SUFFIXES)}: others clip the lamps (got {path.suffix})"
        )
    (reason,) = check_images([path])
    if reason is not None:
        raise InputError(reason)
    ensure_variant()
    try:
        bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise InputError(f"{path}: must hold RGB or grey values ({str(error).strip().splitlines()[-1]})") from error
    radiance: Float32Array = np.array(bitmap)
    wrong = np.argwhere(~np.isfinite(radiance).all(axis=-1))
    if len(wrong):
        row, column = wrong[0].tolist()
        raise InputError(
            f"{path}: radiance must be finite (got {radiance[row, column].max()} at pixel {column}, {row}, "
            f"and {len(wrong)} such pixels)"
        )
    return np.asarray(np.maximum(radiance, 0.0))


def write_exr(path: Path, radiance: Float32Array) -> None:
    """Write linear RGB, shape (H, W, 3), as 32-bit OpenEXR."""
    ensure_variant()
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance, dtype=np.float32))
    with library_errors(path):
        write_file(path, lambda part: bitmap.write(str(part), mi.Bitmap.FileFormat.OpenEXR))
