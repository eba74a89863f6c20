"""Rigid transforms given by users: validation, with the likely cause of a violation."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError, describe

RIGID = 1e-5
"""Maximum absolute entry of R R^T - 1. Rotations in single precision pass; scales do not."""
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
        matrix = np.array(pose, dtype=np.float64)
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


def nearest_rigid(matrix: Float64Array) -> Float64Array:
    """Return the rigid transform (4, 4) with the rotation that is nearest to the given one.

    Source: Arun, Huang and Blostein, *Least-Squares Fitting of Two 3-D Point Sets*, 1987.
    """
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    nearest = np.eye(4)
    nearest[:3, :3], nearest[:3, 3] = u @ vt, matrix[:3, 3]
    return nearest


def points_of(value: Any, place: str) -> Float64Array:
    """Return an argument of the Python API as points (N, 3); one point may be (3,).

    Raises:
        InputError: If it is no array of points.
    """
    try:
        points = np.atleast_2d(np.asarray(value, dtype=np.float64))
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
