"""Validation of poses that the caller provides: names of assets, and rigid transforms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError

_RIGID = 1e-5
"""Maximum absolute entry of R R^T - 1 in a pose, as for cameras. Rotations in single precision pass; scales do not."""


def asset_index(name: str | int, names: Sequence[tuple[str, str]]) -> int:
    """Return the index of the asset with a name or number.

    Args:
        name: Name, path or index of the asset.
        names: Name and path of each asset.

    Raises:
        InputError: If no asset or several assets match.
    """
    if isinstance(name, str):
        found = [position for position, called in enumerate(names) if name in called]
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(
                f"poses[{name!r}]: must name one asset (it names {len(found)} of scene.assets: use one of the indices "
                f"{', '.join(map(str, found))})"
            )
    elif 0 <= name < len(names):
        return int(name)
    known = ", ".join(sorted({asset for asset, _ in names})) or "none"
    raise InputError(f"poses[{name!r}]: must be an asset of the scene ({known}) or its index in scene.assets")


def rigid_pose(pose: npt.ArrayLike, place: str) -> Float64Array:
    """Return a pose as a matrix (4, 4).

    Raises:
        InputError: If the pose is not a rotation and a translation. The message begins with ``place``.
    """
    try:
        matrix = np.array(pose, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{place}: must be a finite 4x4 matrix world_from_object (got {_describe(pose)})")
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > _RIGID:
        raise InputError(f"{place}: must have the last row 0, 0, 0, 1 (got {matrix[3].tolist()}); is it transposed?")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        lengths = ", ".join(f"{length:.6g}" for length in np.linalg.norm(rotation, axis=0))
        mirrored = " of a left-handed frame" if np.linalg.det(rotation) < 0 else ""
        raise InputError(
            f"{place}: must be a rotation and a translation, without scale or mirror (got axes{mirrored} of lengths "
            f"{lengths})"
        )
    return matrix


def _describe(pose: npt.ArrayLike) -> str:
    """Describe a value that is not a valid matrix, for an error message."""
    if isinstance(pose, np.ndarray) and pose.shape != (4, 4):
        return f"an array of shape {pose.shape}"
    text = repr(pose)
    return text if len(text) <= 60 else f"{text[:57]}..."
