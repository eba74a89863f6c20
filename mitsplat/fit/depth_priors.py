"""Depth maps of photos from a network or a sensor, aligned to the scale of a capture by its points.

Networks such as Depth Anything v2 (Yang et al. 2024) return inverse depth up to a scale and a shift, which differ
between photos (Ranftl et al. 2022). As in "A Hierarchical 3D Gaussian Representation" (Kerbl et al. 2024), both are
determined for each photo from its structure-from-motion points.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import OpenEXR
from PIL import Image
from scipy.ndimage import map_coordinates

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.capture.capture import Photo, Window
from mitsplat.capture.photos import shapes_differ
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.images.exr_header import check_exr_header
from mitsplat.storage.files import IMAGE_ERRORS

DepthMap = Float32Array
"""Inverse depths along z [1/m] of a photo, shape (H, W) with the aspect ratio of the photo, NaN where unknown."""
DepthKind = Literal["inverse", "metric"]

SUFFIXES = (".png", ".npy", ".exr", ".tiff", ".tif")
POINTS_MIN = 10
"""Least number of capture points inside a photo for the use of its map."""
_TRIALS = 500
_MAX_RESIDUAL = 0.5
"""Largest residual of an aligned map, relative to the spread of the points.

The residual is the median absolute difference between the map and the points. The spread is the median absolute
deviation of the points. A map with a larger ratio has no information on the points.
"""


@dataclass(frozen=True)
class DepthMaps:
    """Files of depth maps, one per photo, before alignment to the points of the capture.

    Attributes:
        files: Paths of the maps by photo name.
        kind: ``inverse``: inverse depth up to a scale and a shift, as networks return it; ``metric``: depth along the
            camera's z axis in any unit, 0 where unknown, as sensors and renderers return it.
    """

    files: Mapping[str, Path]
    kind: DepthKind = "inverse"


def find_maps(folder: Path, photos: Sequence[Photo], kind: DepthKind = "inverse") -> DepthMaps:
    """Find the maps in a folder whose names match photos, or the photos' files in a capture, except for the suffix.

    The suffix is .png, .npy, .exr, .tiff or .tif. Other files are ignored.

    Raises:
        InputError: If the folder does not exist or has no map of any photo.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of depth maps")
    files = {}
    for photo in photos:
        names = (photo.name, photo.file.name)
        candidates = ((folder / name).with_suffix(suffix) for name in names for suffix in SUFFIXES)
        path = next((path for path in candidates if path.is_file()), None)
        if path is not None:
            files[photo.name] = path
    if not files:
        example = Path(photos[0].name).with_suffix(".png") if photos else "PHOTO.png"
        raise InputError(f"{folder}: must contain a depth map of at least one photo, such as {example} (got none)")
    return DepthMaps(files, kind)


def read_map(path: Path) -> Float32Array:
    """Read the values of a depth map, shape (H, W), without interpretation.

    Raises:
        InputError: If the file cannot be read, has several channels, or a value is not finite.
    """
    try:
        if path.suffix.lower() == ".npy":
            values = np.load(path, allow_pickle=False)
        elif path.suffix.lower() == ".exr":
            values = _read_exr(path)
        else:
            with Image.open(path) as image:
                values = np.asarray(image)
        with np.errstate(over="ignore"):
            values = np.asarray(values, dtype=np.float32)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (*IMAGE_ERRORS, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a readable depth map ({error})") from error
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"{path}: a depth map must have one channel, shape (H, W) (got shape {values.shape})")
    if not np.isfinite(values).all():
        raise InputError(f"{path}: depths must be finite (got {np.count_nonzero(~np.isfinite(values))} others)")
    return values


def _read_exr(path: Path) -> Float32Array:
    """Read the only channel of an OpenEXR file, or the channel Z."""
    if not path.is_file():
        raise FileNotFoundError(path)
    check_exr_header(path)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    if len(channels) > 1 and "Z" not in channels:
        raise ValueError(f"it must have one channel, or one named Z, got {', '.join(sorted(channels))}")
    return np.array(channels.get("Z", next(iter(channels.values()))), dtype=np.float32)


def align_maps(
    photos: Sequence[Photo], points: Float64Array, maps: DepthMaps, size: int
) -> tuple[dict[str, DepthMap], tuple[str, ...]]:
    """Return the maps as inverse depths in the unit of the points, and warnings on the photos without a map.

    Args:
        photos: Photos whose maps are aligned.
        points: Points of the capture, shape (N, 3).
        maps: Files of the maps.
        size: Longest edge to which a map is reduced [px].

    Raises:
        InputError: If a map cannot be read or does not belong to its photo, or no map can be used.
    """
    found: dict[str, DepthMap] = {}
    unused: dict[str, list[str]] = {}
    for photo in photos:
        path = maps.files.get(photo.name)
        if path is None:
            unused.setdefault("photos without a depth map", []).append(photo.name)
            continue
        values = read_map(path)
        try:
            inverse = align_map(photo, points, values, maps.kind)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        if isinstance(inverse, str):
            unused.setdefault(f"depth maps that are not used, because {inverse}", []).append(photo.name)
        else:
            height, width = inverse.shape
            scale = min(1.0, size / max(width, height))
            found[photo.name] = resize_map(inverse, max(1, round(scale * width)), max(1, round(scale * height)))
    warnings = tuple(f"{what}: {', '.join(names)}" for what, names in unused.items())
    if not found:
        raise InputError(f"no depth map can be used: {'; '.join(warnings)}")
    return found, warnings


def align_map(photo: Photo, points: Float64Array, values: Float32Array, kind: DepthKind) -> DepthMap | str:
    """Return a photo's map as inverse depths in the capture's unit, or a text with the reason why it cannot be used.

    Args:
        photo: Photo of the map.
        points: Points of the capture, shape (N, 3).
        values: Values of the map, shape (H, W), of any size.
        kind: Meaning of the values.

    Raises:
        InputError: If the map does not have the aspect ratio of the photo, or a depth is negative. The message has only
            the rule; the caller adds the file.
    """
    size, shape = photo.camera.size, values.shape[::-1]
    if shapes_differ(shape, size):
        raise InputError(f"must have the shape of its photo, {size[0]}x{size[1]} px (got {shape[0]}x{shape[1]})")
    if kind == "metric":
        if values.min() < 0:
            raise InputError(f"depths must be >= 0 (got {values.min():g})")
        with np.errstate(divide="ignore", over="ignore"):
            values = np.where(values > 0, 1 / values, np.float32(np.nan))
    pixels, depth = photo.camera.project(points[photo.seen])
    inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(axis=1)
    column, row = (pixels[inside] * np.divide(shape, size) - 0.5).T
    # Linear interpolation is exact on planes, where inverse depth is linear in the image. The result is unknown next to
    # unknown pixels.
    found = map_coordinates(values.astype(np.float64), (row, column), order=1, mode="nearest")
    known = np.isfinite(found)
    if known.sum() < POINTS_MIN:
        return f"fewer than {POINTS_MIN} of the capture's points are in them"
    found, wanted = found[known], 1 / depth[inside][known]
    scale, shift = fit_line(found, wanted, shift=kind == "inverse")
    left = np.median(np.abs(scale * found + shift - wanted))
    if not scale > 0 or left > _MAX_RESIDUAL * np.median(np.abs(wanted - np.median(wanted))):
        return f"their values as {kind} depths do not agree with the points in them"
    return np.asarray(np.maximum(scale * values + shift, 0), dtype=np.float32)


def fit_line(values: Float64Array, wanted: Float64Array, *, shift: bool) -> tuple[float, float]:
    """Fit scale and shift of values to wanted values, robust against outliers.

    Least median of squares tolerates outliers up to half of the values. Least squares over the values within 2.5
    standard deviations of that line refines the result (Rousseeuw 1984).

    Args:
        values: Shape (N,), N at least 3.
        wanted: Shape (N,).
        shift: True to fit a shift; otherwise it is 0.

    Returns:
        Scale and shift.
    """
    middle = float(np.median(values)) if shift else 0.0  # so that equal values give scale 0
    design = np.column_stack([values - middle, np.ones_like(values)][: 1 + shift])
    rng = np.random.default_rng(0)
    picks = rng.integers(len(values), size=(_TRIALS, design.shape[1]))
    trials = (np.linalg.pinv(design[picks]) @ wanted[picks][..., None])[..., 0]
    misses = np.abs(design @ trials.T - wanted[:, None])
    medians = np.median(misses, axis=0)
    best = int(medians.argmin())
    deviation = 1.4826 * (1 + 5 / (len(values) - design.shape[1])) * medians[best]
    near = misses[:, best] <= 2.5 * deviation
    scale, *rest = np.linalg.lstsq(design[near], wanted[near])[0]
    return float(scale), float(sum(rest) - scale * middle)


def crop_map(inverse: DepthMap, camera: Camera, window: Window) -> DepthMap:
    """Crop the map of a whole photo to a window of the photo, rounded to whole map pixels.

    Args:
        inverse: Inverse depths of the photo, at any resolution.
        camera: Camera of the photo.
        window: Left, top, width and height [px of the photo].
    """
    rows, columns = inverse.shape
    left, top, width, height = window
    x = np.floor((left + np.arange(width) + 0.5) * columns / camera.width).astype(np.int64)
    y = np.floor((top + np.arange(height) + 0.5) * rows / camera.height).astype(np.int64)
    return inverse[np.ix_(y, x)]


def resize_map(inverse: DepthMap, width: int, height: int) -> DepthMap:
    """Resize a map; each pixel is the mean of its known area, or unknown if less than half of the area is known."""
    if inverse.shape == (height, width):
        return inverse
    way = cv2.INTER_AREA if width <= inverse.shape[1] else cv2.INTER_LINEAR
    known = np.isfinite(inverse)
    share = cv2.resize(known.astype(np.float32), (width, height), interpolation=way)
    total = cv2.resize(np.where(known, inverse, np.float32(0)), (width, height), interpolation=way)
    return np.where(share >= 0.5, total / np.maximum(share, 0.5), np.float32(np.nan)).astype(np.float32)
