"""Upload of host arrays and meshes to the device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import AnyArray, Float64Array


def wrapped(kind: type, values: AnyArray) -> dr.ArrayBase:
    """Return a device array of type ``kind`` on a copy of ``values`` that starts at a cache line.

    Dr.Jit compiles different kernels for unaligned memory, and the alignment of NumPy's memory is random.
    """
    values = np.ascontiguousarray(values).ravel()
    memory = np.empty(values.nbytes + 64, dtype=np.uint8)
    start = -memory.ctypes.data % 64
    line = memory[start : start + values.nbytes].view(values.dtype)
    line[...] = values
    return kind(line)


def concatenated(parts: Sequence[dr.ArrayBase]) -> dr.ArrayBase:
    """Concatenate device arrays of one type without evaluation.

    ``dr.concat`` writes the start of each part into its kernels, so that other sizes cause a new compilation.
    """
    whole = dr.empty(type(parts[0]), sum(dr.width(part) for part in parts))
    start = 0
    for part in parts:
        if dr.width(part):
            place = dr.arange(mi.UInt32, dr.width(part)) + dr.opaque(mi.UInt32, start)
            dr.scatter(whole, part, place, mode=dr.ReduceMode.Permute)
            start += dr.width(part)
    return whole


def on_device(*numbers: float) -> mi.Float:
    """Return a few numbers in one device array; one copy, and kernels do not contain the values."""
    return wrapped(mi.Float, np.array(numbers, dtype=np.float32))


def opaque_seed(seed: int) -> mi.UInt32:
    """Return a seed as an opaque number, far from the numbers of adjacent seeds, whose pictures share no ray."""
    return dr.opaque(mi.UInt32, seed * 2654435761 % (1 << 32))


def unit_float(bits: mi.UInt32) -> mi.Float:
    """Return the leading 24 bits of integers as numbers in [0, 1)."""
    return mi.Float(bits >> 8) * 2.0**-24


def number(values: mi.Float, place: int) -> mi.Float:
    """Return one of the numbers of :func:`on_device`."""
    return dr.gather(mi.Float, values, place)


Columns = TypeVar("Columns")


def gathered(columns: Columns, index: mi.UInt32) -> Columns:
    """Return the rows ``index`` of a dataclass of device arrays; arrays of one element hold for all rows."""
    values = [getattr(columns, f.name) for f in fields(columns)]  # type: ignore[arg-type]
    return type(columns)(*[v if dr.width(v) == 1 else dr.gather(type(v), v, index) for v in values])


def segments(starts: Float64Array, ends: Float64Array) -> mi.Ray3f:
    """Return rays with unit directions that end at the end points; points [m] have shape (N, 3)."""
    way = ends - starts
    length = np.linalg.norm(way, axis=1)
    ray = dr.zeros(mi.Ray3f, len(way))
    ray.o, ray.d = (
        type(vector)(*(wrapped(mi.Float, column.astype(np.float32)) for column in values.T))
        for vector, values in ((ray.o, starts), (ray.d, way / np.maximum(length, 1e-12)[:, None]))
    )
    ray.maxt = wrapped(mi.Float, length.astype(np.float32))
    return ray


def ray_scene(contents: Mapping[str, mi.Shape], *, watertight: bool = True) -> mi.Scene:
    """Load a Mitsuba scene of ``contents`` (shapes, lights and others) with watertight triangle edges.

    By default Embree misses rays on an edge that two triangles share; OptiX does not. Contents with an id keep it,
    because scripts change their parameters by it. Others get their key as id.
    """
    ids = [(item, item.id()) for item in contents.values() if isinstance(item, mi.Object) and item.id()]
    scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": watertight, **contents}, parallel=False)
    for item, name in ids:
        item.set_id(name)
    return scene


def plain_mesh(mesh: trimesh.Trimesh, properties: mi.Properties | None = None) -> mi.Mesh:
    """Return a Mitsuba shape of a mesh without normals or texture."""
    shape = mi.Mesh("mesh", len(mesh.vertices), len(mesh.faces), props=properties or mi.Properties())
    params = mi.traverse(shape)
    params["vertex_positions"] = wrapped(mi.Float, np.asarray(mesh.vertices, dtype=np.float32))
    params["faces"] = wrapped(mi.UInt32, np.asarray(mesh.faces, dtype=np.uint32))
    params.update()
    return shape
