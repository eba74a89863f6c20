"""Reader of 3MF files: objects, components and colours (3MF Consortium, *Core* 1.3 and *Materials and Properties* 1.2).

The positions have the unit that the file states, by default the millimetre, and z points up. Colours are
display-encoded and matt.
"""

from __future__ import annotations

import io
import posixpath
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO
from xml.etree import ElementTree

import numpy as np
from PIL import Image, ImageColor

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.images.colour import decode_srgb
from mitsplat.images.picture_files import describe_fault
from mitsplat.mesh_files.mesh_file import PAINTED_MATERIAL, UNKNOWN_COLOUR, FilePart, MeshFile, Texture, Wrap, pixels_of
from mitsplat.storage.files import IMAGE_ERRORS

_MODEL = "3D/3dmodel.model"
_RELATIONSHIPS = "_rels/.rels"
_MODEL_TYPE = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_READ_EXTENSIONS = {
    "http://schemas.microsoft.com/3dmanufacturing/core/2015/02",
    "http://schemas.microsoft.com/3dmanufacturing/material/2015/02",
    "http://schemas.microsoft.com/3dmanufacturing/production/2015/06",
    "http://schemas.microsoft.com/3dmanufacturing/trianglesets/2021/07",
}
_LEFT_OUT_TYPES = {"support": "supports", "solidsupport": "supports", "other": "objects of type other"}
"""Types of objects that are no parts of the model."""
_LEFT_OUT_KINDS = {
    "beamlattice": "beam lattices",
    "pbmetallicdisplayproperties": "metalness and roughness",
    "pbspeculardisplayproperties": "gloss",
    "translucentdisplayproperties": "translucency",
}
"""Elements that are not read."""
_LEFT_OUT_SHAPES = {"booleanshape", "displacementmesh", "levelset", "alternatives"}
"""Elements of extensions that define the shape of an object."""
_SLICER_VOLUMES = ("metadata/slic3r_pe_model.config", "metadata/slic3r_model.config")
_SLICER_PARTS = "metadata/model_settings.config"
"""Files in which slicers state volumes that are no parts: PrusaSlicer and its forks, Bambu Studio and its forks."""
_NORMAL = ("", "normal_part")
_MODIFIERS = "modifiers and negative volumes of a slicer"
_PAINT = ("mmu_segmentation", "paint_color")
"""Attributes of triangles with colours that slicers paint."""
_UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
_WRAPS: dict[str, Wrap] = {"wrap": "repeat", "mirror": "mirror", "clamp": "clamp", "none": "clamp"}
_MAX_EXPANSION = 100
"""Maximum size of a file in the archive relative to that of the archive."""
_MAX_INSTANCES = 100_000
"""Maximum number of instances that components may multiply to."""
_Key = tuple[str, str]
"""Model file in the archive, and identifier in it."""


@dataclass
class _Object:
    """Object of a model: a mesh, or components of other objects.

    Attributes:
        name: Its name.
        vertices: Positions, shape (V, 3).
        faces: Vertices of each triangle, shape (F, 3).
        groups: Property group of each triangle, or None, F entries.
        indices: Entry of the group at each corner, shape (F, 3).
        left_out: Name of objects that are no part of the model, such as supports, or None.
        components: Objects and their transforms (4, 4).
    """

    name: str
    vertices: Float64Array
    faces: Int64Array
    groups: list[str | None]
    indices: Int64Array
    left_out: str | None
    components: list[tuple[_Key, Float64Array]] = field(default_factory=list)


@dataclass
class _Group:
    """Group of colours, linear, shape (N, 3), or of texture coordinates, shape (N, 2), with the texture's id."""

    values: Float64Array
    texture: str | None = None


def read_3mf(path: Path, *, textures: bool = True) -> MeshFile:
    """Read a ``.3mf`` file.

    Damaged files raise the errors of :data:`mitsplat.storage.files.MESH_ERRORS`.

    Args:
        path: The file.
        textures: False to ignore all textures.

    Raises:
        InputError: If a texture cannot be read, or if the file requires an extension that is not supported.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _Package(archive, textures, _MAX_EXPANSION * path.stat().st_size).read()
    except (zipfile.BadZipFile, ElementTree.ParseError, NotImplementedError) as error:
        raise ValueError(str(error)) from error


class _Package:
    """Archive of a 3MF file."""

    def __init__(self, archive: zipfile.ZipFile, textures: bool, max_size: int) -> None:
        self._archive, self._textures, self._max_size = archive, textures, max_size
        self._files = {name.lstrip("/").lower(): name for name in archive.namelist()}
        self._objects: dict[_Key, _Object] = {}
        self._groups: dict[_Key, _Group] = {}
        self._images: dict[_Key, tuple[str, tuple[Wrap, Wrap]]] = {}
        self._models: set[str] = set()
        self._left_out: set[str] = set()
        self._is_transparent = False
        self._unit = _UNITS["millimeter"]
        self._modifier_faces, self._modifier_parts = self._read_modifiers()

    def read(self) -> MeshFile:
        """Read all objects that the build section names."""
        start = self._start()
        items = list(self._read_model(start))
        parts: list[FilePart] = []
        pending: list[tuple[_Key, Float64Array, tuple[_Key, ...]]] = [(key, pose, ()) for key, pose in reversed(items)]
        for _ in range(_MAX_INSTANCES):
            if not pending:
                break
            key, pose, parents = pending.pop()
            if key in parents:
                raise ValueError(f"object {key[1]} contains itself")
            if key not in self._objects and key[0] not in self._models:
                list(self._read_model(key[0]))
            one = self._objects.get(key)
            if one is None:
                raise ValueError(f"object {key[1]} is missing")
            if one.left_out is not None:
                self._left_out.add(one.left_out)
                continue
            for child, own in reversed(one.components):
                if (key[1], child[1]) in self._modifier_parts:
                    self._left_out.add(_MODIFIERS)
                else:
                    pending.append((child, pose @ own, (*parents, key)))
            parts += self._parts(key[0], one, pose)
        if pending:
            raise ValueError(f"components make more than {_MAX_INSTANCES} objects")
        left_out = " and ".join(sorted(self._left_out))
        if left_out and not parts:
            raise InputError(f"it has only {left_out}, which are not read: export it with meshes of solids")
        warnings = [f"its {left_out} are left out"] if self._left_out else []
        if self._is_transparent:
            warnings.append("some of its colours are transparent, but are baked as opaque")
        return MeshFile(tuple(parts), self._unit, "z", tuple(warnings))

    def _read_modifiers(self) -> tuple[dict[str, list[tuple[int, int]]], set[tuple[str, str]]]:
        """Return what slicers mark as modifiers: first and last faces by object, and pairs of object and component."""
        faces: dict[str, list[tuple[int, int]]] = {}
        for one, volume, metadata in self._slicer_entries(_SLICER_VOLUMES, "volume"):
            if metadata.get("volume_type", "ModelPart") != "ModelPart" or metadata.get("modifier") == "1":
                faces.setdefault(one, []).append((int(volume.attrib["firstid"]), int(volume.attrib["lastid"])))
        entries = self._slicer_entries((_SLICER_PARTS,), "part")
        parts = {(one, part.get("id", "")) for one, part, _ in entries if part.get("subtype", "") not in _NORMAL}
        return faces, parts

    def _slicer_entries(
        self, names: tuple[str, ...], kind: str
    ) -> Iterator[tuple[str, ElementTree.Element, dict[str, str]]]:
        """Yield object, element and metadata of each element of a kind in the settings of a slicer."""
        for name in names:
            if name not in self._files:
                continue
            with self._open(name) as file:
                for one in ElementTree.parse(file).iter("object"):
                    for element in one.iter(kind):
                        metadata = {entry.get("key", ""): entry.get("value", "") for entry in element.iter("metadata")}
                        yield one.get("id", ""), element, metadata

    def _open(self, name: str) -> IO[bytes]:
        """Open a file of the archive; names differ in letter case alone if at all."""
        found = self._files.get(name.lstrip("/").lower())
        if found is None:
            raise ValueError(f"{name} is missing in the archive")
        if self._archive.getinfo(found).file_size > self._max_size:
            raise ValueError(f"{name} expands by a factor of more than {_MAX_EXPANSION}")
        return self._archive.open(found)

    def _start(self) -> str:
        """Return the name of the root model."""
        if _RELATIONSHIPS in self._files:
            with self._open(_RELATIONSHIPS) as file:
                for element in ElementTree.parse(file).iter():
                    if element.get("Type") == _MODEL_TYPE:
                        return element.get("Target", _MODEL).lstrip("/")
        return _MODEL

    def _read_model(self, model: str) -> Iterator[tuple[_Key, Float64Array]]:
        """Read the resources of a model file; return the objects of its build section with their transforms."""
        self._models.add(model)
        with self._open(model) as file:
            root: ElementTree.Element | None = None
            namespaces: dict[str, str] = {}
            for event, element in ElementTree.iterparse(file, events=("start", "end", "start-ns")):
                if event == "start-ns":
                    namespaces[element[0]] = element[1]
                    continue
                kind = _local(element)
                if root is None:
                    root = element
                    self._check_root(model, element, namespaces)
                if event == "start":
                    continue
                number = element.get("id", "")
                if kind in _LEFT_OUT_KINDS:
                    self._left_out.add(_LEFT_OUT_KINDS[kind])
                if kind == "object":
                    self._objects[model, number] = self._object(model, element)
                    element.clear()
                elif kind in ("basematerials", "colorgroup"):
                    name = "displaycolor" if kind == "basematerials" else "color"
                    colours = [child.get(name) for child in element]
                    self._is_transparent |= any(len(c) == 9 and c[7:].lower() != "ff" for c in colours if c is not None)
                    self._groups[model, number] = _Group(_linear(colours))
                elif kind == "texture2dgroup":
                    uv = [(float(child.get("u", 0)), float(child.get("v", 0))) for child in element]
                    self._groups[model, number] = _Group(np.reshape(uv, (-1, 2)), element.get("texid"))
                elif kind == "texture2d":
                    wrap = tuple(_WRAPS[element.get(f"tilestyle{axis}", "wrap")] for axis in "uv")
                    self._images[model, number] = element.get("path", ""), (wrap[0], wrap[1])
                elif kind in ("compositematerials", "multiproperties"):
                    self._groups[model, number] = _Group(np.full((len(element), 3), UNKNOWN_COLOUR))
                    self._left_out.add(f"{kind} of colours")
                elif kind == "item" and element.get("printable") in ("0", "false"):
                    self._left_out.add("items that are not printed")
                elif kind == "item":
                    yield self._reference(model, element), _matrix(element.get("transform"))

    def _check_root(self, model: str, root: ElementTree.Element, namespaces: Mapping[str, str]) -> None:
        """Refuse a file that is no 3MF model, requires unknown extensions, or has an unknown unit."""
        if _local(root) != "model":
            raise ValueError(f"{model} is no 3MF model")
        required = {namespaces.get(prefix, prefix) for prefix in root.get("requiredextensions", "").split()}
        if unknown := sorted(required - _READ_EXTENSIONS):
            raise InputError(
                f"it requires extensions of 3MF that are not supported: export it without {', '.join(unknown)}"
            )
        unit = root.get("unit", "millimeter")
        if unit not in _UNITS:
            raise ValueError(f"unit must be one of {', '.join(_UNITS)} (got {unit})")
        if len(self._models) == 1:
            self._unit = _UNITS[unit]
        elif self._unit != _UNITS[unit]:
            raise ValueError(f"all models of a file must have one unit (got {unit} in {model})")

    def _reference(self, model: str, element: ElementTree.Element) -> _Key:
        """Return the object that an item or a component names; other model files are named by ``p:path``."""
        path = next((value for key, value in element.attrib.items() if key.endswith("}path")), model)
        return path.lstrip("/"), element.attrib["objectid"]

    def _object(self, model: str, element: ElementTree.Element) -> _Object:
        """Read an object of a model file, without the faces that a slicer marks as modifiers."""
        vertices, triangles, components = [], [], []
        for child in element.iter():
            kind = _local(child)
            if kind == "vertex":
                vertices.append((float(child.attrib["x"]), float(child.attrib["y"]), float(child.attrib["z"])))
            elif kind == "triangle":
                triangles.append(child.attrib)
                if any(name.endswith(_PAINT) for name in child.attrib):
                    self._left_out.add("painted colours of a slicer")
            elif kind in _LEFT_OUT_SHAPES:
                self._left_out.add(f"objects of kind {kind}")
            elif kind == "component":
                components.append((self._reference(model, child), _matrix(child.get("transform"))))
        for first, last in sorted(self._modifier_faces.get(element.get("id", ""), []), reverse=True):
            self._left_out.add(_MODIFIERS)
            del triangles[first : last + 1]
        faces = [(int(one["v1"]), int(one["v2"]), int(one["v3"])) for one in triangles]
        group, entry = element.get("pid"), element.get("pindex", "0")
        indices = []
        for one in triangles:
            corner = one.get("p1", entry)
            indices.append((int(corner), int(one.get("p2", corner)), int(one.get("p3", corner))))
        return _Object(
            element.get("name") or f"object_{element.get('id')}",
            np.reshape(vertices, (-1, 3)).astype(np.float64),
            np.reshape(faces, (-1, 3)).astype(np.int64),
            [one.get("pid", group) for one in triangles],
            np.reshape(indices, (-1, 3)).astype(np.int64),
            _LEFT_OUT_TYPES.get(element.get("type", "model")),
            components,
        )

    def _parts(self, model: str, one: _Object, pose: Float64Array) -> Iterator[FilePart]:
        """Yield an object as one part of its colours and one part of each texture."""
        if not len(one.faces):
            return
        if not 0 <= one.faces.min() <= one.faces.max() < len(one.vertices):
            raise ValueError(f"a face has vertices {one.faces.min()} to {one.faces.max()} of {len(one.vertices)}")
        groups = np.array([name or "" for name in one.groups])
        colours, textured = np.full((*one.faces.shape, 3), UNKNOWN_COLOUR), np.zeros(len(groups), dtype=bool)
        for name in np.unique(groups):
            if not name:
                continue
            if (model, str(name)) not in self._groups:
                raise ValueError(f"property group {name} is missing")
            group, rows = self._groups[model, str(name)], groups == name
            indices = one.indices[rows]
            if not 0 <= indices.min() <= indices.max() < len(group.values):
                raise ValueError(f"property group {name} has {len(group.values)} entries (got {indices.max()})")
            if group.texture is None:
                colours[rows] = group.values[indices]
            elif self._textures:
                textured |= rows
                texture = self._texture(model, group.texture, group.values[indices])
                material = replace(PAINTED_MATERIAL, texture=texture)
                yield FilePart(f"{one.name}_{name}", one.vertices, one.faces[rows], pose, material)
        if not textured.all():
            rest = ~textured
            yield FilePart(one.name, one.vertices, one.faces[rest], pose, PAINTED_MATERIAL, colours[rest])

    def _texture(self, model: str, number: str, uv: Float64Array) -> Texture:
        if (model, number) not in self._images:
            raise InputError(f"its texture {number} is missing; give a colour")
        path, wrap = self._images[model, number]
        path = path if path.startswith("/") else posixpath.join(posixpath.dirname(model), path)
        try:
            with self._open(path) as file, Image.open(io.BytesIO(file.read())) as image:
                return Texture(pixels_of(image), uv, wrap)
        except IMAGE_ERRORS as error:
            raise InputError(
                f"its texture {path} cannot be read ({describe_fault(error)}); replace it, or give a colour"
            ) from None


def _local(element: ElementTree.Element) -> str:
    """Return the name of an element without its namespace."""
    return element.tag.rpartition("}")[2]


def _linear(colours: list[str | None]) -> Float64Array:
    """Return linear colours (N, 3) of ``#RRGGBB`` and ``#RRGGBBAA``; grey where none is stated."""
    grey = np.full(3, UNKNOWN_COLOUR)
    return np.reshape(
        [grey if c is None else decode_srgb(np.array(ImageColor.getrgb(c)[:3]) / 255.0) for c in colours], (-1, 3)
    )


def _matrix(text: str | None) -> Float64Array:
    """Return a transform (4, 4) of 12 numbers, which are the rows of a matrix that row vectors are multiplied by."""
    pose = np.eye(4)
    if text is not None:
        pose[:3] = np.array([float(number) for number in text.split()]).reshape(4, 3).T
    return pose
