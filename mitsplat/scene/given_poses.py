"""Validation of poses that the caller provides: names of assets, and rigid transforms."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

import numpy.typing as npt

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.rigid import rigid_matrix


def asset_index(name: str | int, names: Sequence[tuple[str, str]], place: str) -> int:
    """Return the index of the asset with a name or number.

    Args:
        name: Name, path or index of the asset.
        names: Name and path of each asset.
        place: Place of the name for messages.

    Raises:
        InputError: If no asset or several assets match.
    """
    if isinstance(name, str):
        found = [position for position, called in enumerate(names) if name in called]
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(
                f"{place}: must name one asset (it names {len(found)} of scene.assets: use one of the indices "
                f"{', '.join(map(str, found))})"
            )
    elif isinstance(name, Integral) and 0 <= name < len(names):
        return int(name)
    known = ", ".join(sorted({asset for asset, _ in names})) or "none"
    raise InputError(f"{place}: must be an asset of the scene ({known}) or its index in scene.assets")


def rigid_pose(pose: npt.ArrayLike, place: str) -> Float64Array:
    """Return a pose as a matrix (4, 4).

    Raises:
        InputError: If the pose is not a rotation and a translation. The message begins with ``place``.
    """
    try:
        return rigid_matrix(pose, "world_from_object")
    except ValueError as error:
        raise InputError(f"{place}: {error}") from None
