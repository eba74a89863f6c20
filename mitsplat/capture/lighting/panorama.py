"""Equirectangular radiance panoramas in the convention of scene files: directions, solid angles, irradiance and files.

Rows go from the zenith to the nadir. Columns go clockwise as seen from above: azimuth 90 degrees (+y) at the left
border, 0 (+x), and -90 (-y) in the middle. This is Mitsuba's ``envmap`` rotated to z up, with ``rotate_z`` zero.
Azimuths are counter-clockwise from +x, like those of cameras and lights.
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
"""Suffixes of files with radiance."""


def directions(height: int, width: int, rotate_z: float = 0.0) -> Float32Array:
    """Return unit vectors to the pixel centres of a panorama, shape (H, W, 3), rotated about the vertical [degrees]."""
    polar = np.pi * (np.arange(height) + 0.5)[:, None] / height
    azimuth = np.radians(90.0 + rotate_z) - 2 * np.pi * (np.arange(width) + 0.5) / width
    level = np.sin(polar)
    parts = level * np.cos(azimuth), level * np.sin(azimuth), np.broadcast_to(np.cos(polar), (height, width))
    return np.stack(parts, axis=-1).astype(np.float32)


def solid_angles(height: int, width: int) -> Float64Array:
    """Return the exact solid angle of a pixel of each row [sr], shape (H, 1); the pixels sum to 4 pi."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return 2 * np.pi / width * (edges[:-1] - edges[1:])[:, None]


def level_weights(height: int, width: int) -> Float64Array:
    """Return the irradiance of a horizontal plane per radiance of a pixel of each row [sr], shape (H, 1).

    It is the integral of the cosine over the part of the pixel above the horizon, ``dphi / 2 (sin(t1)^2 - sin(t0)^2)``
    with polar angles t. The pixels sum to pi.
    """
    edges = np.sin(np.minimum(np.pi * np.arange(height + 1) / height, np.pi / 2)) ** 2
    return np.pi / width * np.diff(edges)[:, None]


def level_irradiance(panorama: Float32Array) -> Float64Array:
    """Compute the irradiance of a horizontal plane that faces up [W/m^2], shape (3,)."""
    return np.asarray((panorama * level_weights(*panorama.shape[:2])[..., None]).sum(axis=(0, 1)))


def resized(radiance: Float32Array, height: int, width: int) -> Float32Array:
    """Reduce a radiance image, (H, W, 3), by area averages."""
    return np.asarray(cv2.resize(radiance, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


def rotated(panorama: Float32Array, rotation: Float64Array) -> Float32Array:
    """Return a panorama whose directions are turned by a rotation (3, 3), with bilinear interpolation."""
    height, width = panorama.shape[:2]
    x, y, z = np.moveaxis(directions(height, width) @ rotation, -1, 0)  # directions before the rotation
    column = (np.pi / 2 - np.arctan2(y, x)) % (2 * np.pi) * (width / (2 * np.pi)) - 0.5
    row = np.arctan2(np.hypot(x, y), z) * (height / np.pi) - 0.5
    wide = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    places = (column + 1).astype(np.float32), row.astype(np.float32)
    return np.asarray(cv2.remap(wide, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32)


def unit_vector(azimuth: float, elevation: float) -> Float64Array:
    """Return the direction (3,) of an azimuth and an elevation [degrees]."""
    turn, rise = np.radians([azimuth, elevation])
    return np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])


def angles(direction: npt.ArrayLike) -> tuple[float, float]:
    """Return azimuth, 0 to 360, and elevation [degrees] of a direction (3,)."""
    x, y, z = np.asarray(direction, dtype=np.float64)
    return float(np.degrees(np.arctan2(y, x)) % 360), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def read_panorama(path: Path) -> Float32Array:
    """Read the radiance of an HDR panorama, shape (H, W, 3).

    Raises:
        InputError: If the file has no HDR format, cannot be read, has non-finite values, is not twice as wide as high,
            or has no light above the horizon.
    """
    panorama = read_radiance(path)
    height, width = panorama.shape[:2]
    if width != 2 * height:
        raise InputError(f"{path}: a panorama must be twice as wide as high (got {width} x {height} px)")
    if not level_irradiance(panorama).any():
        raise InputError(f"{path}: a panorama must have light above the horizon (got none)")
    return panorama


def read_radiance(path: Path) -> Float32Array:
    """Read linear RGB of an HDR image through Mitsuba, shape (H, W, 3); negative values become 0.

    Raises:
        InputError: If the file has no HDR format, cannot be read, or has non-finite values.
    """
    if path.suffix.lower() not in HDR_SUFFIXES:
        raise InputError(
            f"{path}: a panorama must be HDR, {', '.join(HDR_SUFFIXES)}, because other formats clip the lamps "
            f"(got {path.suffix})"
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


def write_radiance(path: Path, radiance: Float32Array) -> None:
    """Write linear RGB, shape (H, W, 3), as 32-bit OpenEXR."""
    ensure_variant()
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance, dtype=np.float32))
    with library_errors(path):
        write_file(path, lambda part: bitmap.write(str(part), mi.Bitmap.FileFormat.OpenEXR))
