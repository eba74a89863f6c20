"""Plausibility of the size of a mesh in metres: wrong units give sizes and masses that no object has."""

from __future__ import annotations

import numpy as np
import trimesh

from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.geometry.mesh import mass_properties

_MIN_OBJECT_SIZE, _MAX_OBJECT_SIZE = 0.001, 5.0
"""Size range of objects [m]; sizes outside of it indicate wrong units."""
_MIN_SIZE, _MAX_SIZE = 1e-5, 1e5
"""Size range of any mesh [m]; 32-bit floats are too coarse outside of it."""
_FLAT = 1e-6
"""Thickness relative to the size below which a mesh encloses no volume."""
_MAX_MASS = 50.0
"""Mass of an object above which its unit of length is probably wrong [kg]."""


def check_size(
    source: str, mesh: trimesh.Trimesh, units: float, kind: str, *, any_size: bool, has_pieces: bool
) -> None:
    """Raise InputError if a mesh in metres is too small or too large, or if an object encloses no volume."""
    size = float(mesh.extents.max())
    if kind == "object" and not any_size:
        _check_object_size(source, size, units)
    if kind == "object" and not has_pieces and _is_flat(mesh):
        raise InputError(
            f"{source}: an object must have a volume (got a flat mesh): give it a thickness, or bake an environment"
        )
    if not _MIN_SIZE <= size <= _MAX_SIZE:
        raise InputError(f"{source}: a mesh must be {_MIN_SIZE:g} to {_MAX_SIZE:g} m across (got {size:.3g} m)")


def _check_object_size(source: str, size: float, metres_per_unit: float) -> None:
    """Refuse objects whose size [m] indicates wrong units."""
    if _MIN_OBJECT_SIZE <= size <= _MAX_OBJECT_SIZE:
        return
    factor = 0.001 if size > _MAX_OBJECT_SIZE else 1000.0
    likely = ""
    if _MIN_OBJECT_SIZE <= size * factor <= _MAX_OBJECT_SIZE:
        units = f"{metres_per_unit * factor:g}"
        unit = {"1": " in metres", "0.01": " in centimetres", "0.001": " in millimetres"}.get(units, "")
        likely = f"--units {units} reads it{unit or f' at {size * factor:.3g} m'}, and "
    raise InputError(
        f"{source}: an object must be {_MIN_OBJECT_SIZE:g} to {_MAX_OBJECT_SIZE:g} m across (got {size:.3g} m at "
        f"{metres_per_unit:g} metres per unit: {likely}--any-size accepts the size)"
    )


def _is_flat(mesh: trimesh.Trimesh) -> bool:
    """Return True if all vertices lie in one plane, within a millionth of the size."""
    offsets = mesh.vertices - mesh.vertices.mean(axis=0)
    _, axes = np.linalg.eigh(offsets.T @ offsets)
    extents = np.ptp(offsets @ axes, axis=0)
    return bool(extents.min() < _FLAT * extents.max())


def mass_warnings(asset: Asset, units: float) -> list[str]:
    """Return a warning if the mass of an object indicates a wrong length of the unit [m], else an empty list."""
    if asset.kind != "object" or asset.mesh is None:
        return []
    mass = mass_properties(asset.mesh, asset.pieces, density=asset.density, mass=asset.mass).mass
    if mass <= _MAX_MASS:
        return []
    return [
        f"the object is {float(asset.mesh.extents.max()):.3g} m long and has {mass:.3g} kg at {asset.density:g} kg/m^3 "
        f"and {units:g} metres per unit: is its unit another one, such as --units 0.001, or is it hollow or lighter "
        "(--density)?"
    ]


def describe_size(mesh: trimesh.Trimesh) -> str:
    """Return the extents of a mesh, such as "60 x 100 x 20 mm"."""
    return " x ".join(f"{1e3 * extent:.4g}" for extent in mesh.extents) + " mm"
