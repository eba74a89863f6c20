"""Files of the materials of Gaussians: a binary PLY file with one vertex per Gaussian, in the order of the splat file.

========================================  ============  ================================================
property                                  type          value
========================================  ============  ================================================
``metallic``, ``roughness``, ``specular`` ``uchar``     the parameter times 255
``nx``, ``ny``, ``nz``                    ``float``     unit shading normal; absent if that of the mesh
========================================  ============  ================================================

The parameters are those of :class:`~mitsplat.gaussians.splat_materials.SplatMaterials`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mitsplat.errors import InputError
from mitsplat.gaussians.ply_files import MAX_PLY_HEADER, columns_of, parse_ply_header, vertex_rows
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.storage.files import read_regular, storage_errors, write_bytes

_PARAMETERS = ("metallic", "roughness", "specular")
_NORMAL = ("nx", "ny", "nz")
_MAX_ROW = 64
"""Maximum size of a row, which permits a few additional properties [bytes]."""


def read_materials(path: Path, count: int) -> SplatMaterials:
    """Read the materials of ``count`` Gaussians.

    Raises:
        InputError: If the file is missing or damaged, has another number of rows, lacks a property, or holds an invalid
            value.
    """
    try:
        data = read_regular(path, MAX_PLY_HEADER + _MAX_ROW * count)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{path}: materials of {count} Gaussians {error}") from error
    try:
        return _decode(data, count)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def _decode(data: bytes, count: int) -> SplatMaterials:
    """Decode the materials of ``count`` Gaussians, one vertex each.

    Raises:
        InputError: If the file has another number of vertices, or other properties.
    """
    form, elements, start = parse_ply_header(data)
    rows, row = elements.get("vertex", (0, np.dtype([])))
    if form == "ascii":
        raise InputError("a PLY file of materials must be binary (got ascii)")
    if rows != count:
        raise InputError(f"a PLY file of materials must have one vertex per Gaussian, {count} (got {rows})")
    kinds = {name: row[name].str[1:] for name in row.names or ()}
    for names, kind, word in ((_PARAMETERS, "u1", "uchar"), (_NORMAL, "f4", "float")):
        wrong = [name for name in names if kinds.get(name) != kind]
        if wrong and (names is _PARAMETERS or any(name in kinds for name in names)):
            raise InputError(f"a PLY file of materials must have the {word} vertex properties {', '.join(wrong)}")
    values = vertex_rows(data, form, elements, start)
    normals = columns_of(values, _NORMAL) if "nx" in kinds else None
    metallic, roughness, specular = (columns_of(values, _PARAMETERS) / np.float32(255)).T
    return SplatMaterials(metallic, roughness, specular, normals)


def write_materials(materials: SplatMaterials, path: Path) -> None:
    """Write the materials atomically; parameters are rounded to multiples of 1/255.

    Raises:
        InputError: If the file cannot be written.
        MissingResourceError: If the disk is full.
    """
    names = _PARAMETERS if materials.normals is None else (*_PARAMETERS, *_NORMAL)
    rows = np.empty(len(materials), [(name, "u1" if name in _PARAMETERS else "<f4") for name in names])
    for name in _PARAMETERS:
        rows[name] = np.rint(255 * getattr(materials, name))
    if materials.normals is not None:
        for axis, name in enumerate(_NORMAL):
            rows[name] = materials.normals[:, axis]
    properties = "".join(f"property {'uchar' if name in _PARAMETERS else 'float'} {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(materials)}\n{properties}end_header\n"
    with storage_errors(path.parent):
        write_bytes(path, header.encode() + rows.tobytes())
