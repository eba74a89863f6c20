"""Scale and vertical direction of a reconstruction.

Targets give both. A known distance gives the scale alone, the table plane or camera attitudes the vertical alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from skimage.transform import SimilarityTransform

from mitsplat.arrays import Float64Array
from mitsplat.capture.boards.targets import Board, find_tags
from mitsplat.capture.structure_from_motion import SparseModel
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.triangulation import nearest_point_to_lines, triangulate
from mitsplat.images.picture_files import read_picture

DEFAULT_BOARD = Board()
"""Default board of `mitsplat board`."""

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

_Views = dict[int, dict[str, tuple[Camera, Float64Array]]]

_MIN_TILT_COSINE = np.cos(np.radians(30))
"""Cosine of the largest angle between the table normal and the vertical that the cameras suggest."""


@dataclass(frozen=True, eq=False)
class MetricFrame:
    """Placement of a reconstruction in the asset frame.

    Attributes:
        matrix: Similarity ``asset_from_model``, shape (4, 4); z up, and z = 0 on the table if one is known.
        units: ``metre`` if the result is in metres, else ``unknown``.
        up: ``z`` if z is vertical (as far as a target or the table is level), else ``unknown``.
        table: True if z = 0 is a plane on which objects stand.
        source: Origin of scale and gravity, as a clause for the user.
        scale_error: Estimated relative standard error of the scale, if metric.
        wrong: Images whose cameras the board contradicts, with their error [px].
        confirmed: Images whose cameras agree with the board.
        board: Pose of the ChArUco board in the asset frame [m], shape (4, 4), if there is one.
    """

    matrix: Float64Array
    units: Literal["metre", "unknown"]
    up: Literal["z", "unknown"]
    table: bool
    source: str
    scale_error: float | None = None
    wrong: Mapping[str, float] = field(default_factory=dict)
    confirmed: frozenset[str] = frozenset()
    board: Float64Array | None = None


def find_metric_frame(
    model: SparseModel,
    images: Mapping[str, Path],
    *,
    board: Board = DEFAULT_BOARD,
    tag: float | None = None,
    scale_from: tuple[str, str, float] | None = None,
    centred: bool = True,
) -> MetricFrame:
    """Find scale and gravity from the best available evidence.

    A ChArUco board determines both, and so do AprilTags of known size. Otherwise ``scale_from`` determines the scale,
    and the largest plane below the cameras the vertical. If only the camera attitudes suggest a vertical, ``up`` is
    unknown.

    Args:
        model: Result of structure from motion.
        images: Image files by the names of the model.
        board: Board to detect.
        tag: Edge length of AprilTags as printed, without their white border [m].
        scale_from: Two points and their distance [m]; see :func:`spot`.
        centred: Put the origin below the point at which the cameras are directed; else in the middle of a board.

    Raises:
        InputError: If ``scale_from`` names points that do not exist, or all cameras coincide with the point at which
            they are directed.
    """
    views, tag_views = _find_targets(model, images, board, tags=tag is not None)
    corners = _triangulate_corners(views, set(model.cameras))
    tags = _triangulate_tags(tag_views, set(model.cameras))
    wrong: dict[str, float] = {}
    confirmed: frozenset[str] = frozenset()
    board_pose: Float64Array | None = None
    scale: tuple[float, float | None] | None = None
    plane: tuple[Float64Array, Float64Array] | None = None
    source = ""
    if fitted := _fit_board(corners, board):
        pose, factor = fitted
        board_pose = pose
        flat = board.corners / factor @ pose[:3, :3].T + pose[:3, 3]
        wrong, confirmed = _check_cameras(views, {**dict(enumerate(flat)), **corners})

        def board_scale(names: set[str]) -> float | None:
            fitted = _fit_board(_triangulate_corners(views, names), board)
            return None if fitted is None else fitted[1]

        error = _scale_error(factor, board_scale, list(model.cameras), board.square)
        scale, plane = (factor, error), (pose[:3, 2], pose[:3, 3])
        source = f"a ChArUco board ({len(corners)} corners)"
    elif tags and tag is not None:

        def tag_scale(names: set[str]) -> float | None:
            quads = _triangulate_tags(tag_views, names).values()
            edges = [np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1) for quad in quads]
            return tag / float(np.mean(edges)) if edges else None

        factor = tag_scale(set(model.cameras)) or np.nan
        scale = factor, _scale_error(factor, tag_scale, list(model.cameras), tag)
        source = f"{len(tags)} AprilTag{'s' if len(tags) > 1 else ''}"
        plane = _plane_of_tags(tags)
    if scale_from is not None and scale is None:
        one, other, metres = scale_from
        gap = float(np.linalg.norm(spot(model, one) - spot(model, other)))
        if not (1e-6 <= metres <= 1e6 and gap > 0):
            raise InputError(
                f"the distance of {one} and {other} must be 1e-6 to 1e6 m (got {metres}, {gap:.3g} in the model)"
            )
        scale, source = (metres / gap, None), f"the distance of {one} and {other}"
    if plane is None and (table := find_table(model)) is not None:
        plane = table
        source += f"{', ' if source else ''}the table plane"
    centres, forward = _rays(model)
    if plane is not None:
        normal, point = plane
        if np.median((centres - point) @ normal) < 0:
            normal = -normal
    else:
        upward = vertical_from_cameras(model)
        normal, point = (np.array([0.0, -1.0, 0.0]) if upward is None else upward), np.zeros(3)
        source += f"{', ' if source else ''}the cameras' attitude"
    target = nearest_point_to_lines(centres, forward)
    if plane is None:
        origin = target
    elif centred or board_pose is None:
        origin = target - (target - point) @ normal * normal
    else:
        origin = point
    distance = float(np.median(np.linalg.norm(centres - target, axis=1)))
    if not distance > 0:
        raise InputError(f"the {len(centres)} cameras must not coincide with the point at which they are directed")
    factor = scale[0] if scale else 1 / distance
    rotation = _upright_rotation(normal, forward[0] if board_pose is None else board_pose[:3, 0])
    matrix = np.eye(4)
    matrix[:3, :3] = factor * rotation
    matrix[:3, 3] = -factor * rotation @ origin
    if board_pose is not None:
        board_pose = matrix @ board_pose
        board_pose[:3, :3] /= factor
    return MetricFrame(
        matrix=matrix,
        units="metre" if scale else "unknown",
        up="unknown" if plane is None else "z",
        table=plane is not None,
        source=source,
        scale_error=scale[1] if scale else None,
        wrong=wrong,
        confirmed=confirmed,
        board=board_pose,
    )


def spot(model: SparseModel, name: str) -> Float64Array:
    """Return a point of the model, shape (3,).

    Args:
        model: Result of structure from motion.
        name: "photo" for the camera centre of a photo; "photo:x,y" for the surface point at a pixel of a photo.

    Raises:
        InputError: If there is no such photo, or it observes no point near the pixel.
    """
    photo, colon, pixel = name.rpartition(":") if ":" in name else (name, "", "")
    if photo not in model.cameras:
        raise InputError(f"{photo}: no such registered photo")
    camera = model.cameras[photo]
    if not colon:
        return camera.centre
    try:
        x, y = map(float, pixel.split(","))
    except ValueError:
        raise InputError(f"{name}: a pixel must be given as x,y (got {pixel})") from None
    seen = model.points[model.seen[photo]]
    pixels, depths = camera.project(seen)
    gaps = np.linalg.norm(pixels - (x, y), axis=1)
    near = np.argsort(gaps)[:5]
    limit = 0.03 * camera.width
    near = near[gaps[near] < limit]
    if not len(near):
        raise InputError(f"{name}: the photo observes no point within {limit:.0f} px of this pixel")
    # Observed points need not lie on the pixel: use the ray of the pixel and the depth of the nearest points.
    weights = 1 / (gaps[near] + 1)
    depth = float(depths[near] @ weights / weights.sum())
    ray = np.append(camera.ray_slopes([(x, y)])[0], 1.0) * depth
    return np.asarray(camera.world_from_camera[:3, :3] @ ray + camera.centre)


def fit_similarity(source: Float64Array, target: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Fit the similarity between two point sets (Umeyama 1991).

    Args:
        source: Points, shape (N, 3).
        target: Corresponding points, shape (N, 3).

    Returns:
        Matrix, shape (4, 4), and the residuals, shape (N, 3).
    """
    matrix = np.asarray(SimilarityTransform.from_estimate(source, target).params, dtype=np.float64)
    return matrix, source @ matrix[:3, :3].T + matrix[:3, 3] - target


def find_table(model: SparseModel, *, trials: int = 30000, seed: int = 0) -> tuple[Float64Array, Float64Array] | None:
    """Find the plane on which objects stand, by RANSAC (Fischler and Bolles 1981) over the points.

    The plane with the most points is chosen, at least 2 % of them. At least 95 % of the cameras must be above it, and
    less than a tenth of the points below it. If the cameras suggest a vertical, the normal must be within 30 degrees of
    it.

    Args:
        model: Result of structure from motion.
        trials: Number of random planes.
        seed: Seed of the random numbers.

    Returns:
        Normal towards the cameras and a point of the plane, or None.
    """
    points = model.points[_reliable_points(model)]
    if len(points) < 50:
        return None
    centres, forward = _rays(model)
    distance = float(np.median(np.linalg.norm(centres - nearest_point_to_lines(centres, forward), axis=1)))
    tolerance = 0.004 * distance
    upward = vertical_from_cameras(model)
    rng = np.random.default_rng(seed)
    sample = points[rng.permutation(len(points))[:3000]]
    a, b, c = (sample[indices] for indices in rng.integers(0, len(sample), (3, trials)))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    a, normals = (values[lengths > 1e-4 * distance**2] for values in (a, normals))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    above = centres @ normals.T - np.einsum("nk,nk->n", a, normals)
    normals *= np.where(np.median(above, axis=0) < 0, -1, 1)[:, None]
    usable = np.maximum(np.mean(above > 0, axis=0), np.mean(above < 0, axis=0)) >= 0.95
    if upward is not None:
        usable &= normals @ upward >= _MIN_TILT_COSINE
    best: tuple[Float64Array, Float64Array] | None = None
    most = max(30, len(sample) // 50)
    for point, normal in zip(a[usable], normals[usable], strict=True):
        heights = (sample - point) @ normal
        count = int(np.count_nonzero(np.abs(heights) < tolerance))
        if count > most and np.mean(heights < -3 * tolerance) < 0.1:
            best, most = (normal, point), count
    if best is None:
        return None
    normal, point = best
    for _ in range(5):
        near = points[np.abs((points - point) @ normal) < tolerance]
        point = near.mean(axis=0)
        refined = np.linalg.svd(near - point, full_matrices=False)[2][2]
        normal = refined * np.sign(refined @ normal)
    return normal, point


def vertical_from_cameras(model: SparseModel) -> Float64Array | None:
    """Estimate the up direction, shape (3,), from the attitudes of cameras; None if they do not suggest one.

    The estimate requires photographs from several sides in portrait or landscape format, held level. Up is the
    direction to which one image axis of each photo is most nearly orthogonal, on the side of the cameras.
    """
    poses = np.array([camera.world_from_camera[:3, :3] for camera in model.cameras.values()])
    sides = poses[:, :, :2]
    golden = np.arange(1000) + 0.5  # even samples of a half sphere (Fibonacci)
    height, angle = golden / 1000, np.pi * (1 + np.sqrt(5)) * golden
    radius = np.sqrt(1 - height**2)
    directions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    tilt = np.mean(np.min((directions @ sides) ** 2, axis=2), axis=0)
    best = int(tilt.argmin())
    upward = directions[best]
    for _ in range(5):
        level = sides[np.arange(len(sides)), :, np.argmin(np.abs(upward @ sides), axis=1)]
        refined = np.linalg.eigh(level.T @ level)[1][:, 0]
        upward = refined * np.sign(refined @ upward)
    others = tilt[np.abs(directions @ upward) < _MIN_TILT_COSINE]
    if tilt[best] > 0.03 or others.min() < 3 * tilt[best] + 0.01:  # arbitrary roll, or all from one side
        return None
    return np.asarray(upward * np.sign(np.mean(-poses[:, :, 2] @ upward)))


def _rays(model: SparseModel) -> tuple[Float64Array, Float64Array]:
    """Return centres and viewing directions of the cameras, shape (N, 3) each."""
    poses = np.array([camera.world_from_camera for camera in model.cameras.values()])
    return poses[:, :3, 3], poses[:, :3, 2]


def _reliable_points(model: SparseModel) -> npt.NDArray[np.intp]:
    """Return the indices of points that at least three images observe, or of all points if observations are unknown."""
    counts = np.zeros(len(model.points), dtype=np.int64)
    for indices in model.seen.values():
        counts[indices] += 1
    return np.flatnonzero(counts >= 3 if counts.any() else counts == 0)


def _upright_rotation(normal: Float64Array, heading: Float64Array) -> Float64Array:
    """Return the rotation (3, 3) that takes ``normal`` to z and the component of ``heading`` orthogonal to it to x."""
    x = heading - heading @ normal * normal
    if np.linalg.norm(x) < 1e-6:
        x = np.eye(3)[np.abs(normal).argmin()]
        x = x - x @ normal * normal
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def _find_targets(model: SparseModel, images: Mapping[str, Path], board: Board, *, tags: bool) -> tuple[_Views, _Views]:
    """Detect board corners and AprilTags in the images.

    Returns:
        Pixels (2,) of board corners by index and image, and pixels (4, 2) of tag corners by tag id and image.
    """
    corner_views: _Views = {}
    tag_views: _Views = {}
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


def _triangulate_corners(views: _Views, names: set[str]) -> dict[int, Float64Array]:
    """Triangulate the board corners that enough of the named images show; points (3,) by index."""
    found = {i: triangulate([view for name, view in seen.items() if name in names]) for i, seen in views.items()}
    return {index: point for index, point in found.items() if point is not None}


def _triangulate_tags(views: _Views, names: set[str]) -> dict[int, Float64Array]:
    """Triangulate the tags that enough of the named images show; corners (4, 3) in the model by tag id."""
    tags = {}
    for number, seen in views.items():
        shown = [view for name, view in seen.items() if name in names]
        points = (triangulate([(camera, quad[corner]) for camera, quad in shown]) for corner in range(4))
        found = [point for point in points if point is not None]
        if len(found) == 4:
            tags[number] = np.array(found)
    return tags


def _check_cameras(views: _Views, corners: Mapping[int, Float64Array]) -> tuple[dict[str, float], frozenset[str]]:
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
            edges[name] = max(camera.width, camera.height)
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
