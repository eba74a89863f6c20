"""Reader of STEP files (ISO 10303-21; AP203, AP214, AP242), whose surfaces OpenCASCADE tessellates.

OpenCASCADE is native code, so that it runs in a process with bounded memory and time. Positions are in millimetres,
whatever the unit of the file is, and z points up by the convention of CAD programs. Colours are matt.
"""

from __future__ import annotations

import importlib.util
import re
import struct
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import BinaryIO

import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.geometry.rigid import scaling
from mitsplat.mesh_files.gltf import read_gltf
from mitsplat.mesh_files.mesh_file import PAINTED_MATERIAL, FilePart, MeshFile
from mitsplat.runtime.child_process import run_bounded
from mitsplat.storage.file_kinds import refuse_other_kinds

STEP_SUFFIXES = (".step", ".stp")
CLOSEST_VIEW = 1000
"""Pixels along the longest extent of an object in the closest view for which the default tolerance is made."""
_MAX_ANGLE = np.radians(20.0)
"""Maximum angle between adjacent facets of a curved surface [rad], less than the crease angle of smooth normals."""
_COARSE = 1e3, 1.0
"""Tolerances [mm, rad] of the tessellation that only measures the size of the parts."""
_SECONDS = 300
_MEMORY, _MEMORY_PER_BYTE = 3 << 30, 200
"""Permitted memory of OpenCASCADE, in total and per byte of the file."""
_MAX_SIZE = 1 << 29
"""Maximum file size [bytes]."""
_SAME = 1e-6
"""Maximum distance between the vertices of equal parts [m]."""
_EXTERNAL = re.compile(rb"DOCUMENT_FILE\s*\(\s*'([^']{0,80})")
"""Entity that names another file, which OpenCASCADE would read from anywhere."""
_EMPTY = "its text is damaged, or it has no surfaces"
_MM = scaling(1000.0)


def read_step(path: Path, *, tolerance: float | None = None, separate: bool = False) -> MeshFile:
    """Read a STEP file; each part of an assembly becomes one part with colours.

    Args:
        path: The file.
        tolerance: Maximum distance of the facets from the surfaces [mm]. By default half a pixel of a view in which
            the longest extent of all parts together has :data:`CLOSEST_VIEW` pixels.
        separate: The parts are seen separately: the longest extent of the smallest part defines the tolerance.

    Raises:
        InputError: If the file cannot be read or has no surfaces.
        MissingResourceError: If OpenCASCADE is not installed.
    """
    refuse_other_kinds(path, "a STEP file (.step, .stp)", *STEP_SUFFIXES)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if tolerance is not None and not 0 < tolerance < np.inf:
        raise InputError(f"{path}: the tolerance must be finite and > 0 mm (got {tolerance:g})")
    if importlib.util.find_spec("cascadio") is None:
        raise MissingResourceError(
            f"{path}: reading STEP needs OpenCASCADE: `pip install 'mitsplat[step]'`, or export the part as .glb"
        )
    size = path.stat().st_size
    if size > _MAX_SIZE:
        raise InputError(f"{path}: must be a STEP file of at most {_MAX_SIZE} bytes (got {size})")
    process = run_bounded(
        *(_tessellate, path.resolve(), "" if tolerance is None else repr(float(tolerance)), "1" if separate else ""),
        imports=["cascadio"],
        memory=_MEMORY + _MEMORY_PER_BYTE * size,
        seconds=_SECONDS,
    )
    if process.status != 0:
        reason = process.reason
        if (process.status or 0) <= 0:
            reason = f"its reader {reason}; a larger tolerance takes less time and memory"
        raise InputError(f"{path}: not a STEP file that can be read ({reason})")
    (used,) = struct.unpack_from("<d", process.output)
    return replace(_read_parts(path, process.output[8:]), tolerance=used)


def separate_parts(file: MeshFile) -> dict[str, tuple[MeshFile, int]]:
    """Return the different parts of a file in their own frames, with the numbers of equal parts.

    Parts are equal if they have the same shape and colours. Their names are file names.
    """
    groups: list[list[FilePart]] = []
    for part in file.parts:
        group = next((group for group in groups if _is_equal(group[0], part)), None)
        if group is None:
            groups.append([part])
        else:
            group.append(part)
    parts: dict[str, tuple[MeshFile, int]] = {}
    for first, *others in groups:
        name = plain = re.sub(r"[^\w.-]+", "_", first.name).strip("._") or "part"
        number = 1
        while name.casefold() in {other.casefold() for other in parts}:
            number += 1
            name = f"{plain}_{number}"
        parts[name] = replace(file, parts=(replace(first, transform=_MM),)), 1 + len(others)
    return parts


def _is_equal(a: FilePart, b: FilePart) -> bool:
    if not np.array_equal(a.faces, b.faces) or a.vertices.shape != b.vertices.shape:
        return False
    colours = a.colours is b.colours if a.colours is None or b.colours is None else np.allclose(a.colours, b.colours)
    return colours and np.allclose(a.vertices, b.vertices, rtol=0, atol=_SAME)


def _tessellate(output: BinaryIO, _: bytes, path: str, given: str, separate: str) -> None:
    """Write the tolerance [mm] as eight bytes, and the file as binary glTF in metres."""
    import cascadio  # optional

    data = Path(path).read_bytes()
    if b"DOCUMENT_FILE" in data:
        named = _EXTERNAL.search(data)
        name = named[1].decode("utf-8", "replace") if named else "unknown"
        raise InputError(f"it names other files, which are not read (got {name}): export the assembly as one file")

    def convert(tolerance: float, angle: float) -> bytes:
        glb = bytes(cascadio.load(data, "step", tol_linear=tolerance, tol_angular=angle, use_parallel=False))
        if not glb:
            raise InputError(_EMPTY)
        return glb

    if given:
        tolerance = float(given)
    else:
        parts = _read_parts(Path(path), convert(*_COARSE)).parts
        if not parts:
            raise InputError(_EMPTY)
        if separate:
            extent = min(float(np.ptp(part.vertices, axis=0).max()) for part in parts) * _MM[0, 0]
        else:
            placed = np.concatenate([trimesh.transform_points(part.vertices, part.transform) for part in parts])
            extent = float(np.ptp(placed, axis=0).max())
        tolerance = 0.5 * extent / CLOSEST_VIEW
    glb = convert(tolerance, _MAX_ANGLE)
    output.write(struct.pack("<d", tolerance) + glb)


def _read_parts(path: Path, glb: bytes) -> MeshFile:
    """Return the content of a STEP file that was converted to binary glTF; its parts have face colours."""
    primitives = [part for part in read_gltf(path, content=glb).parts if len(part.faces)]
    # The primitives of a part, one per colour, share the object of their transform.
    groups = (list(group) for _, group in groupby(primitives, key=lambda part: id(part.transform)))
    return MeshFile(tuple(_merge(group) for group in groups), 1e-3, in_single=True)


def _merge(primitives: list[FilePart]) -> FilePart:
    """Return the primitives of a part, one per colour, as one part with colours at its face corners."""
    first = primitives[0]
    arrays = [part.vertices for part in primitives], [part.faces for part in primitives]
    vertices, faces = trimesh.util.append_faces(*arrays)
    return FilePart(
        first.name,
        vertices,
        faces,
        _MM @ first.transform,
        PAINTED_MATERIAL,
        np.concatenate([_colours(part) for part in primitives]),
        double_sided=True,
    )


def _colours(part: FilePart) -> Float64Array:
    """Return the colour of a primitive at its face corners; OpenCASCADE writes no material where a colour is absent."""
    return np.tile(part.material.factor, (len(part.faces), 3, 1))
