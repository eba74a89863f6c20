"""Transforms as matrices: checks of those given by users, with the likely cause of a violation, and their use."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitsplat.arguments import describe, real_array
from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError

RIGID = 1e-5
"""Maximum absolute entry of R R^T - 1. Rotations in single precision pass; scales do not."""
SIMILAR = 1e-4
"""Maximum absolute entry of R R^T - 1 of a similarity transform without its scale."""
Z_UP_FROM_Y_UP = np.array([(1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)])
"""Transform (4, 4) from axes with y up, as in glTF, to those with z up."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transform (4, 4) between the axes of cameras in OpenGL and OpenCV, which is its own inverse."""
ROUNDED = 2e-3
"""Maximum absolute entry of R R^T - 1 of a rotation whose entries are rounded to three decimals."""


def rigid_matrix(pose: npt.ArrayLike, frames: str, *, tolerance: float = RIGID) -> Float64Array:
    """Return a pose as a matrix (4, 4).

    Args:
        pose: Values of the matrix.
        frames: Name of the transform for messages, such as ``world_from_object``.
        tolerance: Maximum absolute entry of R R^T - 1.

    Raises:
        ValueError: If the pose is not a rotation and a translation. The message is a rule that begins with "must".
    """
    try:
        matrix = real_array(pose)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"must be a finite 4x4 matrix {frames} (got {_describe(pose)})")
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > RIGID:
        cause = "is it transposed, with the translation in the last row?" if matrix[3, :3].any() else "is it scaled?"
        raise ValueError(f"must have the last row 0, 0, 0, 1 (got {matrix[3].tolist()}); {cause}")
    lengths, mirrored = np.linalg.norm(rotation, axis=0), np.linalg.det(rotation) < 0
    if np.abs(rotation @ rotation.T - np.eye(3)).max() <= tolerance and not mirrored:
        return matrix
    got = f"axes{' of a left-handed frame' if mirrored else ''} of lengths {', '.join(f'{n:.6g}' for n in lengths)}"
    cosines = np.abs((rotation.T @ rotation / np.maximum(np.outer(lengths, lengths), 1e-12))[np.triu_indices(3, 1)])
    if mirrored:
        cause = "is one axis inverted, or are two exchanged?"
    elif cosines.max() <= tolerance:
        cause = "is a scale, such as metres per millimetre, part of the matrix?"
    else:
        got += f" with an angle of {np.degrees(np.arccos(min(1.0, cosines.max()))):.4g} degrees between two of them"
        cause = "are its entries rounded, or rows and columns mixed up?"
    raise ValueError(f"must be a rotation and a translation, without scale or mirror (got {got}); {cause}")


def split_similarity(matrix: npt.ArrayLike) -> tuple[Float64Array, float, Float64Array]:
    """Return rotation (3, 3), uniform scale and translation (3,) of a similarity transform (4, 4).

    The rotation is the nearest to the given one, because matrices are often stored in single precision.

    Raises:
        InputError: If the matrix is not finite, or not a rotation with a uniform scale and a translation.
    """
    try:
        values = real_array(matrix)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (4, 4) or not np.isfinite(values).all():
        raise InputError(f"a transform must be a finite 4x4 matrix (got {_describe(matrix)})")
    if np.abs(values[3] - (0, 0, 0, 1)).max() > RIGID:
        cause = "is it transposed, with the translation there?" if values[3, :3].any() else "is it scaled?"
        raise InputError(f"a transform must have the last row 0 0 0 1 (got {values[3].tolist()}): {cause}")
    linear = values[:3, :3]
    determinant = float(np.linalg.det(linear))
    if determinant <= 0:
        cause = "is one axis inverted, or are two exchanged?" if determinant else "is an axis missing?"
        raise InputError(f"a transform must neither mirror nor flatten (got determinant {determinant:.6g}): {cause}")
    scale = float(np.cbrt(determinant))
    rotation = linear / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > SIMILAR:
        lengths = ", ".join(f"{length:.6g}" for length in np.linalg.norm(linear, axis=0))
        raise InputError(
            f"a transform must scale uniformly and not shear (got axes of lengths {lengths}): was it made by a "
            "rotation about an axis of a length other than 1?"
        )
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt, scale, values[:3, 3]


def homogeneous_matrix(linear: npt.ArrayLike, translation: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Float64Array:
    """Return the affine transform (4, 4) with a linear part (3, 3), such as a rotation, and a translation (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, translation
    return matrix


def scaling(factor: float) -> Float64Array:
    """Return the transform (4, 4) that scales uniformly about the origin."""
    return np.diag([factor, factor, factor, 1.0])


def nearest_rigid(matrix: Float64Array) -> Float64Array:
    """Return the rigid transform (4, 4) with the rotation that is nearest to the given one.

    Source: Arun, Huang and Blostein, *Least-Squares Fitting of Two 3-D Point Sets*, 1987.
    """
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    return homogeneous_matrix(u @ vt, matrix[:3, 3])


def transform_points(matrix: Float64Array, points: npt.NDArray[np.floating]) -> Float64Array:
    """Return points (..., 3) after an affine transform (4, 4)."""
    moved: Float64Array = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def points_of(value: npt.ArrayLike, place: str) -> Float64Array:
    """Return an argument of the Python API as points (N, 3); one point may be (3,).

    Raises:
        InputError: If it is no array of points.
    """
    try:
        points = np.atleast_2d(real_array(value))
    except (TypeError, ValueError):
        raise InputError(f"{place} must be numbers of shape (N, 3) (got {describe(value)})") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{place} must have shape (N, 3) (got {np.shape(value)})")
    return points


def _describe(pose: npt.ArrayLike) -> str:
    """Describe a value that is not a valid matrix, for an error message."""
    if isinstance(pose, np.ndarray) and pose.shape != (4, 4):
        return f"an array of shape {pose.shape}"
    text = " ".join(repr(pose).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
