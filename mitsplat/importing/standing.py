"""Stability of an object in its pose, and a flat base for one that lacks it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
import trimesh

from mitsplat.errors import InputError

_MAX_TILT = 4.0
"""Tilt that an object must withstand without falling over [degrees]."""
_CONTACT_HEIGHT = 0.01
"""Maximum height of vertices that touch the table, as a fraction of the longest extent."""
_MAX_BASE_CUT = 0.06
"""Maximum height that is cut off an object for a flat base, as a fraction of its height."""


def cut_base(path: Path, mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, float]:
    """Cut off the lowest part of a solid, as little as possible, so that it stands; return the height too."""
    (low, *_), high = mesh.bounds[:, 2], mesh.bounds[1] + mesh.scale
    for height in low + _MAX_BASE_CUT * np.linspace(0, 1, 11)[1:] * float(mesh.extents[2]):
        corner = np.append(mesh.bounds[0, :2] - mesh.scale, height)
        above = trimesh.creation.box(bounds=[corner, high])
        cut = trimesh.boolean.intersection([mesh, above], engine="manifold")
        if len(cut.faces) and not topples(cut, contact=0.2 * _CONTACT_HEIGHT):
            return cut, float(height)
    raise InputError(f"{path}: has no base to stand on: give --up, or leave out --flat-base")


def topples(mesh: trimesh.Trimesh, contact: float = _CONTACT_HEIGHT) -> bool:
    """Return True if an object in its pose falls over or rolls away when it is tilted by :data:`_MAX_TILT`."""
    low = float(mesh.bounds[0, 2])
    middle = mesh.center_mass if mesh.is_watertight else mesh.centroid
    touching = mesh.vertices[mesh.vertices[:, 2] <= low + contact * float(mesh.extents.max()), :2]
    ground = shapely.MultiPoint(touching).convex_hull
    reach = np.tan(np.radians(_MAX_TILT)) * (float(middle[2]) - low)
    return not ground.contains(shapely.Point(middle[:2]).buffer(reach))
