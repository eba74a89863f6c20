"""Merging of photographs of one view at several exposures to radiance (Debevec and Malik 1997).

OpenCV's implementation is not suited to lamps. It recovers a response for each channel from a grid of pixels, which
with two or three exposures makes lamps 10 to 50 % too dark, differently per channel. It also includes white pixels, so
that a lamp that all exposures clip becomes three times darker than its lower bound. Here one response serves all
channels. It is recovered from pixels spread over the levels, and white pixels count only in the shortest exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import ExifTags, Image, ImageOps
from scipy.sparse import coo_array, diags_array, vstack
from scipy.sparse.linalg import spsolve

from mitsplat.arrays import BoolArray, ByteImage, Float32Array, Float64Array
from mitsplat.errors import InputError
from mitsplat.images.colour import decode_srgb, eight_bit, in_srgb
from mitsplat.storage.files import IMAGE_ERRORS

CLIPPED = 250
"""Level from which a pixel may be clipped."""
_DARK = 4
"""Level up to which a pixel is noise."""
_SAMPLES = 150
"""Number of pixels for the response recovery; Debevec and Malik require more than 255 / (photographs - 1)."""
_SMOOTHNESS = 50.0
"""Weight of the response's smoothness; at 10, noise causes errors of 10 %, and at 200, the smoothness itself does."""
_HAT = np.minimum(np.arange(256) + 1.0, 256.0 - np.arange(256))
"""Weight of each level."""
_DIAGONAL = float(np.hypot(36.0, 24.0))
"""Diagonal of a 35 mm film frame [mm]."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """Upright photograph as stored by its camera.

    Attributes:
        path: Image file.
        pixels: Display-encoded RGB, (H, W, 3).
        exposure: Exposure time [s], multiplied by ISO / 100 and divided by the squared f-number if EXIF has them; None
            if EXIF has no exposure time.
        focal: Focal length [px] from the 35 mm equivalent, which refers to the diagonal; None if EXIF has none.
    """

    path: Path
    pixels: ByteImage
    exposure: float | None
    focal: float | None


def read_photograph(path: Path) -> Photograph:
    """Read a photograph with 8 bits per channel.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        with Image.open(path) as image:
            image.load()
            exif = image.getexif()
            known = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
            pixels = np.asarray(eight_bit(in_srgb(ImageOps.exif_transpose(image))))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IMAGE_ERRORS as error:
        raise InputError(f"{path}: not a readable photograph ({error})") from error
    time, stop = _number(known, ExifTags.Base.ExposureTime), _number(known, ExifTags.Base.FNumber)
    speed, focal = _number(known, ExifTags.Base.ISOSpeedRatings), _number(known, ExifTags.Base.FocalLengthIn35mmFilm)
    return Photograph(
        path=path,
        pixels=pixels,
        exposure=None if time is None else time * (speed or 100.0) / 100.0 / (stop or 1.0) ** 2,
        focal=None if focal is None else focal / _DIAGONAL * float(np.hypot(*pixels.shape[:2])),
    )


def _number(known: dict[int, object], tag: int) -> float | None:
    """Return a positive number of the EXIF data, or None."""
    value = known.get(tag)
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if 0 < number < np.inf else None


def exposures_of(photographs: Sequence[Photograph], stated: Sequence[float] | None) -> Float64Array:
    """Return the exposures of photographs of equal size: ``stated`` if given, else those of EXIF.

    Raises:
        InputError: If exposures are missing or do not differ, or if the photographs differ in size.
    """
    first = photographs[0]
    for photograph in photographs:
        if photograph.pixels.shape != first.pixels.shape:
            size, other = photograph.pixels.shape[1::-1], first.pixels.shape[1::-1]
            raise InputError(
                f"{photograph.path}: photographs must have equal sizes, {other[0]} x {other[1]} px as {first.path} "
                f"(got {size[0]} x {size[1]})"
            )
    if stated is not None and len(stated) != len(photographs):
        raise InputError(f"--exposures must have one value per photograph, {len(photographs)} (got {len(stated)})")
    if len(photographs) == 1:
        return np.ones(1)
    found = [photograph.exposure for photograph in photographs] if stated is None else stated
    for photograph, exposure in zip(photographs, found, strict=True):
        if exposure is None:
            raise InputError(f"{photograph.path}: EXIF has no exposure time: give --exposures")
    exposures = np.array(found, dtype=np.float64)
    if not (np.isfinite(exposures).all() and (exposures > 0).all()):
        raise InputError(f"exposures must be finite and > 0 (got {', '.join(f'{e:g}' for e in exposures)})")
    if exposures.max() < 1.2 * exposures.min():
        raise InputError(
            f"{first.path}: the exposures of the photographs must differ (got {', '.join(f'{e:g}' for e in exposures)})"
        )
    return exposures


def merge_exposures(pixels: Sequence[ByteImage], exposures: npt.ArrayLike) -> tuple[Float32Array, BoolArray]:
    """Merge photographs to radiance, (H, W, 3), and mark pixels where it is a lower bound, (H, W).

    Radiance is ``sum(w t f(z) / t) / sum(w t)`` with levels z, the response f, exposures t and a hat-shaped weight w of
    the level, as in Robertson, Borman and Stevenson (2003). Pixels from ``CLIPPED`` on count only in the shortest
    exposure. With three or more exposures, the response is recovered; otherwise it is that of sRGB.

    Args:
        pixels: Photographs of equal size, (H, W, 3).
        exposures: Exposures of the photographs, (N,).

    Returns:
        Radiance, and True where even the shortest exposure is white.
    """
    exposures = np.asarray(exposures, dtype=np.float64)
    response = decode_srgb(np.arange(256) / 255) if len(pixels) < 3 else _response(pixels, exposures)
    shortest = int(exposures.argmin())
    total = np.zeros(pixels[0].shape)
    weights = np.zeros(pixels[0].shape)
    for index, (levels, exposure) in enumerate(zip(pixels, exposures, strict=True)):
        weight = np.where(np.arange(256) < CLIPPED, _HAT, 1e-6 if index == shortest else 0.0)[levels]
        total += weight * response[levels]
        weights += weight * exposure
    return (total / weights).astype(np.float32), np.asarray((pixels[shortest] >= CLIPPED).any(axis=-1))


def _response(pixels: Sequence[ByteImage], exposures: Float64Array) -> Float64Array:
    """Recover the response, (256,), from pixels that two or more photographs expose well, evenly over the levels."""
    levels = np.stack([np.asarray(cv2.medianBlur(p, 3), np.uint8).reshape(-1) for p in pixels])
    usable = np.flatnonzero(((levels > _DARK) & (levels < CLIPPED)).sum(axis=0) >= 2)
    if len(usable) < _SAMPLES:
        return decode_srgb(np.arange(256) / 255)
    order = usable[np.argsort(levels[:, usable].sum(axis=0, dtype=np.int64), kind="stable")]
    return recover_response(levels[:, order[np.linspace(0, len(order) - 1, _SAMPLES).astype(np.intp)]], exposures)


def recover_response(levels: npt.NDArray[np.uint8], exposures: npt.ArrayLike) -> Float64Array:
    """Recover the exposure of each level, (256,), 1 for level 128 (Debevec and Malik 1997, equation 3).

    It minimises the squares of ``w(z_ij) (g(z_ij) - ln E_i - ln t_j)`` and ``l w(z) g''(z)`` with a hat-shaped weight
    w, over the logarithm g of the response and the irradiances E of pixels.

    Args:
        levels: Levels of pixels i in photographs j, (J, I).
        exposures: Exposures t_j, (J,).
    """
    photographs, samples = levels.shape
    z, pixel = levels.reshape(-1).astype(np.intp), np.tile(np.arange(samples), photographs)
    weight, row = _HAT[z], np.arange(z.size)
    data = coo_array(
        (np.concatenate([weight, -weight]), (np.tile(row, 2), np.concatenate([z, 256 + pixel]))),
        shape=(z.size, 256 + samples),
    )
    bend = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(254, 256 + samples))
    anchor = coo_array(([1.0], ([0], [128])), shape=(1, 256 + samples))
    system = vstack([data, diags_array(_SMOOTHNESS * _HAT[1:-1]) @ bend, anchor]).tocsc()
    wanted = np.zeros(system.shape[0])
    wanted[: z.size] = weight * np.repeat(np.log(np.asarray(exposures, dtype=np.float64)), samples)
    return np.asarray(np.exp(spsolve(system.T @ system, system.T @ wanted)[:256]))
