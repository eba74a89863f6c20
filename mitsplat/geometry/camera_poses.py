"""Camera poses and view directions: facing a point, on a path between poses, and spread over the sphere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.rigid import homogeneous_matrix, points_of


def direction(azimuth: float, sine: float) -> Float64Array:
    """Return the unit vector (3,) at an azimuth [rad] and a sine of the elevation.

    The azimuth is 0 along +x and counter-clockwise seen from above. Uniform azimuths and sines give directions that are
    uniform by area on the sphere (Archimedes).
    """
    cosine = np.sqrt(1.0 - sine * sine)
    return np.array([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine])


def spiral(sines: Float64Array, turn: float = 0.0) -> Float64Array:
    """Return unit vectors (N, 3) at sines of the elevation (N,) and azimuths in steps of the golden angle.

    The first azimuth is ``turn`` [rad]. Evenly spaced sines give evenly distributed directions (Fibonacci lattice).
    """
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(len(sines)) + turn
    cosine = np.sqrt(1.0 - sines**2)
    return np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sines], axis=1)


def look_at_pose(eye: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> Float64Array:
    """Return ``world_from_camera`` (4, 4) of an OpenCV camera at ``eye`` [m] that faces ``target`` [m].

    If the view is parallel to ``up``, the upper edge of the image points along +y of the world, or +z if the view is
    parallel to y.

    Raises:
        ValueError: If a point is not finite, or if both points are equal.
    """
    start, end, upper = (_point(value, name) for value, name in ((eye, "eye"), (target, "target"), (up, "up")))
    if not (np.isfinite(upper).all() and upper.any()):
        raise ValueError(f"up must be finite and not zero (got {upper.tolist()})")
    forward = end - start
    distance = np.linalg.norm(forward)
    if not np.isfinite(distance):
        raise ValueError(
            f"the position and target of a camera must be finite (got {start.tolist()} and {end.tolist()})"
        )
    if not distance > 0:
        raise ValueError(f"a camera must look at a point other than its own position (got {start.tolist()} twice)")
    forward = forward / distance
    right = _cross(forward, upper)
    if np.linalg.norm(right) <= 1e-6 * float(np.linalg.norm(upper)):
        right = _cross(forward, np.eye(3)[1 if abs(forward[1]) < 0.9 else 2])
    right /= np.linalg.norm(right)
    return homogeneous_matrix(np.stack([right, _cross(forward, right), forward], axis=1), start)


def _point(value: npt.ArrayLike, place: str) -> Float64Array:
    """Return an argument of the Python API as one point (3,)."""
    points = points_of(value, place)
    if len(points) != 1:
        raise InputError(f"{place} must be one point (got {len(points)} points)")
    point: Float64Array = points[0]
    return point


def _cross(a: Float64Array, b: Float64Array) -> Float64Array:
    """Return the cross product of two vectors (3,); ``np.cross`` takes ten times as long."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def interpolate_poses(key_poses: Sequence[npt.ArrayLike], times: npt.ArrayLike) -> Float64Array:
    """Return poses (M, 4, 4) on a smooth path through ``key_poses`` (K, 4, 4) at ``times`` (M,) in [0, 1].

    Positions follow a natural cubic spline, orientations a rotation spline (SciPy). Keys are evenly spaced in time.
    """
    keys = np.asarray(key_poses, dtype=np.float64).reshape(-1, 4, 4)
    times = np.clip(np.atleast_1d(np.asarray(times, dtype=np.float64)), 0.0, 1.0)
    poses = np.broadcast_to(np.eye(4), (len(times), 4, 4)).copy()
    if len(keys) == 1:
        poses[:] = keys[0]
        return poses
    knots = np.linspace(0.0, 1.0, len(keys))
    poses[:, :3, 3] = CubicSpline(knots, keys[:, :3, 3], bc_type="natural")(times)
    poses[:, :3, :3] = RotationSpline(knots, Rotation.from_matrix(keys[:, :3, :3]))(times).as_matrix()
    return poses
