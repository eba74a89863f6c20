"""Causes in the photographs that limit the quality of an asset: measurements with advice."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mitsplat.arguments import list_first
from mitsplat.arrays import BoolArray, Float32Array, Float64Array
from mitsplat.capture.capture import Capture
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.triangulation import nearest_point_to_lines, optical_axes

Pictures = Sequence[tuple[Camera, Float32Array, Float32Array | None]]
"""Camera, colours (H, W, 3) and mask (H, W) of each photo, all with the same longest edge."""

_MIN_POINTS = 100
"""Least number of points on an object that determine its surface beyond its outline."""
_MAX_SUPPORT_SHARE = 0.3
"""Largest share of masked points in the support surface; above it, masks seem to include the support."""
_SUPPORT_HEIGHT = 0.05
_MIN_SHARPNESS = 0.5
_MAX_NAMES = 5
_ELEVATION_BANDS = ((0.0, 20.0), (20.0, 45.0), (45.0, 90.0))
"""Elevation bands around the object [degrees]; in the last, whose circle is small, one photo is enough."""
_SECTOR = 30.0
_MIN_GAP_SECTORS = 3
"""Least number of neighbouring sectors without a camera in a band that is reported."""


def find_causes(capture: Capture, pictures: Pictures) -> dict[str, str]:
    """Return causes, one clause each, by the name of the threshold that they affect.

    Args:
        capture: The photos.
        pictures: Pictures of ``capture.photos``, in the same order.
    """
    found: dict[str, list[str]] = {}

    def add_cause(cause: str, *thresholds: str) -> None:
        for name in thresholds:
            found.setdefault(name, []).append(cause)

    if blurred := blurred_photos([photo.name for photo in capture.photos], pictures):
        names = list_first(blurred, _MAX_NAMES)
        add_cause(f"{len(blurred)} of {len(pictures)} photos are less than half as sharp as most ({names})", "psnr")
    if capture.up == "z" and (gaps := missing_views(views_from([photo.camera for photo in capture.photos]))):
        add_cause(f"no photo is from {'; from '.join(gaps)}", "mesh_iou", "watertight")
    own = masked_points(capture, pictures)
    if len(capture.points) and len(own) < _MIN_POINTS:
        add_cause(
            f"photos share only {len(own)} points on the object, because it has little texture: add dust or patterns, "
            "or import a mesh",
            *("psnr", "mesh_iou", "offset", "surface", "watertight"),
        )
    elif capture.table and len(own) and (share := share_on_support(own)) > _MAX_SUPPORT_SHARE:
        add_cause(
            f"{share:.0%} of the points inside the masks lie in the support surface, so masks seem to include it: "
            "photograph the object on another surface, or pick it",
            *("splat_iou", "mesh_iou", "offset", "surface", "lost", "watertight"),
        )
    return {name: "; ".join(causes) for name, causes in found.items()}


def masked_points(capture: Capture, pictures: Pictures) -> Float64Array:
    """Return the capture's points (K, 3) that lie inside the masks of more than half of the photos that see them."""
    inside, seen = np.zeros(len(capture.points)), np.zeros(len(capture.points))
    for photo, (camera, _, mask) in zip(capture.photos, pictures, strict=True):
        if mask is None:
            continue
        shown, x, y = camera.visible_pixels(capture.points[photo.seen])
        own = photo.seen[shown]
        seen[own] += 1
        inside[own] += mask[y, x] >= 0.5
    return np.asarray(capture.points[2 * inside > seen])


def share_on_support(points: Float64Array) -> float:
    """Return the share of points (N, 3) within 5 % of the object's height from its support, z = 0."""
    height = float(np.quantile(points[:, 2], 0.95))
    return float((np.abs(points[:, 2]) < _SUPPORT_HEIGHT * height).mean()) if height > 0 else 1.0


def blurred_photos(names: Sequence[str], pictures: Pictures) -> list[str]:
    """Return the photos in which the object is less than half as sharp as in the median photo, the worst first.

    Sharpness is the energy of the Laplacian relative to that of the gradient. This ratio depends little on the content.
    """
    values = []
    for _, rgb, mask in pictures:
        grey = cv2.cvtColor(np.ascontiguousarray(rgb, dtype=np.float32), cv2.COLOR_RGB2GRAY)
        # The outline has the sharpness of the mask, so only inner pixels count.
        seen = _eroded(np.ones(grey.shape, dtype=bool) if mask is None else mask >= 0.5)
        slopes = cv2.Sobel(grey, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(grey, cv2.CV_32F, 0, 1) ** 2
        curvature = cv2.Laplacian(grey, cv2.CV_32F) ** 2
        energy = float(slopes[seen].mean()) if seen.any() else 0.0
        values.append(float(curvature[seen].mean()) / energy if energy > 0 else np.nan)
    median = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
    order = np.argsort(values, kind="stable")
    return [names[i] for i in order if values[i] < _MIN_SHARPNESS * median]


def views_from(cameras: Sequence[Camera]) -> Float64Array:
    """Return camera centres (N, 3) relative to the point nearest to all optical axes."""
    centres, axes = optical_axes(cameras)
    return np.asarray(centres - nearest_point_to_lines(centres, axes))


def elevations(offsets: Float64Array) -> Float64Array:
    """Return the elevations (N,) above the horizon [degrees] of vectors (N, 3), z up."""
    return np.asarray(np.degrees(np.arctan2(offsets[:, 2], np.linalg.norm(offsets[:, :2], axis=1))))


def missing_views(offsets: Float64Array) -> list[str]:
    """Describe directions without a camera, for cameras at ``offsets`` (N, 3) from an object, z up."""
    heights = elevations(offsets)
    turns = np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])) % 360
    sectors = round(360 / _SECTOR)
    found = []
    for low, high in _ELEVATION_BANDS:
        where = f"{low:.0f} to {high:.0f} degrees above the object"
        inside = (heights >= low) & ((heights < high) | (high == _ELEVATION_BANDS[-1][1]))
        if not inside.any():
            found.append(where)
            continue
        taken = np.bincount((turns[inside] // _SECTOR).astype(int), minlength=sectors) > 0
        start, length = _longest_gap(taken)
        if low < _ELEVATION_BANDS[-1][0] and length >= _MIN_GAP_SECTORS:
            turn = start * _SECTOR
            found.append(f"{where}, {turn:.0f} to {(turn + length * _SECTOR) % 360:.0f} degrees around the object")
    return found


def _longest_gap(taken: BoolArray) -> tuple[int, int]:
    """Return start and length of the longest run of False in a ring that is not all False."""
    start = int(np.argmax(taken))
    best, length = (0, 0), 0
    for step in range(1, len(taken) + 1):
        position = (start + step) % len(taken)
        length = 0 if taken[position] else length + 1
        if length > best[1]:
            best = ((position - length + 1) % len(taken), length)
    return best


def _eroded(mask: BoolArray) -> BoolArray:
    """Return a mask without a border of three pixels."""
    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((7, 7), dtype=np.uint8)) > 0)
