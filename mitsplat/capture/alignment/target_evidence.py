"""Scale and vertical direction of a reconstruction by printed targets: a ChArUco board, or AprilTags."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from skimage.transform import SimilarityTransform

from mitsplat.arrays import Float64Array
from mitsplat.capture.boards.targets import Board, find_tags
from mitsplat.capture.structure_from_motion import SparseModel
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import transform_points
from mitsplat.geometry.triangulation import triangulate
from mitsplat.images.picture_files import read_picture

MAX_CONTRADICTION = 0.0025
"""Reprojection error of the board up to which a camera is confirmed, as a fraction of the longer image edge."""

_WRONG_LIMIT = 0.01
"""Reprojection error above which a camera is always wrong, as a fraction of the longer image edge.

Between both limits, a camera is wrong if its error is an outlier.
"""

_OUTLIER_FACTOR = 3.0
"""Factor of the median camera error above which an error is an outlier."""

PRINT_ERROR = 1e-4
"""Standard error of the user's measurement of a printed square or tag edge [m]."""

_GROUPS = 6
"""Number of image groups of the jackknife for the scale error."""

TargetViews = dict[int, dict[str, tuple[Camera, Float64Array]]]
"""Camera and pixels of each corner or tag, by its index and the image."""


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """Evidence of scale and gravity in the frame of the model.

    Attributes:
        scale: Metres per unit of the model, or None.
        scale_error: Estimated relative standard error of the scale, or None.
        plane: Normal and point of a horizontal plane, shape (3,) each, or None.
        source, wrong, confirmed: As in :class:`~mitsplat.capture.alignment.metric_frame.MetricFrame`.
        board: Pose of the board [units of the model], shape (4, 4), or None.
    """

    scale: float | None = None
    scale_error: float | None = None
    plane: tuple[Float64Array, Float64Array] | None = None
    source: str = ""
    wrong: Mapping[str, float] = field(default_factory=dict)
    confirmed: frozenset[str] = frozenset()
    board: Float64Array | None = None


def board_evidence(model: SparseModel, views: TargetViews, board: Board) -> FrameEvidence | None:
    """Return the evidence of a ChArUco board, or None if too few of its corners are seen."""
    corners = _triangulate_corners(views, set(model.cameras))
    fitted = _fit_board(corners, board)
    if fitted is None:
        return None
    pose, factor = fitted
    flat = transform_points(pose, board.corners / factor)
    wrong, confirmed = _check_cameras(views, {**dict(enumerate(flat)), **corners})

    def board_scale(names: set[str]) -> float | None:
        fitted = _fit_board(_triangulate_corners(views, names), board)
        return None if fitted is None else fitted[1]

    return FrameEvidence(
        scale=factor,
        scale_error=_scale_error(factor, board_scale, list(model.cameras), board.square),
        plane=(pose[:3, 2], pose[:3, 3]),
        source=f"a ChArUco board ({len(corners)} corners)",
        wrong=wrong,
        confirmed=confirmed,
        board=pose,
    )


def tag_evidence(model: SparseModel, views: TargetViews, edge: float) -> FrameEvidence | None:
    """Return the evidence of AprilTags with a given edge [m], or None if there are none."""
    tags = _triangulate_tags(views, set(model.cameras))
    if not tags:
        return None

    def tag_scale(names: set[str]) -> float | None:
        quads = _triangulate_tags(views, names).values()
        edges = [np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1) for quad in quads]
        return edge / float(np.mean(edges)) if edges else None

    factor = tag_scale(set(model.cameras)) or np.nan
    return FrameEvidence(
        scale=factor,
        scale_error=_scale_error(factor, tag_scale, list(model.cameras), edge),
        plane=_plane_of_tags(tags),
        source=f"{len(tags)} AprilTag{'s' if len(tags) > 1 else ''}",
    )


def fit_similarity(source: Float64Array, target: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Fit the similarity between two point sets (Umeyama 1991).

    Args:
        source: Points, shape (N, 3).
        target: Corresponding points, shape (N, 3).

    Returns:
        Matrix, shape (4, 4), and the residuals, shape (N, 3).
    """
    matrix = np.asarray(SimilarityTransform.from_estimate(source, target).params, dtype=np.float64)
    return matrix, transform_points(matrix, source) - target


def find_targets(
    model: SparseModel, images: Mapping[str, Path], board: Board, *, tags: bool
) -> tuple[TargetViews, TargetViews]:
    """Detect board corners and AprilTags in the images.

    Returns:
        Pixels (2,) of board corners by index and image, and pixels (4, 2) of tag corners by tag id and image.
    """
    corner_views: TargetViews = {}
    tag_views: TargetViews = {}
    for name, camera in model.cameras.items():
        grey = read_picture(images[name], cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if grey is None:
            raise InputError(f"{images[name]}: not a readable image")
        pixels = np.asarray(grey, dtype=np.uint8)
        for found, views in ((board.find(pixels), corner_views), (find_tags(pixels) if tags else {}, tag_views)):
            for index, places in found.items():
                views.setdefault(index, {})[name] = (camera, places)
    return corner_views, tag_views


def _scale_error(scale: float, measure: Callable[[set[str]], float | None], images: list[str], edge: float) -> float:
    """Return the relative standard error of a scale, from the print and a jackknife over image groups (Tukey 1958).

    The residuals of corners are too optimistic, because a deformation of the whole model moves all corners together. So
    the scale is measured with every sixth image left out in turn, which also changes the mix of cameras.

    Args:
        scale: Scale from all images.
        measure: Function that returns the scale from a subset of the images, or None if they are not sufficient.
        images: Names of all images.
        edge: Edge length measured by the user [m].
    """
    found = [measure(set(images) - set(images[first::_GROUPS])) for first in range(_GROUPS)]
    scales = np.array([value for value in found if value is not None])
    drawn = float(np.sqrt((len(scales) - 1) * scales.var())) / scale if len(scales) > 1 else 0.0
    return float(np.hypot(drawn, PRINT_ERROR / edge))


def _triangulate_corners(views: TargetViews, names: set[str]) -> dict[int, Float64Array]:
    """Triangulate the board corners that enough of the named images show; points (3,) by index."""
    found = {i: triangulate([view for name, view in seen.items() if name in names]) for i, seen in views.items()}
    return {index: point for index, point in found.items() if point is not None}


def _triangulate_tags(views: TargetViews, names: set[str]) -> dict[int, Float64Array]:
    """Triangulate the tags that enough of the named images show; corners (4, 3) in the model by tag id."""
    tags = {}
    for number, seen in views.items():
        shown = [view for name, view in seen.items() if name in names]
        points = (triangulate([(camera, quad[corner]) for camera, quad in shown]) for corner in range(4))
        found = [point for point in points if point is not None]
        if len(found) == 4:
            tags[number] = np.array(found)
    return tags


def _check_cameras(views: TargetViews, corners: Mapping[int, Float64Array]) -> tuple[dict[str, float], frozenset[str]]:
    """Compare the cameras with the board.

    A camera is judged if it observes at least six corners. Cameras with few or repetitive points can be far off at
    small reprojection errors.

    Args:
        views: Observations of board corners.
        corners: Positions (3,) of the corners by index. Triangulated positions are best, because a bent print is not
            flat.

    Returns:
        Images that contradict the board, with their error [px], and images that agree with it.
    """
    errors: dict[str, list[float]] = {}
    edges = {}
    for index, seen in views.items():
        for name, (camera, pixel) in seen.items():
            error = np.linalg.norm(camera.project(corners[index])[0][0] - pixel)
            errors.setdefault(name, []).append(float(np.nan_to_num(error, nan=np.inf)))
            edges[name] = max(camera.size)
    shares = {name: float(np.median(found)) / edges[name] for name, found in errors.items() if len(found) >= 6}
    if not shares:
        return {}, frozenset()
    outlying = _OUTLIER_FACTOR * float(np.median(list(shares.values())))
    limit = min(max(MAX_CONTRADICTION, outlying), _WRONG_LIMIT)
    wrong = {name: share * edges[name] for name, share in shares.items() if share > limit}
    return wrong, frozenset(name for name, share in shares.items() if share <= MAX_CONTRADICTION)


def _fit_board(corners: Mapping[int, Float64Array], board: Board) -> tuple[Float64Array, float] | None:
    """Return the pose (4, 4) of the board in the model, and the metres per unit of the model.

    The result is None if there are too few corners or their arrangement does not match the board.
    """
    if len(corners) < 6:
        return None
    ids = sorted(corners)
    printed = board.corners[ids]
    matrix, residuals = fit_similarity(printed, np.array([corners[index] for index in ids]))
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rms = float(np.sqrt((residuals**2).sum(axis=1).mean())) / scale
    spread = float(np.sqrt(((printed - printed.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if rms > 0.05 * spread:
        return None
    pose = matrix.copy()
    pose[:3, :3] /= scale
    return pose, 1 / scale


def _plane_of_tags(tags: Mapping[int, Float64Array]) -> tuple[Float64Array, Float64Array] | None:
    """Return the normal and a point of the common plane of the tags, or None if they are not in one plane."""
    corners = np.concatenate(list(tags.values()))
    point = corners.mean(axis=0)
    _, spread, axes = np.linalg.svd(corners - point)
    return (axes[2], point) if spread[2] < 0.02 * spread[0] else None
