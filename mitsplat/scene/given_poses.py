"""Poses that other programs give, by asset: rigid transforms, or one sentence on what is wrong with them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError

_RIGID = 1e-5
"""Largest entry of R R^T - 1 in a pose, as of cameras: single precision is rigid, any scale is not."""


def asset_named(name: str | int, names: Sequence[tuple[str, str]]) -> int:
    """Position of the one asset that a name or number means, of assets with a name and a path each."""
    if isinstance(name, str):
        found = [position for position, called in enumerate(names) if name in called]
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(
                f"poses[{name!r}]: must name one asset (it names {len(found)} of scene.assets: give one of the numbers "
                f"{', '.join(map(str, found))})"
            )
    elif 0 <= name < len(names):
        return int(name)
    known = ", ".join(sorted({asset for asset, _ in names})) or "none"
    raise InputError(f"poses[{name!r}]: must be an asset of the scene ({known}) or its position in scene.assets")


def rigid_pose(pose: npt.ArrayLike, place: str) -> Float64Array:
    """A pose as (4, 4), refused unless it is a rotation and a translation."""
    try:
        matrix = np.array(pose, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{place}: must be a finite 4x4 matrix world_from_object (got {_told(pose)})")
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


def _told(pose: npt.ArrayLike) -> str:
    """What was given in place of a matrix."""
    if isinstance(pose, np.ndarray) and pose.shape != (4, 4):
        return f"an array of shape {pose.shape}"
    text = repr(pose)
    return text if len(text) <= 60 else f"{text[:57]}..."
