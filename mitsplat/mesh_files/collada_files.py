"""COLLADA files: unit and up axis, and checks of what trimesh leaves out without a word (Khronos, *COLLADA* 1.4)."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from mitsplat.errors import InputError
from mitsplat.mesh_files.mesh_file import OPAQUE, Axis
from mitsplat.mesh_files.obj_files import check_texture

_NAMESPACE = "{*}"
_LOST_NODE = re.compile(
    r"(Geometry|Node|Material|Controller) .* not found|Invalid url in (node|geometry)|Incorrect target id in material"
    r"|.*(translate|rotate|scale|matrix) (transform|node)|(Translate|Rotate|Scale) node"
)
"""Errors of pycollada after which it leaves out a node of the scene with its geometry."""
_NOT_FINITE = re.compile("nan|inf", re.I)


def read_collada_asset(path: Path) -> tuple[float | None, Axis | None]:
    """Return the unit [m] and the up axis of a COLLADA file; its specification defines 1 m and y if they are absent."""
    units, up = 1.0, "Y_UP"
    with path.open("rb") as file:
        parents = 0
        for event, element in ElementTree.iterparse(file, events=("start", "end")):
            kind = element.tag.rpartition("}")[2]
            parents += 1 if event == "start" else -1
            if event == "end" and kind == "asset" and parents == 1:
                unit, axis = element.find(f"{_NAMESPACE}unit"), element.find(f"{_NAMESPACE}up_axis")
                units = units if unit is None else _length(unit.get("meter", "1"))
                up = up if axis is None else (axis.text or "").strip()
                break
    if up not in ("X_UP", "Y_UP", "Z_UP"):
        raise ValueError(f"up_axis must be X_UP, Y_UP or Z_UP (got {up})")
    axes: dict[str, Axis] = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}
    return units, axes[up]


def _length(text: str) -> float:
    """Return a length [m].

    Raises:
        ValueError: If it is not a number above 0.
    """
    with contextlib.suppress(ValueError):
        if 0 < (length := float(text)) < np.inf:
            return length
    raise ValueError(f"meter of its unit must be a number above 0 (got {text})")


def plain_name(uri: str) -> str:
    """Return the file name of a URI: without percent codes and without ``file://``."""
    name = unquote(uri.removeprefix("file://"))
    return name[1:] if name[2:3] == ":" else name  # file:///C:/a.png


def check_collada(path: Path, document: Any) -> None:
    """Refuse a COLLADA file with data that trimesh leaves out.

    Args:
        path: The file.
        document: The ``collada.Collada`` of the file.

    Raises:
        InputError: If it has controllers, a mesh in a frame that trimesh gets wrong, or a texture that is missing.
    """
    root = document.xmlnode.getroot()
    if any(_NOT_FINITE.search(array.text or "") for array in root.iterfind(f".//{_NAMESPACE}float_array")):
        raise InputError("its numbers must be finite (got nan or inf)")
    if root.find(f".//{_NAMESPACE}instance_controller") is not None:
        raise InputError("it has skins or morph targets (controllers), which are not supported: export it without them")
    for kind in ("lookat", "skew"):
        for node in root.iterfind(f".//{_NAMESPACE}node[{_NAMESPACE}{kind}]"):
            if node.find(f".//{_NAMESPACE}instance_geometry") is not None:
                raise InputError(f"it has a mesh placed by <{kind}>, which is not supported: export matrices instead")
    for material in document.materials:
        if (texture := _texture_of(material)) is not None:
            check_texture(path, plain_name(texture), path.parent)


def lost_node(document: Any) -> str | None:
    """Return the reason why a node of the scene of a ``collada.Collada`` was left out, or None if all were read."""
    return next((str(error.msg) for error in document.errors if _LOST_NODE.match(error.msg)), None)


def collada_warnings(document: Any) -> Iterator[str]:
    """Yield a warning about each kind of data of a COLLADA file that is not read, for its ``collada.Collada``."""
    if any("COLOR" in one.sources and one.sources["COLOR"] for mesh in document.geometries for one in mesh.primitives):
        yield "the colours of its vertices are left out"
    if any(_opacity(material.effect) < OPAQUE for material in document.materials):
        yield "some of its materials are transparent, but are baked as opaque"


def _texture_of(material: Any) -> str | None:
    """Return the image that a material names as its diffuse colour, or None."""
    try:
        return str(material.effect.diffuse.sampler.surface.image.path)
    except AttributeError:
        return None


def _opacity(effect: Any) -> float:
    """Return the opacity of an effect; 1 if a texture states it."""
    factor, colour = effect.transparency, effect.transparent
    try:
        factor = 1.0 if factor is None else float(factor)
        colour = np.ones(4) if colour is None else np.asarray(colour, dtype=np.float64)
    except TypeError:
        return 1.0
    if "RGB_ZERO" in str(effect.opaque_mode):
        return 1.0 - factor * float(colour[:3].mean()) if effect.transparent is not None else 1.0
    return factor * float(colour[3])
