"""Scale and gravity of a reconstruction: from printed targets, a known distance, the table's plane, or the cameras."""

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
from mitsplat.geometry.triangulation import meeting_point, triangulate
from mitsplat.images.picture_files import read_picture

DEFAULT_BOARD = Board()
"""What `mitsplat board` prints by default."""

MAX_CONTRADICTION = 0.0025
"""Error up to which a camera sees the board where it is, as a share of its image's longer edge."""

_CERTAINLY_WRONG = 0.01
"""Error from which a camera is wrong, in the same units; between the two it is if it stands out from the others."""

_OUTLYING = 3.0
"""Errors of the median camera from which one stands out."""

PRINT_ERROR = 1e-4
"""Standard error with which a user measures the edge of a printed square or tag [m]."""

_GROUPS = 6
"""Groups of images that are left out in turn to see how much the scale depends on them."""

_Views = dict[int, dict[str, tuple[Camera, Float64Array]]]

_TILT = np.cos(np.radians(30))
"""A plane that leans more against the vertical that the cameras suggest is no table."""


@dataclass(frozen=True, eq=False)
class MetricFrame:
    """Where a reconstruction is put.

    Attributes:
        matrix: ``asset_from_model``, a similarity, shape (4, 4); z up, z = 0 the table where one is known.
        units: Whether the result is in metres.
        up: Whether z is vertical, as far as a target or the table is level.
        table: Whether z = 0 is a plane that things stand on.
        source: What decided, a clause for the user.
        scale_error: Estimated relative standard error of the scale, if metric.
        wrong: Images whose cameras the board contradicts, and by how many pixels.
        confirmed: Images whose cameras see the board where it is.
        board: Pose (4, 4) of the ChArUco board where the reconstruction is put, in metres, if there is one.
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
    """Find scale and gravity by the best evidence there is.

    A ChArUco board decides both; so do AprilTags of known size; then ``scale_from`` the scale and the largest plane
    below the cameras the vertical. A vertical that only the cameras' attitude suggests leaves ``up`` unknown.

    Args:
        model: What structure from motion found.
        images: The images' files, by the model's names.
        board: The board to look for.
        tag: Edge of AprilTags as printed, without their white border [m].
        scale_from: Two places and their distance [m]; see :func:`spot`.
        centred: Whether the origin is below the point that the cameras look at, else in the middle of a board.

    Raises:
        InputError: If ``scale_from`` names places that do not exist, or all cameras are where they look.
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
        wrong, confirmed = _judge_cameras(views, {**dict(enumerate(flat)), **corners})

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
    target = meeting_point(centres, forward)
    if plane is None:
        origin = target
    elif centred or board_pose is None:
        origin = target - (target - point) @ normal * normal
    else:
        origin = point
    distance = float(np.median(np.linalg.norm(centres - target, axis=1)))
    if not distance > 0:
        raise InputError(f"the {len(centres)} cameras must stand apart from the place that they look at (got 0)")
    factor = scale[0] if scale else 1 / distance
    rotation = _upright(normal, forward[0] if board_pose is None else board_pose[:3, 0])
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
    """A place in the model, shape (3,): "photo" is its camera, "photo:x,y" the point that it sees at that pixel.

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
    # The pixel's own ray at the depth of the points around it: they need not lie on the pixel.
    weights = 1 / (gaps[near] + 1)
    depth = float(depths[near] @ weights / weights.sum())
    ray = np.append(camera.ray_slopes([(x, y)])[0], 1.0) * depth
    return np.asarray(camera.world_from_camera[:3, :3] @ ray + camera.centre)


def fit_similarity(source: Float64Array, target: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The similarity (4, 4) that takes points (N, 3) closest to others, and the residuals (N, 3) (Umeyama 1991)."""
    matrix = np.asarray(SimilarityTransform.from_estimate(source, target).params, dtype=np.float64)
    return matrix, source @ matrix[:3, :3].T + matrix[:3, 3] - target


def find_table(model: SparseModel, *, trials: int = 30000, seed: int = 0) -> tuple[Float64Array, Float64Array] | None:
    """Normal towards the cameras and a point of the plane that things stand on, or None.

    RANSAC (Fischler and Bolles 1981) over the points: the plane with the most of them, at least 2 %, that has all but a
    twentieth of the cameras above it, less than a tenth of the points below, and a normal within 30 degrees of the
    vertical that the cameras suggest, if they do.
    """
    points = model.points[_well_seen(model)]
    if len(points) < 50:
        return None
    centres, forward = _rays(model)
    distance = float(np.median(np.linalg.norm(centres - meeting_point(centres, forward), axis=1)))
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
        usable &= normals @ upward >= _TILT
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
    """Up, shape (3,), if photographs from several sides, upright or on their side but held level, suggest it.

    It is the direction to which a side of every image is most nearly orthogonal, and from where the cameras look.
    """
    poses = np.array([camera.world_from_camera[:3, :3] for camera in model.cameras.values()])
    sides = poses[:, :, :2]
    golden = np.arange(1000) + 0.5  # a half sphere, evenly (Fibonacci)
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
    others = tilt[np.abs(directions @ upward) < _TILT]
    if tilt[best] > 0.03 or others.min() < 3 * tilt[best] + 0.01:  # held anyhow, or all from one side
        return None
    return np.asarray(upward * np.sign(np.mean(-poses[:, :, 2] @ upward)))


def _rays(model: SparseModel) -> tuple[Float64Array, Float64Array]:
    """Centres and viewing directions of the cameras, (N, 3) each."""
    poses = np.array([camera.world_from_camera for camera in model.cameras.values()])
    return poses[:, :3, 3], poses[:, :3, 2]


def _well_seen(model: SparseModel) -> npt.NDArray[np.intp]:
    """Indices of points that at least three images observe; all, where nothing is known of that."""
    counts = np.zeros(len(model.points), dtype=np.int64)
    for indices in model.seen.values():
        counts[indices] += 1
    return np.flatnonzero(counts >= 3 if counts.any() else counts == 0)


def _upright(normal: Float64Array, heading: Float64Array) -> Float64Array:
    """Rotation (3, 3) that takes ``normal`` to z and what of ``heading`` is orthogonal to it to x."""
    x = heading - heading @ normal * normal
    if np.linalg.norm(x) < 1e-6:
        x = np.eye(3)[np.abs(normal).argmin()]
        x = x - x @ normal * normal
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def _find_targets(model: SparseModel, images: Mapping[str, Path], board: Board, *, tags: bool) -> tuple[_Views, _Views]:
    """Where images see the board's corners, (2,) by index and image, and AprilTags, (4, 2) by id and image."""
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
    """Relative standard error of a scale: that of the print, and by a jackknife over groups of images (Tukey 1958).

    Corners that lie as they should say little: what bends or stretches a whole model moves them together. So the scale
    is measured without every sixth image in turn, which also brings another mix of cameras.

    Args:
        scale: From all images.
        measure: The scale from some of the images, if they suffice.
        images: Names of all of them.
        edge: What the user measured [m].
    """
    found = [measure(set(images) - set(images[first::_GROUPS])) for first in range(_GROUPS)]
    scales = np.array([value for value in found if value is not None])
    drawn = float(np.sqrt((len(scales) - 1) * scales.var())) / scale if len(scales) > 1 else 0.0
    return float(np.hypot(drawn, PRINT_ERROR / edge))


def _triangulate_corners(views: _Views, names: set[str]) -> dict[int, Float64Array]:
    """Corners (3,) of the board that enough of the named images show, by index."""
    found = {i: triangulate([view for name, view in seen.items() if name in names]) for i, seen in views.items()}
    return {index: point for index, point in found.items() if point is not None}


def _triangulate_tags(views: _Views, names: set[str]) -> dict[int, Float64Array]:
    """Corners (4, 3) in the model of the tags that enough of the named images show, by id."""
    tags = {}
    for number, seen in views.items():
        shown = [view for name, view in seen.items() if name in names]
        points = (triangulate([(camera, quad[corner]) for camera, quad in shown]) for corner in range(4))
        found = [point for point in points if point is not None]
        if len(found) == 4:
            tags[number] = np.array(found)
    return tags


def _judge_cameras(views: _Views, corners: Mapping[int, Float64Array]) -> tuple[dict[str, float], frozenset[str]]:
    """Images that see the board elsewhere than the others do, and by how far [px]; and those that see it there.

    At least six of the corners (3,) must be seen. They are best triangulated: a bent print has them elsewhere than a
    flat one. Cameras that few or repetitive points hold can be far off at small reprojection errors.
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
    outlying = _OUTLYING * float(np.median(list(shares.values())))
    limit = min(max(MAX_CONTRADICTION, outlying), _CERTAINLY_WRONG)
    wrong = {name: share * edges[name] for name, share in shares.items() if share > limit}
    return wrong, frozenset(name for name, share in shares.items() if share <= MAX_CONTRADICTION)


def _fit_board(corners: Mapping[int, Float64Array], board: Board) -> tuple[Float64Array, float] | None:
    """Pose of the board in the model (4, 4), and metres per unit of the model.

    None without enough corners, or where they do not lie as the board's do.
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
    """Normal and a point of the plane that the tags lie on, or None where they lie on several."""
    corners = np.concatenate(list(tags.values()))
    point = corners.mean(axis=0)
    _, spread, axes = np.linalg.svd(corners - point)
    return (axes[2], point) if spread[2] < 0.02 * spread[0] else None
