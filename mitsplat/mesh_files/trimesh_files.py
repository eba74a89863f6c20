"""Meshes of trimesh as parts with materials: scenes in memory, and files that trimesh reads (OBJ, PLY, STL, OFF, DAE).

Colours in files are display-encoded. Factors and vertex colours of glTF, which trimesh also uses in memory, are linear
by its specification (Khronos, *glTF 2.0*, 3.9.2 and 3.7.2.1). A texture without a factor is used unchanged. An MTL
without ``Ks``, ``Pr`` and ``Pm``, or with ``illum`` 0 or 1, is matt.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.visual import ColorVisuals
from trimesh.visual.color import to_rgba
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.geometry.mesh import check_faces
from mitsplat.images.colour import decode_srgb
from mitsplat.mesh_files.face_polygons import has_concave, plain_obj
from mitsplat.mesh_files.file_references import find_reference
from mitsplat.mesh_files.mesh_file import (
    DIELECTRIC_SPECULAR,
    LEAST_ROUGHNESS,
    OPAQUE,
    PAINTED_MATERIAL,
    ROUGHNESS,
    TRANSPARENT_TEXELS,
    UNKNOWN_COLOUR,
    UNKNOWN_MATERIAL,
    Axis,
    FilePart,
    Material,
    MeshFile,
    Texture,
    gloss_texture,
    is_transparent,
    means_of,
    pixels_of,
)
from mitsplat.storage.files import IMAGE_ERRORS

_FULL_SPECULAR = 0.08
"""Reflectance at normal incidence of ``Ks`` 1."""
_TRIMESH_DIFFUSE = (102, 102, 102)
"""Value that trimesh inserts for an absent ``Kd``."""
_MAX_HEADER_BYTES = 1 << 16
"""Maximum size of the header of a PLY file [bytes]."""
_NAMESPACE = "{*}"


def read_with_trimesh(path: Path, *, textures: bool = True) -> MeshFile:
    """Read a file of any format of trimesh.

    Damaged files raise the errors of :data:`mitsplat.storage.files.MESH_ERRORS`.

    Args:
        path: The file.
        textures: False to ignore textures and material files, which need not exist.

    Raises:
        InputError: If a texture or a material file is missing, outside of the folder or damaged.
        MissingResourceError: If the package that reads such files is not installed.
    """
    if textures:
        check_textures(path)
    kind = path.suffix.lower()
    if kind == ".dae" and importlib.util.find_spec("collada") is None:
        raise MissingResourceError(f"{path}: reading it needs `pip install pycollada`")
    file = io.BytesIO(plain_obj(path.read_bytes())) if kind == ".obj" else path
    scene = trimesh.load_scene(file, file_type=kind[1:], resolver=_Resolver(path))
    if any(has_concave(np.asarray(positions), polygons) for positions, polygons in _polygons(path, scene)):
        raise InputError(
            "it has concave polygons, which are read from OBJ files only: export it with triangles instead of polygons"
        )
    parts = scene_parts(scene, path)
    units, up = _read_collada_asset(path) if kind == ".dae" else (None, None)
    warnings = []
    if kind == ".stl" and any(np.any(one.face_attributes.get("stl", 0)) for one in scene.geometry.values()):
        warnings.append("the colours of its faces are not read, because STL files store them in several ways")
    if kind == ".obj" and textures and (names := _values_of(path, "usemtl")) and not _values_of(path, "mtllib"):
        warnings.append(f"it names no material file (mtllib) of its material {names[0]}, which is left out")
    return MeshFile(parts, units, up, tuple(warnings), in_single=kind in (".stl", ".ply"))


def scene_parts(mesh: trimesh.Trimesh | trimesh.Scene, source: object) -> tuple[FilePart, ...]:
    """Return the parts of a mesh or of a scene, in the units and axes of its positions.

    Args:
        mesh: The mesh or scene.
        source: Name of the mesh in messages.

    Raises:
        InputError: If a face refers to a missing vertex, or if a texture is damaged.
    """
    scene = mesh if isinstance(mesh, trimesh.Scene) else trimesh.Scene({"mesh": mesh})
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            check_faces(geometry, source)
            try:
                parts.append(_read_part(str(name), geometry, np.asarray(transform)))
            except InputError as error:
                raise InputError(f"{source}: part {name}: {error}") from error
    return tuple(parts)


def _read_part(name: str, mesh: trimesh.Trimesh, transform: Float64Array) -> FilePart:
    faces, visual = np.asarray(mesh.faces), mesh.visual
    vertices, colours, double_sided = np.asarray(mesh.vertices), None, False
    if isinstance(visual, ColorVisuals):
        material = PAINTED_MATERIAL
        if visual.kind == "vertex":
            colours = visual.vertex_colors[faces]
        elif visual.kind == "face":
            colours = np.repeat(visual.face_colors[:, None], 3, axis=1)
        else:
            material = UNKNOWN_MATERIAL
    else:
        uv = None if visual.uv is None else np.asarray(visual.uv, dtype=np.float64)[faces]
        material = read_material(visual.material, uv)
        double_sided = bool(getattr(visual.material, "doubleSided", False))
        stored = visual.vertex_attributes.get("color")
        if stored is not None and len(stored) == len(vertices):
            colours = to_rgba(np.asarray(stored))[faces]
    linear = None if colours is None else decode_srgb(colours[..., :3] / 255.0)
    return FilePart(name, vertices, faces, transform, material, linear, double_sided)


def read_material(material: Any, uv: Float64Array | None = None) -> Material:
    """Convert a material of trimesh on faces with texture coordinates (F, 3, 2), or None without any."""
    if isinstance(material, SimpleMaterial):
        return _read_mtl(material, uv)
    return _read_pbr(material if isinstance(material, PBRMaterial) else material.to_pbr(), uv)


def _read_pbr(source: PBRMaterial, uv: Float64Array | None) -> Material:
    warnings: list[str] = []
    # trimesh stores linear values as multiples of 1/255.
    factor = np.ones(3) if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255.0
    if source.alphaMode not in (None, "OPAQUE") and (factor[3:] < OPAQUE).any():
        warnings.append("it is transparent, but is baked as opaque")
    if source.emissiveTexture is not None or np.any(source.emissiveFactor):
        warnings.append("it emits light, which is not baked")
    metallic = 0.0 if source.metallicFactor is None else float(source.metallicFactor)
    roughness = ROUGHNESS if source.roughnessFactor is None else float(source.roughnessFactor)
    texture = _texture(source.baseColorTexture, uv)
    if texture is not None and is_transparent(source.baseColorTexture):
        warnings.append(TRANSPARENT_TEXELS)
    gloss = _texture(source.metallicRoughnessTexture, uv)
    if gloss is not None:
        # If this texture exists, absent factors are 1.
        factors = (1.0 if given is None else float(given) for given in (source.metallicFactor, source.roughnessFactor))
        gloss = gloss_texture(gloss, *factors)
        metallic, roughness = means_of(gloss)
    return Material(
        factor[:3],
        texture,
        float(np.clip(metallic, 0.0, 1.0)),
        float(np.clip(roughness, LEAST_ROUGHNESS, 1.0)),
        warnings=tuple(warnings),
        metallic_roughness=gloss,
        normal_map=_texture(source.normalTexture, uv),
    )


def _texture(image: Image.Image | None, uv: Float64Array | None) -> Texture | None:
    return None if image is None or uv is None else Texture(pixels_of(image), uv)


def _read_mtl(source: SimpleMaterial, uv: Float64Array | None) -> Material:
    """Convert an MTL material from the file's own keys, because trimesh inserts dark grey for an absent ``Kd``."""
    keys: Mapping[str, Any] = source.kwargs
    warnings: list[str] = []
    texture = _texture(source.image, uv)
    if source.image is not None and uv is None:
        warnings.append("its texture has no coordinates, and is left out")
    elif source.image is not None and is_transparent(source.image):
        warnings.append(TRANSPARENT_TEXELS)
    diffuse = _numbers(keys, "kd")
    if diffuse is None and not np.array_equal(source.diffuse[:3], _TRIMESH_DIFFUSE):
        diffuse = np.asarray(source.diffuse[:3]) / 255.0
    if diffuse is not None:
        factor = decode_srgb(np.broadcast_to(np.clip(diffuse, 0, 1), 3))
    else:
        factor = np.ones(3) if source.image is not None else np.full(3, UNKNOWN_COLOUR)
    opacity, transparency = _numbers(keys, "d"), _numbers(keys, "tr")
    if (opacity is not None and opacity[-1] < OPAQUE) or (transparency is not None and transparency[0] > 1 - OPAQUE):
        warnings.append("it is transparent, but is baked as opaque")
    emission = _numbers(keys, "ke")
    if "map_ke" in keys or (emission is not None and emission.any()):
        warnings.append("it emits light, which is not baked")
    left_out = sorted({"map_pr", "map_pm", "map_ks", "map_ns", "map_d", "map_bump", "bump", "norm"} & set(keys))
    if left_out:
        warnings.append(f"its {', '.join(left_out)} {'is' if len(left_out) == 1 else 'are'} left out")
    given_roughness, metallic = _numbers(keys, "pr"), _numbers(keys, "pm")
    highlight, illumination = _numbers(keys, "ks"), _numbers(keys, "illum")
    physical = given_roughness is not None or metallic is not None
    specular = 0.0 if highlight is None else _FULL_SPECULAR * min(1.0, float(highlight.mean()))
    if illumination is not None and illumination[0] < 2 and not physical:
        specular = 0.0
    if physical and highlight is None:
        specular = DIELECTRIC_SPECULAR
    roughness = ROUGHNESS
    if given_roughness is not None:
        roughness = float(given_roughness[0])
    elif (exponent := _numbers(keys, "ns")) is not None:
        # Phong's exponent, converted to the slope variance of a microfacet surface (Walter et al. 2007).
        roughness = (2.0 / (max(0.0, float(exponent[0])) + 2.0)) ** 0.25
    metal = 0.0 if metallic is None else float(np.clip(metallic[0], 0.0, 1.0))
    shiny = specular > 0 or metal > 0
    return Material(
        factor,
        texture,
        metal,
        float(np.clip(roughness, LEAST_ROUGHNESS, 1.0)) if shiny else 1.0,
        specular,
        shiny,
        tuple(warnings),
    )


def _numbers(keys: Mapping[str, Any], name: str) -> Float64Array | None:
    """Return the numbers of an MTL key, or None if it is absent or damaged."""
    try:
        found = np.atleast_1d(np.asarray(keys[name], dtype=np.float64))
    except (KeyError, ValueError):
        return None
    return found if len(found) and np.isfinite(found).all() else None


class _Resolver(FilePathResolver):  # type: ignore[misc]
    """Files that a mesh names, by the rules of :func:`find_reference`. Textures are relative to their material file."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._source, self._mesh = path, path

    def get(self, name: str) -> bytes:
        """Return the content of a file."""
        found = find_reference(self._source, name, "file", folder=self._mesh.parent)
        if found.suffix.lower() == ".mtl":
            self._source = found
        return found.read_bytes()


def _polygons(path: Path, scene: trimesh.Scene) -> Iterator[tuple[Any, Any]]:
    """Yield the positions and the vertices of the polygons of a file, in formats whose polygons trimesh splits."""
    kind = path.suffix.lower()
    if kind == ".ply":
        for mesh in scene.geometry.values():
            raw = mesh.metadata.get("_ply_raw", {})
            vertex, face = (raw.get(name, {}).get("data") for name in ("vertex", "face"))
            names = face if isinstance(face, dict) else getattr(getattr(face, "dtype", None), "names", None) or ()
            for name in {"vertex_index", "vertex_indices"} & set(names):
                polygons = face[name] if isinstance(face, dict) else face[name]["f1"]
                yield np.column_stack([np.ravel(vertex[axis]) for axis in "xyz"]).astype(np.float64), polygons
    elif kind == ".off":
        text = re.sub(r"#.*", "", path.read_text(errors="replace")).split(None, 1)[1]
        rows = [line.split() for line in text.splitlines() if line.strip()]
        count, number = map(int, rows[0][:2])
        faces = [row[1 : int(row[0]) + 1] for row in rows[count + 1 : count + number + 1]]
        yield np.array([row[:3] for row in rows[1 : count + 1]], dtype=np.float64), [[*map(int, f)] for f in faces]
    elif kind == ".dae":
        import collada  # optional

        for geometry in collada.Collada(str(path), ignore=[collada.DaeError]).geometries:
            for one in geometry.primitives:
                if isinstance(one, collada.polylist.Polylist):  # its subclasses have other polygons
                    starts, ends = one.polystarts, one.polyends
                    yield one.vertex, [one.vertex_index[a:b] for a, b in zip(starts, ends, strict=True)]


def _read_collada_asset(path: Path) -> tuple[float | None, Axis | None]:
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


def check_textures(mesh: Path) -> None:
    """Refuse a mesh whose material file, materials or textures are missing, because it would be baked in grey.

    Raises:
        InputError: If a file that an OBJ, its MTL or a PLY names is missing, outside of its folder, or no image.
    """
    kind = mesh.suffix.lower()
    if kind == ".obj":
        _check_obj(mesh)
    elif kind == ".ply":
        with mesh.open("rb") as file:
            header = file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0].decode("utf-8", errors="replace")
        for texture in re.findall(r"^comment TextureFile (.+?)\s*$", header, re.MULTILINE):
            _check_texture(mesh, texture, mesh.parent)


def _check_obj(mesh: Path) -> None:
    libraries = list(dict.fromkeys(_values_of(mesh, "mtllib")))
    if len(libraries) > 1:
        raise InputError(f"{mesh}: must have one material file (got {', '.join(libraries)}): join them")
    known: list[str] = []
    for library in libraries:
        words = library.split()
        if len(words) > 1 and all((mesh.parent / word).is_file() for word in words):
            raise InputError(f"{mesh}: must have one material file (got {library})")
        path = find_reference(mesh, library, "material file")
        known += _values_of(path, "newmtl")
        for texture in _values_of(path, "map_kd"):
            if texture.startswith("-"):
                raise InputError(f"{path}: options of a texture are not supported: remove them (got map_Kd {texture})")
            _check_texture(path, texture, mesh.parent)
    missing = sorted(set(_values_of(mesh, "usemtl")) - set(known)) if libraries else []
    if missing:
        raise InputError(
            f"{mesh}: its material {missing[0]} is not in {', '.join(libraries)}: add it, or give a colour"
        )


def _check_texture(path: Path, texture: str, folder: Path) -> None:
    found = find_reference(path, texture, "texture", folder=folder)
    try:
        with Image.open(found) as image:
            image.load()
    except IMAGE_ERRORS as error:
        raise InputError(
            f"{path}: its texture {texture} cannot be read ({error}); put it there, or give a colour"
        ) from None


def _values_of(path: Path, key: str) -> list[str]:
    """Return the values of all lines of an OBJ or an MTL that begin with a key."""
    names = []
    for line in path.read_bytes().splitlines():
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0].lower() == key.encode():
            try:
                names.append(words[1].strip().decode("utf-8"))
            except UnicodeDecodeError:
                name = words[1].strip().decode("cp1252", errors="replace")
                raise InputError(f"{path}: names must be UTF-8: save it so, or rename it (got {key} {name})") from None
    return names
