"""COLLADA files: unit and up axis, and checks of what trimesh leaves out without a word (Khronos, *COLLADA* 1.4)."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from mitsplat.errors import InputError
from mitsplat.mesh_files.mesh_file import OPAQUE, Axis, Material, phong_gloss
from mitsplat.mesh_files.obj_files import check_texture

if TYPE_CHECKING:
    import collada
    from collada.material import Effect
    from collada.primitive import Primitive
    from collada.scene import MaterialNode, SceneNode

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


def check_collada(path: Path, document: collada.Collada) -> None:
    """Refuse a COLLADA file with data that trimesh leaves out.

    Raises:
        InputError: If it has controllers, a mesh in a frame that trimesh gets wrong, or a texture that is missing, has
            other than the first coordinates, or is not repeated.
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
    for material, primitive in _bindings(document.scene.nodes):
        if material is not None and _texture_of(material.target) is not None:
            _check_coordinates(material, primitive)


def _bindings(nodes: Iterable[SceneNode]) -> Iterator[tuple[MaterialNode | None, Primitive]]:
    """Yield each primitive of nodes of pycollada after its material node, which is None if its symbol is not bound."""
    for node in nodes:
        if (geometry := getattr(node, "geometry", None)) is not None:
            bound = {one.symbol: one for one in node.materials}
            yield from ((bound.get(primitive.material), primitive) for primitive in geometry.primitives)
        yield from _bindings(getattr(node, "children", None) or ())


def _check_coordinates(material: MaterialNode, primitive: Primitive) -> None:
    """Refuse a texture that trimesh puts elsewhere than its material node.

    Raises:
        InputError: If its coordinates are not the first of several, or end at its border.
    """
    diffuse, inputs = material.target.effect.diffuse, primitive.sources.get("TEXCOORD", [])
    sets = [str(one[3] or 0) for one in inputs]
    bound = [str(number or 0) for name, _, number in material.inputs if name == diffuse.texcoord]
    if len(sets) > 1 and bound and bound[0] != sets[0]:
        raise InputError(
            f"a texture has its coordinates in set {bound[0]}, but only the first set of COLLADA files is read: export "
            "it as .glb"
        )
    sampler = diffuse.sampler.xmlnode
    wraps = [sampler.findtext(f".//{_NAMESPACE}wrap_{axis}", "WRAP").strip() for axis in "st"]
    uv = np.concatenate([np.asarray(one[4].data)[:, :2] for one in inputs[:1]] or [np.zeros((1, 2))])
    for wrap, values in zip(wraps, uv.T, strict=True):
        if wrap != "WRAP" and (values.min() < 0 or values.max() > 1):
            raise InputError(
                f"a texture is continued by {wrap} outside of its image, which is not read from COLLADA files: export "
                "it as .glb"
            )


def lost_node(document: collada.Collada) -> str | None:
    """Return the reason why a node of the scene of a ``collada.Collada`` was left out, or None if all were read."""
    return next((str(error.msg) for error in document.errors if _LOST_NODE.match(error.msg)), None)


def collada_effects(document: collada.Collada) -> list[Effect | None]:
    """Return the effect of each group of faces of a ``collada.Collada``, in the order of trimesh; None without one."""
    from collada import polylist, triangleset  # optional

    return [
        None if material is None else material.target.effect
        for material, primitive in _bindings(document.scene.nodes)
        if isinstance(primitive, polylist.Polylist | triangleset.TriangleSet) and primitive.vertex is not None
    ]


def with_gloss(material: Material, effect: Effect) -> Material:
    """Return a material with the highlight of an effect, which trimesh leaves out.

    ``lambert`` and ``constant`` have none. Mirrored surroundings (``reflective``) are left out with a warning.
    """
    specular, roughness, warnings = 0.0, 1.0, list(material.warnings)
    if effect.shadingtype in ("phong", "blinn"):
        highlight = _mean(effect.specular)
        if highlight is None:
            warnings.append("its texture of highlights is left out")
        exponent = None if effect.shininess is None else _mean(effect.shininess)
        specular, roughness = phong_gloss(0.5 if highlight is None else highlight, exponent)
    if (_mean(effect.reflective) or 0.0) * (_mean(effect.reflectivity) or 0.0) > 0:
        warnings.append("it mirrors its surroundings (reflectivity), which is left out")
    shiny = specular > 0
    return replace(
        material, specular=specular, shiny=shiny, roughness=roughness if shiny else 1.0, warnings=tuple(warnings)
    )


def _mean(value: object) -> float | None:
    """Return the mean of a colour without its opacity, or a number; 0 if it is absent and None if it is a texture."""
    if value is None:
        return 0.0
    try:
        return float(np.atleast_1d(np.asarray(value, dtype=np.float64))[:3].mean())
    except (TypeError, ValueError):
        return None


def collada_warnings(document: collada.Collada) -> Iterator[str]:
    """Yield a warning about each kind of data of a COLLADA file that is not read, for its ``collada.Collada``."""
    if any("COLOR" in one.sources and one.sources["COLOR"] for mesh in document.geometries for one in mesh.primitives):
        yield "the colours of its vertices are left out"
    if any(_opacity(material.effect) < OPAQUE for material in document.materials):
        yield "some of its materials are transparent, but are baked as opaque"
    unbound = {primitive.material for material, primitive in _bindings(document.scene.nodes) if material is None}
    for symbol in sorted(str(one) for one in unbound - {None}):
        yield f"its material symbol {symbol} has no material (instance_material): grey is used"


def _texture_of(material: collada.material.Material) -> str | None:
    """Return the image that a material names as its diffuse colour, or None."""
    try:
        return str(material.effect.diffuse.sampler.surface.image.path)
    except AttributeError:
        return None


def _opacity(effect: Effect) -> float:
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
