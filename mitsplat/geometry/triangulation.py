"""Triangulation of points from rays of several cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.optimize import least_squares

from mitsplat.arrays import Float64Array, Int32Array, Int64Array
from mitsplat.geometry.camera import Camera

MAX_ERROR = 3.0
"""Reprojection error above which an observation is an outlier [px]."""


def triangulate(observations: Sequence[tuple[Camera, Float64Array]]) -> Float64Array | None:
    """Return the point (3,) that cameras observe at pixels (2,); None if fewer than three observations agree.

    The search for the minimum robust reprojection error starts at the point nearest to all rays. Observations with
    errors above :data:`MAX_ERROR` are then removed one by one.
    """
    observations = list(observations)
    while len(observations) >= 3:
        cameras = [camera for camera, _ in observations]
        local_rays = np.array([camera.rays([pixel])[0] for camera, pixel in observations])
        rays = np.array([c.world_from_camera[:3, :3] @ ray for c, ray in zip(cameras, local_rays, strict=True)])
        centres = np.array([camera.centre for camera in cameras])
        start = nearest_point_to_lines(centres, rays / np.linalg.norm(rays, axis=1, keepdims=True))
        poses = np.array([camera.camera_from_world for camera in cameras])
        focal = np.array([(camera.fx, camera.fy) for camera in cameras])
        found = poses, focal, local_rays[:, :2]
        point = least_squares(_residuals, start, loss="soft_l1", args=found).x
        errors = np.linalg.norm(_residuals(point, *found).reshape(-1, 2), axis=1)
        if errors.max() <= MAX_ERROR:
            return np.asarray(point)
        del observations[int(errors.argmax())]
    return None


def _residuals(point: Float64Array, poses: Float64Array, focal: Float64Array, slopes: Float64Array) -> Float64Array:
    """Compute the reprojection errors of a point [px], without lens distortion, shape (2 N,).

    Args:
        point: The point, shape (3,).
        poses: Camera-from-world transforms, shape (N, 4, 4).
        focal: Focal lengths [px], shape (N, 2).
        slopes: Slopes of the observed rays, shape (N, 2).
    """
    local = poses[:, :3, :3] @ point + poses[:, :3, 3]
    depth = np.where(np.abs(local[:, 2:]) < 1e-9, 1e-9, local[:, 2:])
    return np.asarray(((local[:, :2] / depth - slopes) * focal).ravel())


def count_observers(seen: Iterable[Int32Array], count: int) -> Int64Array:
    """Return the number of cameras that observe each of ``count`` points, by the indices that each camera sees."""
    counts = np.zeros(count, dtype=np.int64)
    for indices in seen:
        counts[indices] += 1
    return counts


def optical_axes(cameras: Iterable[Camera]) -> tuple[Float64Array, Float64Array]:
    """Return the centres (N, 3) and the viewing directions (N, 3) of cameras."""
    poses = np.array([camera.world_from_camera for camera in cameras])
    return poses[:, :3, 3], poses[:, :3, 2]


def nearest_point_to_lines(
    origins: Float64Array, directions: Float64Array, *, weights: Float64Array | None = None, pull: float = 1e-9
) -> Float64Array:
    """Return the point (3,) nearest to all lines.

    Args:
        origins: Points on the lines, shape (N, 3).
        directions: Unit vectors along the lines, shape (N, 3).
        weights: Weights of the lines, shape (N,); 1 by default.
        pull: Weight of the mean origin, which defines the point nearest to parallel lines.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    if weights is not None:
        across = weights[:, None, None] * across
    normal_matrix = across.sum(axis=0) + pull * np.eye(3)
    right_side = np.einsum("nij,nj->i", across, origins) + pull * np.average(origins, axis=0, weights=weights)
    return np.asarray(np.linalg.solve(normal_matrix, right_side))
