"""Object masks from geometry: photos are segmented from points on the object, then from the common outline of all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import BoolArray, ByteImage, Float64Array
from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.photo_masks import NO_OCCLUSION, Hidden, MaskMaker, add_masks
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.clusters import cluster_points, gap_between
from mitsplat.geometry.triangulation import count_observers
from mitsplat.images.masks import disc, fill_hull, largest_part
from mitsplat.progress import Progress
from mitsplat.runtime.cores import usable_cores

Bare = Callable[[Camera, ByteImage], BoolArray]
"""Function of a camera and its grey image (H, W) that returns pixels (H, W) that are certainly not the object."""

_WORK_EDGE = 480
"""Longer edge of the photo in the first GrabCut, and of the object in the last [px]."""

_PROJECTION_LIMIT = 100
"""Limit of projected coordinates, in image sizes; points beyond it are ignored."""

_ROUNDS = 3
"""Iterations of GrabCut."""

_EXTENSIONS = 4
"""Maximum number of extensions of the undecided band."""

_RING = 0.1
"""Width of the undecided band around the object, as a fraction of its size."""

_CELLS = 96
"""Cells along the longest edge of the visual hull's box."""

_DISSENT_SHARE = 0.04
"""Fraction of the photos whose masks may exclude a cell that still belongs to the visual hull."""

_BAND = 0.04
"""Half width of the band around the common outline that each photo segments by itself, as a fraction of the object
size.
"""

_MIN_PHOTOS = 3
"""Minimum number of photos for a common outline."""

_MIN_HEIGHT = 0.01
"""Minimum height of object points above the table, as a fraction of the cameras' distance."""


def object_masks(
    capture: Capture,
    points: Float64Array,
    above: Float64Array,
    folder: Path,
    *,
    bare: Bare | None = None,
    hidden: Hidden = NO_OCCLUSION,
    progress: Progress | None = None,
) -> Capture:
    """Return the capture with masks of an object, from points on it.

    The object is first segmented in each photo alone, then again with the common outline of all photos.

    Args:
        capture: Capture whose image files exist.
        points: Points of the object and of its footprint, shape (N, 3).
        above: Points of the object alone, which masks must cover, shape (M, 3).
        folder: Folder for the masks.
        bare: Function that finds pixels that are certainly not the object.
        hidden: Pixels in which other objects may occlude the object; masks are 0 and transparent there.
        progress: Callback with the number of finished photos.
    """
    add = partial(
        add_masks, capture, folder=folder, progress=progress, points=above, hidden=hidden, threads=usable_cores()
    )
    masked = add(geometric_masks(points, bare, hidden))
    if len(masked.photos) < _MIN_PHOTOS:
        return masked
    # The second pass uses all photos again, because the common outline can repair masks that were rejected.
    return add(agreed_masks(masked, points, bare, hidden))


def geometric_masks(points: Float64Array, bare: Bare | None = None, hidden: Hidden = NO_OCCLUSION) -> MaskMaker:
    """Return a function that computes masks by GrabCut (Rother et al. 2004), initialised by the hull of object points.

    The arguments are those of :func:`object_masks`.
    """

    def make(photo: Photo) -> BoolArray:
        camera, bgr, _ = _reduce_photo(photo)
        unknown = _resize_occlusion(hidden.get(photo.name), camera)
        pixels, _ = camera.project(points)
        # A point close to the camera plane projects to coordinates that overflow an integer.
        near = (np.abs(pixels) < _PROJECTION_LIMIT * max(camera.size)).all(axis=1)
        return _resize_mask(
            _segment_from_points(bgr, pixels[near], _background_pixels(bare, camera, bgr), unknown), photo.camera
        )

    return make


def agreed_masks(
    masked: Capture, points: Float64Array, bare: Bare | None = None, hidden: Hidden = NO_OCCLUSION
) -> MaskMaker:
    """Return a function that computes masks by GrabCut within a band around the common outline of all photos.

    In one photo, background such as a dark corner can look like the object. Other photos show it beside the object. The
    visual hull (Laurentini 1994) of all masks, except the few that contradict the rest, gives the common outline.

    The arguments after ``masked``, the capture with initial masks, are those of :func:`object_masks`. The points bound
    the hull.
    """
    small = {photo.name: _reduce_photo(photo) for photo in masked.photos}
    shown = [(camera, mask | _resize_occlusion(hidden.get(name), camera)) for name, (camera, _, mask) in small.items()]
    hull, cell = _agreed_hull(shown, points)

    def make(photo: Photo) -> BoolArray:
        rough = small[photo.name][2] if photo.name in small else None
        camera, bgr, _ = _reduce_photo(photo, 1 if rough is None else _extent_share(rough))
        unknown = _resize_occlusion(hidden.get(photo.name), camera)
        silhouette = _silhouette(hull, cell, camera)
        band = _BAND * float(np.sqrt(np.count_nonzero(silhouette)))
        if not band > 0:
            return np.zeros((photo.camera.height, photo.camera.width), dtype=bool)
        near, core = _dilate(silhouette, band), ~_dilate(~silhouette, band)
        free = _background_pixels(bare, camera, bgr)
        return _resize_mask(_segment(bgr, near, core, core, free, unknown, band), photo.camera)

    return make


def object_points(capture: Capture) -> Float64Array:
    """Find the points (N, 3) of the object on the table (z = 0).

    The object is a large cluster near the point at which the cameras are directed. Points at the height of the table
    cannot be separated from it. So the vertical projections of the cluster's lowest points onto the table are added; of
    all points, if none is low.

    Raises:
        InputError: If there is no such cluster.
    """
    centres = np.array([photo.camera.centre for photo in capture.photos])
    distance = float(np.median(np.linalg.norm(centres, axis=1)))
    points = capture.points[count_observers([photo.seen for photo in capture.photos], len(capture.points)) >= 3]
    points = points[(points[:, 2] > _MIN_HEIGHT * distance) & (np.linalg.norm(points, axis=1) < 0.9 * distance)]
    if len(points) < 20:
        raise InputError(
            f"no object was found above the table in the photos ({len(points)} points above it): give masks, or take "
            "photos of one object on a textured table"
        )
    label = cluster_points(points, gap_between(points, 0.05 * distance, 0.1 * distance))
    sizes = np.bincount(label)
    offset = np.array([np.linalg.norm(points[label == k, :2].mean(axis=0)) for k in range(len(sizes))])
    chosen = int(np.argmax(sizes / (0.1 + offset / distance)))
    cluster = points[label == chosen]
    low = cluster[cluster[:, 2] < 0.15 * cluster[:, 2].max()]
    return np.concatenate([cluster, (low if len(low) >= 5 else cluster) * (1, 1, 0)])


def _background_pixels(bare: Bare | None, camera: Camera, bgr: ByteImage) -> BoolArray:
    """Return the pixels that are certainly not the object, shape (H, W)."""
    if bare is None:
        return np.zeros(bgr.shape[:2], dtype=bool)
    return bare(camera, np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8))


def _resize_occlusion(hidden: BoolArray | None, camera: Camera) -> BoolArray:
    """Return the possibly occluded pixels in the size of a camera's picture; no pixels if None."""
    if hidden is None:
        return np.zeros((camera.height, camera.width), dtype=bool)
    return np.asarray(cv2.resize(hidden.astype(np.uint8), camera.size, interpolation=cv2.INTER_NEAREST) > 0)


def _segment_from_points(image: ByteImage, pixels: Float64Array, free: BoolArray, unknown: BoolArray) -> BoolArray:
    """Segment a BGR image (H, W, 3) by GrabCut from projected object points (N, 2).

    Parts of the object without points lie outside the hull of the points. So the undecided band starts at the hull and
    is extended around the segmented region.
    """
    height, width = image.shape[:2]
    nothing = np.zeros((height, width), dtype=bool)
    if len(pixels) < 3:
        return nothing
    filled = np.zeros((height, width), dtype=np.uint8)
    fill_hull(filled, pixels)
    if not filled.any():
        return nothing
    dots = np.zeros_like(filled)
    x, y = pixels[((pixels >= 0) & (pixels < (width, height))).all(axis=1)].astype(np.intp).T
    dots[y, x] = 1
    size = float(np.sqrt(filled.sum()))
    core = _dilate(dots, 0.02 * size) & ~_dilate(filled == 0, 0.03 * size)
    inside = filled > 0
    for _ in range(_EXTENSIONS):
        near = _dilate(inside | (filled > 0), _RING * size)
        before, inside = inside, _segment(image, near, inside, core, free, unknown, _RING * size)
        if np.count_nonzero(inside & ~before) < 0.01 * np.count_nonzero(inside):
            break
    return inside


def _segment(
    image: ByteImage,
    near: BoolArray,
    inside: BoolArray,
    core: BoolArray,
    free: BoolArray,
    unknown: BoolArray,
    ring: float,
) -> BoolArray:
    """Segment a BGR image (H, W, 3) by GrabCut within ``near``.

    Args:
        image: BGR image, shape (H, W, 3).
        near: Pixels that may be object.
        inside: Pixels that are probably object.
        core: Pixels that are certainly object.
        free: Pixels that are certainly background.
        unknown: Possibly occluded pixels. They are never object, but they can connect parts of it.
        ring: Width of the undecided band [px].
    """
    trimap = np.full(near.shape, cv2.GC_BGD, dtype=np.uint8)
    trimap[near] = cv2.GC_PR_BGD
    trimap[inside] = cv2.GC_PR_FGD
    trimap[core] = cv2.GC_FGD
    trimap[free | unknown] = cv2.GC_BGD
    # The colour model of the background uses only the surroundings of the object, and the run time depends on their
    # box.
    edge = round(ring) + 4
    y, x = np.nonzero(near)
    box = np.s_[max(0, y.min() - edge) : y.max() + edge + 1, max(0, x.min() - edge) : x.max() + edge + 1]
    part = np.ascontiguousarray(trimap[box])
    found = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    if found.any() and not found.all():
        cv2.setRNGSeed(0)  # per thread
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(np.ascontiguousarray(image[box]), part, (0, 0, 1, 1), *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
        found = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    cut = np.zeros_like(near)
    cut[box] = largest_part(found | unknown[box]) & found
    return cut


def _agreed_hull(views: Sequence[tuple[Camera, BoolArray]], points: Float64Array) -> tuple[Float64Array, float]:
    """Return the centres (N, 3) of cells that all masks except a few show as object, and the cell edge."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.3 * float((high - low).max())
    low, high = low - (margin, margin, 0.0), high + margin
    cell = float((high - low).max()) / _CELLS
    axes = [np.arange(a + cell / 2, b, cell) for a, b in zip(low, high, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    most = max(1, round(_DISSENT_SHARE * len(views)))
    misses = np.zeros(len(cells), dtype=np.int64)
    seen = np.zeros(len(cells), dtype=np.int64)
    for camera, mask in views:
        left = np.flatnonzero(misses <= most)
        inside, x, y = camera.visible_pixels(cells[left])
        seen[left[inside]] += 1
        misses[left[inside]] += ~mask[y, x]
    return cells[(misses <= most) & (seen > len(views) // 4)], cell


def _silhouette(cells: Float64Array, cell: float, camera: Camera) -> BoolArray:
    """Return the pixels covered by cells of edge ``cell``, shape (H, W)."""
    shown = np.zeros((camera.height, camera.width), dtype=np.uint8)
    pixels, depths = camera.project(cells)
    inside = camera.contains(pixels)
    if not inside.any():
        return shown > 0
    x, y = pixels[inside].astype(np.intp).T
    shown[y, x] = 1
    # Cell centres are at most one edge apart and half an edge inside the outline.
    edge = cell * camera.fx / float(np.median(depths[inside]))
    return ~_dilate(~_dilate(shown, edge), edge / 2)


def _extent_share(mask: BoolArray) -> float:
    """Return the extent of a mask as a fraction of the longer edge of its picture."""
    shown = np.argwhere(mask)
    return float(np.ptp(shown, axis=0).max() + 1) / max(mask.shape) if len(shown) else 1.0


def _reduce_photo(photo: Photo, share: float = 1.0) -> tuple[Camera, ByteImage, BoolArray]:
    """Return camera, BGR picture (H, W, 3) and mask (H, W) of a photo, reduced for GrabCut.

    Args:
        photo: Photo to reduce.
        share: Extent of the object as a fraction of the photo's longer edge.
    """
    camera, rgb, mask, _ = photo.fitted(_WORK_EDGE / share)
    bgr = np.rint(255 * rgb[..., ::-1]).astype(np.uint8)
    return camera, bgr, np.zeros(bgr.shape[:2], bool) if mask is None else mask >= 0.5


def _resize_mask(mask: BoolArray, camera: Camera) -> BoolArray:
    """Return a mask resampled to the size of the camera."""
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.0)
    return np.asarray(cv2.resize(soft, camera.size, interpolation=cv2.INTER_CUBIC) >= 0.5)


def _dilate(mask: npt.NDArray[np.generic], radius: float) -> BoolArray:
    """Dilate a mask by a disc with a radius of at least one pixel."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc(max(1, round(radius)))) > 0)
