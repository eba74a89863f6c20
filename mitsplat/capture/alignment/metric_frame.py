"""Scale and vertical direction of a reconstruction.

Targets give both. A known distance gives the scale alone, the table plane or camera attitudes the vertical alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array
from mitsplat.capture.alignment.target_evidence import FrameEvidence, board_evidence, find_targets, tag_evidence
from mitsplat.capture.boards.targets import Board
from mitsplat.capture.capture import parse_pixel
from mitsplat.capture.structure_from_motion import SparseModel
from mitsplat.errors import InputError
from mitsplat.geometry.camera_poses import spiral
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.geometry.triangulation import count_observers, nearest_point_to_lines, optical_axes

DEFAULT_BOARD = Board()
"""Default board of `mitsplat board`."""

_PLANES = 30_000
"""Number of random planes among which the table is searched."""
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
        scale_from: Two points, see :func:`spot`, and their distance [m].
        centred: Put the origin below the point at which the cameras are directed; else in the middle of a board.

    Raises:
        InputError: If ``scale_from`` names points that do not exist, or all cameras coincide with the point at which
            they are directed.
    """
    views, tag_views = find_targets(model, images, board, tags=tag is not None)
    evidence = board_evidence(model, views, board)
    if evidence is None and tag is not None:
        evidence = tag_evidence(model, tag_views, tag)
    if evidence is None:
        evidence = FrameEvidence() if scale_from is None else _distance_evidence(model, scale_from)
    scale, board_pose = evidence.scale, evidence.board
    plane = evidence.plane or find_table(model)
    centres, forward = optical_axes(model.cameras.values())
    target = origin = nearest_point_to_lines(centres, forward)
    if plane is not None:
        normal, point = plane
        if np.median((centres - point) @ normal) < 0:
            normal = -normal
        origin = target - (target - point) @ normal * normal if centred or board_pose is None else point
    else:
        upward = vertical_from_cameras(model)
        normal = np.array([0.0, -1.0, 0.0]) if upward is None else upward
    vertical = "" if evidence.plane else "the table plane" if plane else "the cameras' attitude"
    distance = float(np.median(np.linalg.norm(centres - target, axis=1)))
    if not distance > 0:
        raise InputError(f"the {len(centres)} cameras must not coincide with the point at which they are directed")
    factor = 1 / distance if scale is None else scale
    rotation = _upright_rotation(normal, forward[0] if board_pose is None else board_pose[:3, 0])
    matrix = homogeneous_matrix(factor * rotation, -factor * rotation @ origin)
    if board_pose is not None:
        board_pose = matrix @ board_pose
        board_pose[:3, :3] /= factor
    return MetricFrame(
        matrix=matrix,
        units="unknown" if scale is None else "metre",
        up="unknown" if plane is None else "z",
        table=plane is not None,
        source=", ".join(filter(None, (evidence.source, vertical))),
        scale_error=evidence.scale_error,
        wrong=evidence.wrong,
        confirmed=evidence.confirmed,
        board=board_pose,
    )


def _distance_evidence(model: SparseModel, scale_from: tuple[str, str, float]) -> FrameEvidence:
    """Return the scale by two points and their distance [m].

    Raises:
        InputError: If a point does not exist, the points coincide, or the distance is out of range.
    """
    check_distance(scale_from)
    one, other, metres = scale_from
    gap = float(np.linalg.norm(spot(model, one) - spot(model, other)))
    if not gap > 0:
        raise InputError(f"{one} and {other} must be different points of the model, to state their distance")
    return FrameEvidence(scale=metres / gap, source=f"the distance of {one} and {other}")


def check_distance(scale_from: tuple[str, str, float]) -> None:
    """Check the stated distance [m] of two points.

    Raises:
        InputError: If it is out of range.
    """
    one, other, metres = scale_from
    if not 1e-6 <= metres <= 1e6:
        raise InputError(f"the distance of {one} and {other} must be 1e-6 to 1e6 m (got {metres:g})")


def spot(model: SparseModel, name: str) -> Float64Array:
    """Return a point of the model, shape (3,).

    Args:
        model: Result of structure from motion.
        name: "PHOTO" for the camera centre of a photo; "PHOTO:X,Y" for the surface point at a pixel of a photo.

    Raises:
        InputError: If there is no such photo, or it observes no point near the pixel.
    """
    photo, colon, pixel = name.rpartition(":") if ":" in name else (name, "", "")
    if photo not in model.cameras:
        raise InputError(f"{name}: must name a photo with a camera, such as {min(model.cameras)} (got {photo})")
    camera = model.cameras[photo]
    if not colon:
        return camera.centre
    x, y = parse_pixel(pixel, name)
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
    point: Float64Array = camera.unproject([(x, y)], [depth])[0]
    return point


def find_table(model: SparseModel) -> tuple[Float64Array, Float64Array] | None:
    """Find the plane on which objects stand, by RANSAC (Fischler and Bolles 1981) over the points.

    The plane with the most points is chosen, at least 2 % of them. At least 95 % of the cameras must be above it, and
    less than a tenth of the points below it. If the cameras suggest a vertical, the normal must be within 30 degrees of
    it.

    Returns:
        Normal towards the cameras and a point of the plane, or None.
    """
    points = model.points[_reliable_points(model)]
    if len(points) < 50:
        return None
    centres, forward = optical_axes(model.cameras.values())
    distance = float(np.median(np.linalg.norm(centres - nearest_point_to_lines(centres, forward), axis=1)))
    tolerance = 0.004 * distance
    upward = vertical_from_cameras(model)
    rng = np.random.default_rng(0)
    sample = points[rng.permutation(len(points))[:3000]]
    a, b, c = (sample[indices] for indices in rng.integers(0, len(sample), (3, _PLANES)))
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
    directions = spiral((np.arange(1000) + 0.5) / 1000)  # even samples of a half sphere
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


def _reliable_points(model: SparseModel) -> npt.NDArray[np.intp]:
    """Return the indices of points that at least three images observe, or of all points if observations are unknown."""
    counts = count_observers(model.seen.values(), len(model.points))
    return np.flatnonzero(counts >= 3 if counts.any() else counts == 0)


def _upright_rotation(normal: Float64Array, heading: Float64Array) -> Float64Array:
    """Return the rotation (3, 3) that takes ``normal`` to z and the component of ``heading`` orthogonal to it to x."""
    x = heading - heading @ normal * normal
    if np.linalg.norm(x) < 1e-6:
        x = np.eye(3)[np.abs(normal).argmin()]
        x = x - x @ normal * normal
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])
