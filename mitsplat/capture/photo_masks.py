"""Object masks of photographs: given by the user, by transparency, from a segmentation network, or from geometry."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageOps
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.capture.capture import Capture, Photo, mask_name
from mitsplat.capture.photos import Prepared, alpha_channel, mask_files, plain_background, read_mask, with_orientation
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.progress import Progress
from mitsplat.runtime.cores import usable_cores
from mitsplat.runtime.onnx_networks import load_library
from mitsplat.storage.files import write_file

ByteImage = npt.NDArray[np.uint8]
MaskMaker = Callable[[Photo], BoolArray]
"""Function that computes the mask of a photo, shape (H, W)."""

Hidden = Mapping[str, BoolArray]
"""Pixels (H, W) in which another object may occlude the object, by the name of the photo; photos without them are
absent.
"""
_NOTHING: Hidden = {}

Bare = Callable[[Camera, npt.NDArray[np.uint8]], BoolArray]
"""Function of a camera and its grey image (H, W) that returns pixels (H, W) that are certainly not the object."""

MIN_SHARE = 0.02
"""Minimum fraction of a photo that a mask must cover; networks that find nothing mark less."""

MIN_AGREEMENT = 0.7
"""Minimum fraction of the object's points in a photo that its mask must cover."""

_MAX_BORDER = 0.9
"""Maximum fraction of the border of a photo that a mask may cover."""

_WORK_EDGE = 480
"""Longer edge of the photo in the first GrabCut, and of the object in the last [px]."""

_PROJECTION_LIMIT = 100
"""Limit of projected coordinates, in image sizes; points beyond it are ignored."""

_ROUNDS = 3
_EXTENSIONS = 4
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


def add_masks(
    capture: Capture,
    make: MaskMaker,
    folder: Path,
    *,
    progress: Progress | None = None,
    points: Float64Array | None = None,
    hidden: Hidden = _NOTHING,
    threads: int = 1,
) -> Capture:
    """Return the capture with a mask for each photo; photos with an unusable mask are rejected.

    Args:
        capture: Capture whose image files exist.
        make: Function that computes one mask.
        folder: Folder for the masks.
        progress: Callback with the number of finished photos.
        points: Points of the object that masks must cover, shape (N, 3).
        hidden: Pixels in which other objects may occlude the object.
        threads: Number of masks that are computed at the same time.
    """
    photos, rejected = [], dict(capture.rejected)

    def cut(photo: Photo) -> str | None:
        """Write the mask of a photo, or return the reason why it is unusable."""
        mask, unknown = make(photo), hidden.get(photo.name)
        mask = mask if unknown is None else mask & ~unknown
        reason = _mask_fault(mask, photo.camera, points, unknown)
        if reason is None:
            write_file(folder / mask_name(photo.name), partial(_save_mask, mask, unknown))
        return reason

    with ThreadPoolExecutor(threads) as pool:
        for done, (photo, reason) in enumerate(
            zip(capture.photos, pool.map(cut, capture.photos), strict=True), start=1
        ):
            if reason is None:
                photos.append(replace(photo, mask=folder / mask_name(photo.name)))
            else:
                rejected[photo.name] = reason
            if progress is not None:
                progress(done, len(capture.photos), "cutting out")
    return replace(capture, photos=tuple(photos), rejected=rejected)


def check_borders(capture: Capture, source: Path) -> Capture:
    """Return a capture with masks from the folder ``source``.

    Raises:
        InputError: If most masks are white along the border of the photo, as inverted masks are.
    """
    masks = [photo.read().mask for photo in capture.photos]
    borders = [np.concatenate([m[0], m[-1], m[:, 0], m[:, -1]]) for m in masks if m is not None]
    around = sum(bool(border.mean() > _MAX_BORDER) for border in borders)
    if around > len(capture.photos) / 2:
        raise InputError(
            f"{source}: masks must be white, or photos opaque, only on the object (got {around} of "
            f"{len(capture.photos)} with a white or opaque border): invert them"
        )
    return capture


def object_masks(
    capture: Capture,
    points: Float64Array,
    above: Float64Array,
    folder: Path,
    *,
    bare: Bare | None = None,
    hidden: Hidden = _NOTHING,
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


def given_masks(folder: Path, prepared: Mapping[str, Prepared], lenses: Mapping[str, Camera]) -> MaskMaker:
    """Return a function that reads masks of the user, see :func:`read_mask`.

    Args:
        folder: Folder of the masks.
        prepared: Photo copies by the name of the photo.
        lenses: Cameras of the copies, before distortion was removed.

    Raises:
        InputError: Raised by the returned function if a mask is missing or has another aspect ratio.
    """
    files = mask_files(folder)

    def make(photo: Photo) -> BoolArray:
        mask = read_mask(files, prepared[photo.name])
        if mask is None:
            raise InputError(
                f"{folder}: every photo must have a mask (missing: {Path(photo.name).with_suffix('.png').as_posix()})"
            )
        return _seen_by(photo.camera, mask, lenses[photo.name])

    return make


def cutout_masks(
    folder: Path, prepared: Mapping[str, Prepared], lenses: Mapping[str, Camera], names: Collection[str]
) -> MaskMaker | None:
    """Return a function that takes the masks of photos whose background was removed from their transparency.

    Args:
        folder: Folder of the photos.
        prepared: Photo copies by the name of the photo.
        lenses: Cameras of the copies, before distortion was removed.
        names: Names of the photos.

    Returns:
        None if a photo has no alpha channel, or if no photo has a transparent pixel.
    """
    opaque = [prepared[name].opaque for name in names]
    if None in opaque or min(share for share in opaque if share is not None) == 1:
        return None

    def make(photo: Photo) -> BoolArray:
        copy = prepared[photo.name]
        with Image.open(folder / photo.name) as image:
            alpha = alpha_channel(image)
        if alpha is None:  # replaced since it was prepared
            raise InputError(f"{folder / photo.name}: must have transparent pixels, as when it was read")
        alpha = ImageOps.exif_transpose(with_orientation(alpha, copy.orientation))
        mask = np.asarray(alpha.resize(copy.size, Image.Resampling.BOX)) >= 128
        return _seen_by(photo.camera, mask, lenses[photo.name])

    return make


def plain_masks(photos: Sequence[Photo]) -> MaskMaker | None:
    """Return a function that masks what is not the plain background of rendered photos; None if a photo has none."""

    def background(photo: Photo) -> BoolArray | None:
        rgb = np.rint(255 * replace(photo, gain=None).read().rgb).astype(np.uint8)
        return plain_background(rgb, without_noise=True)

    if any(background(photo) is None for photo in photos):
        return None

    def make(photo: Photo) -> BoolArray:
        plain = background(photo)
        return np.zeros((photo.camera.height, photo.camera.width), bool) if plain is None else ~plain

    return make


def _seen_by(camera: Camera, mask: BoolArray, lens: Camera) -> BoolArray:
    """Return a mask of a photo as its camera without distortion sees it; the mask itself if the lens is unchanged."""
    if not lens.distortion or camera.distortion:
        return mask
    pixels, _ = lens.undistorted(np.uint8(255) * mask.astype(np.uint8)[..., None])
    return np.asarray(pixels.reshape(camera.height, camera.width) >= 128)


def model_masks(model: Path) -> MaskMaker:
    """Return a function that computes masks by a segmentation network through rembg.

    The network is an ONNX file for dichotomous segmentation, like IS-Net.

    Raises:
        InputError: If the file does not exist or is no such network.
        MissingResourceError: If rembg is not installed, or ONNX Runtime is too old.
    """
    if not model.is_file():
        raise InputError(f"{model}: no such file")
    rembg = load_library("masks", "rembg")
    try:
        session: Any = rembg.new_session("dis_custom", model_path=str(model.resolve()))
    except Exception as error:  # exceptions of onnxruntime have no other base
        raise InputError(f"{model}: not a segmentation network in ONNX ({' '.join(str(error).split())})") from error

    def make(photo: Photo) -> BoolArray:
        with Image.open(photo.file) as image:
            cut = rembg.remove(image.convert("RGB"), session=session, only_mask=True, post_process_mask=False)
        return _largest_part(np.asarray(cut.convert("L")) >= 128)

    return make


def geometric_masks(points: Float64Array, bare: Bare | None = None, hidden: Hidden = _NOTHING) -> MaskMaker:
    """Return a function that computes masks by GrabCut (Rother et al. 2004), initialised by the hull of object points.

    Args:
        points: Points of the object in the frame of the capture, shape (N, 3); see :func:`object_points`.
        bare: Function that finds pixels that are certainly not the object.
        hidden: Pixels in which other objects may occlude the object.
    """

    def make(photo: Photo) -> BoolArray:
        camera, bgr, _ = _reduce_photo(photo)
        unknown = _resize_occlusion(hidden.get(photo.name), camera)
        pixels, _ = camera.project(points)
        # A point close to the camera plane projects to coordinates that overflow an integer.
        near = (np.abs(pixels) < _PROJECTION_LIMIT * max(camera.width, camera.height)).all(axis=1)
        return _resize_mask(
            _segment_from_points(bgr, pixels[near], _background_pixels(bare, camera, bgr), unknown), photo.camera
        )

    return make


def agreed_masks(
    masked: Capture, points: Float64Array, bare: Bare | None = None, hidden: Hidden = _NOTHING
) -> MaskMaker:
    """Return a function that computes masks by GrabCut within a band around the common outline of all photos.

    In one photo, background such as a dark corner can look like the object. Other photos show it beside the object. The
    visual hull (Laurentini 1994) of all masks, except the few that contradict the rest, gives the common outline.

    Args:
        masked: Capture with initial masks.
        points: Points of the object in the frame of the capture, shape (N, 3); they bound the hull.
        bare: Function that finds pixels that are certainly not the object.
        hidden: Pixels in which other objects may occlude the object.
    """
    small = {photo.name: _reduce_photo(photo) for photo in masked.photos}
    shown = [(camera, mask | _resize_occlusion(hidden.get(name), camera)) for name, (camera, _, mask) in small.items()]
    hull, cell = _agreed_hull(shown, points)

    def make(photo: Photo) -> BoolArray:
        rough = small[photo.name][2] if photo.name in small else None
        camera, bgr, mask = _reduce_photo(photo, 1 if rough is None else _extent_share(rough))
        unknown = _resize_occlusion(hidden.get(photo.name), camera)
        silhouette = _silhouette(hull, cell, camera)
        size = float(np.sqrt(np.count_nonzero(silhouette)))
        if size > 0:
            near = _dilate(silhouette, _BAND * size)
            core = ~_dilate(~silhouette, _BAND * size)
            free = _background_pixels(bare, camera, bgr)
            mask = _segment(bgr, near, silhouette & (mask | core), core, free, unknown, _BAND * size)
        return _resize_mask(mask, photo.camera)

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
    counts = np.zeros(len(capture.points), dtype=np.int64)
    for photo in capture.photos:
        counts[photo.seen] += 1
    points = capture.points[counts >= 3]
    points = points[(points[:, 2] > _MIN_HEIGHT * distance) & (np.linalg.norm(points, axis=1) < 0.9 * distance)]
    if len(points) < 20:
        raise InputError(
            f"no object was found above the table in the photos ({len(points)} points above it): give masks, or take "
            "photos of one object on a textured table"
        )
    tree = cKDTree(points)
    reach = float(np.clip(4 * np.median(tree.query(points, k=6)[0][:, -1]), 0.05 * distance, 0.1 * distance))
    pairs = tree.query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    label = connected_components(graph, directed=False)[1]
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
    return np.asarray(
        cv2.resize(hidden.astype(np.uint8), (camera.width, camera.height), interpolation=cv2.INTER_NEAREST) > 0
    )


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
    cv2.fillConvexPoly(filled, np.rint(cv2.convexHull(pixels.astype(np.float32))).astype(np.int32), 1)
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
    cut[box] = _largest_part(found | unknown[box]) & found
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
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
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
    return np.asarray(cv2.resize(soft, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC) >= 0.5)


def _dilate(mask: npt.NDArray[np.generic], radius: float) -> BoolArray:
    """Dilate a mask by a disc with a radius of at least one pixel."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(1, round(radius)) + 1,) * 2)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)


def _largest_part(mask: BoolArray) -> BoolArray:
    """Return the largest connected component of a mask."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return parts == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()) if count > 1 else mask


def _mask_fault(mask: BoolArray, camera: Camera, points: Float64Array | None, hidden: BoolArray | None) -> str | None:
    share = float(mask.mean())
    if share < MIN_SHARE:
        return f"its mask covers only {share:.1%} of it"
    if share > 0.98:
        return f"its mask covers {share:.1%} of it"
    if points is not None:
        _, x, y = camera.visible_pixels(points)
        if hidden is not None:
            x, y = x[~hidden[y, x]], y[~hidden[y, x]]
        agreement = float(mask[y, x].mean()) if len(x) else 0.0
        if agreement < MIN_AGREEMENT:
            return f"its mask covers only {agreement:.0%} of the object's points"
    return None


def _save_mask(mask: BoolArray, hidden: BoolArray | None, part: Path) -> None:
    picture = Image.fromarray(np.uint8(255) * mask.astype(np.uint8))
    if hidden is not None:
        picture.putalpha(Image.fromarray(np.uint8(255) * (~hidden).astype(np.uint8)))
    picture.save(part, "PNG")
