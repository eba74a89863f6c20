"""Mesh files that trimesh reads (OBJ, PLY, STL, OFF, DAE), with warnings about data that are left out."""

from __future__ import annotations

import importlib.util
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.geometry.mesh_normals import ply_faces
from mitsplat.images.colour import decode_srgb
from mitsplat.mesh_files.collada_files import (
    check_collada,
    collada_effects,
    collada_warnings,
    lost_node,
    plain_name,
    read_collada_asset,
    with_gloss,
)
from mitsplat.mesh_files.face_polygons import Polygon, has_concave, plain_obj, split_polygons
from mitsplat.mesh_files.file_references import find_reference
from mitsplat.mesh_files.mesh_file import MAX_FRACTION, PAINTED_MATERIAL, UNKNOWN_MATERIAL, FilePart, Material, MeshFile
from mitsplat.mesh_files.obj_files import (
    check_obj_materials,
    check_texture,
    face_corners,
    obj_fault,
    obj_warnings,
    plain_text,
    values_of,
    with_all_normals,
)
from mitsplat.mesh_files.trimesh_parts import scene_parts

if TYPE_CHECKING:
    import collada

_MAX_HEADER_BYTES = 1 << 16
"""Maximum size of the header of a PLY file [bytes]."""
_STL_HEADER_BYTES = 80
_STL_FACE_BYTES = 50
_NO_MATERIALS = (UNKNOWN_MATERIAL, PAINTED_MATERIAL)
_COLOUR_NAMES = (("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Names of colours in PLY files that trimesh does not read."""
_MIDDLE = re.compile(rb"(?<=/)[^/\s]+(?=/)")
"""Texture coordinate ``t`` of a corner ``v/t/n`` of an OBJ face."""
_END = re.compile(rb"(?<!/)/[^/\s]*(?!\S)|/+(?!\S)")
"""End ``/t``, ``/`` or ``//`` of a corner without a normal."""
_LENGTH = (
    "its data do not have the length that its header states: it is incomplete, or its faces have different numbers of "
    "corners, which is not read from binary PLY files: export it with triangles"
)


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
    if kind == ".ply":
        _check_elements(_ply_header(path))
    document = _collada_document(path) if kind == ".dae" else None
    try:
        content = _plain_content(path)
        file = path if content is None else io.BytesIO(content)
        scene = trimesh.load_scene(file, file_type=kind[1:], resolver=_Resolver(path), process=False)
    except (ValueError, IndexError) as error:
        if kind == ".ply" and "unexpected length" in str(error):
            raise InputError(_LENGTH) from error
        if kind == ".obj" and (fault := obj_fault(path.read_bytes())):
            raise InputError(fault) from error
        raise
    normals = _stated_normals(scene) if kind in (".obj", ".ply") else None
    for positions, polygons in _polygons(path, scene, document):
        concave = has_concave(np.asarray(positions), polygons)
        if concave and not (kind in (".ply", ".off") and _split_faces(scene, np.asarray(positions), polygons)):
            raise InputError("it has concave polygons, which are not read from such files: export it with triangles")
    parts = scene_parts(scene, path, normals)
    if document is None:
        warnings = tuple(_warnings(path, scene, content, parts, textures))
        return MeshFile(parts, warnings=warnings, in_single=kind in (".stl", ".ply"))
    if textures:
        check_collada(path, document)
    if (lost := lost_node(document)) is not None:
        raise InputError(f"one of its nodes cannot be read ({lost}): export it again with all materials")
    units, up = read_collada_asset(path)
    effects = dict(zip(scene.geometry, collada_effects(document), strict=True))
    parts = tuple(
        part
        if (effect := effects[part.name]) is None or part.material in _NO_MATERIALS
        else replace(part, material=with_gloss(_decoded(part.material), effect))
        for part in parts
    )
    return MeshFile(parts, units, up, tuple(collada_warnings(document)))


def _stated_normals(scene: trimesh.Scene) -> dict[str, Float64Array]:
    """Return the normals (V, 3) at the vertices of meshes whose file states them, by the names of the meshes.

    The loaders of trimesh put them into the cache of a new mesh, which is empty otherwise. Those of PLY files with
    texture coordinates remain in the order of the file there, although trimesh divides and reorders vertices.
    """
    found = {
        name: _textured_ply_normals(mesh)
        if "_ply_raw" in mesh.metadata and mesh.visual.kind == "texture"
        else mesh._cache["vertex_normals"]
        for name, mesh in scene.geometry.items()
        if hasattr(mesh, "faces")
    }
    return {name: np.array(values) for name, values in found.items() if values is not None}


def _textured_ply_normals(mesh: trimesh.Trimesh) -> Float64Array | None:
    """Return the normals (V, 3) of a PLY file at the vertices of a mesh with its triangles, or None without any."""
    elements = mesh.metadata["_ply_raw"]
    vertex = elements["vertex"]["data"]
    if not {"nx", "ny", "nz"} <= set(elements["vertex"]["properties"]):
        return None
    (name,) = {"vertex_index", "vertex_indices"} & set(elements["face"]["properties"])
    rows = np.zeros(len(mesh.vertices), dtype=np.int64)
    rows[mesh.faces] = trimesh.geometry.triangulate_quads(ply_faces(mesh)[name])
    return np.column_stack([np.ravel(vertex[axis]) for axis in ("nx", "ny", "nz")]).astype(np.float64)[rows]


def _decoded(material: Material) -> Material:
    """Return a material of trimesh, which reads display-encoded factors as linear ones, with the linear factor."""
    return replace(material, factor=decode_srgb(material.factor))


def _plain_content(path: Path) -> bytes | None:
    """Return the content of a file in a form that trimesh reads correctly, or None if the file is read."""
    kind = path.suffix.lower()
    if kind == ".stl":
        return _plain_stl(path)
    if kind == ".obj":
        content = plain_obj(plain_text(path.read_bytes()))
        faces = face_corners(content)
        has_coordinates = faces.count(b"/") > 2 * faces.count(b"//")  # not only corners v and v//n
        if re.search(rb"^mtllib ", content, re.M | re.I) or not has_coordinates:
            return with_all_normals(content)
        # trimesh leaves out colours of vertices that have texture coordinates.
        bare = re.sub(rb"^f .*$", lambda face: _END.sub(b"", _MIDDLE.sub(b"", face[0])), content, flags=re.M)
        return with_all_normals(bare)
    if kind == ".ply":
        header = _ply_header(path)
        for names in _COLOUR_NAMES:
            if all(re.search(rf"^property \w+ {name}\s*$", header, re.M) for name in names):
                content = path.read_bytes()
                head, end, data = content.partition(b"end_header")
                for name, plain in zip(names, ("red", "green", "blue"), strict=True):
                    head = re.sub(
                        rb"^(property \w+ )%b(\s*)$" % name.encode(), rb"\1%b\2" % plain.encode(), head, flags=re.M
                    )
                return head + end + data
    return None


def _plain_stl(path: Path) -> bytes | None:
    """Return a binary STL file without bytes after its last face, or None if there are none.

    Raises:
        InputError: If these bytes are further faces.
    """
    content = path.read_bytes()
    number = int.from_bytes(content[_STL_HEADER_BYTES : _STL_HEADER_BYTES + 4], "little")
    end = _STL_HEADER_BYTES + 4 + number * _STL_FACE_BYTES
    if not number or end >= len(content) or b"facet" in content[:1024]:
        return None
    further, rest = divmod(len(content) - end, _STL_FACE_BYTES)
    if not rest and content[end:].strip(b"\0"):
        raise InputError(f"its header states {number} faces, but it has {number + further}: export it again")
    return content[:end]


def _check_text_stl(content: bytes, count: int) -> None:
    """Refuse a text STL file of which ``count`` faces are read, if it has others.

    Raises:
        InputError: If its last solid is incomplete, which trimesh leaves out.
    """
    if b"facet" not in content[:1024].lower():
        return
    stated = len(re.findall(rb"^\s*facet\s", content, re.M | re.I))
    if stated > count:  # a binary file may have the word in its header
        raise InputError(f"only {count} of its {stated} faces can be read (is the file complete?)")


def _ply_header(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0].decode("utf-8", errors="replace")


def _check_elements(header: str) -> None:
    """Refuse a PLY file of splats, of strips of triangles or of points, for its header.

    Raises:
        InputError: If it is one, or if its faces name no vertices.
    """
    names = re.findall(r"^property list \S+ \S+ (\S+)\s*$", header, re.M)
    if re.search(r"^element face [1-9]", header, re.M) and not {"vertex_index", "vertex_indices"} & set(names):
        found = f"got {', '.join(names)}" if names else "got no list"
        raise InputError(f"its faces must have a list vertex_indices ({found}): rename it, or export it again")
    if re.search(r"^element face [1-9]", header, re.M) or not re.search(r"^element", header, re.M):
        return
    if re.search(r"^element chunk |^property float (f_dc_0|rot_0)\s*$", header, re.M):
        raise InputError("it has Gaussian splats and no faces: `mitsplat import` makes an asset of it")
    if re.search(r"^element tristrips [1-9]", header, re.M):
        raise InputError("its faces are strips of triangles (tristrips), which are not read: export it with triangles")
    raise InputError("a mesh needs at least one face (got points only): reconstruct a surface, or export it with faces")


def _collada_document(path: Path) -> collada.Collada:
    import collada  # optional

    document = collada.Collada(str(path), ignore=[collada.DaeError])
    if document.scene is None:
        raise InputError("it has no scene (instance_visual_scene), which places its geometry: export a scene")
    return document


def _warnings(
    path: Path, scene: trimesh.Scene, content: bytes | None, parts: tuple[FilePart, ...], textures: bool
) -> Iterator[str]:
    """Yield a warning about each kind of data of a file that is not read."""
    kind = path.suffix.lower()
    if kind == ".obj" and content is not None:
        names = values_of(path, content, "usemtl")
        if textures and names and not values_of(path, content, "mtllib"):
            yield f"it names no material file (mtllib) of its material {names[0]}, which is left out"
        yield from obj_warnings(content, parts)
    elif kind == ".stl":
        stored = path.read_bytes()
        is_coloured = b"COLOR=" in stored[:_STL_HEADER_BYTES]
        _check_text_stl(stored, sum(len(one.faces) for one in scene.geometry.values()))
        if is_coloured or any(np.any(one.face_attributes.get("stl", 0)) for one in scene.geometry.values()):
            yield "the colours of its faces are not read, because STL files store them in several ways"
    elif kind == ".ply":
        header = _ply_header(path)
        yield from _ply_warnings(header, scene)
        named = _texture_names(header)
        if textures and named and all(part.material.texture is None for part in parts):
            yield f"its texture {named[0]} has no coordinates, and is left out"
    elif kind == ".off":
        yield from _off_warnings(path)


def _ply_warnings(header: str, scene: trimesh.Scene) -> Iterator[str]:
    """Yield a warning about each kind of data of a PLY file that is not read, for its header.

    Raises:
        InputError: If a colour is above the range of its type.
    """
    coloured = []
    for mesh in scene.geometry.values():
        for name, element in mesh.metadata.get("_ply_raw", {}).items():
            if name not in ("vertex", "face") or "red" not in element["properties"] or not len(element["data"]):
                continue
            coloured.append(name)
            values = np.asarray(element["data"]["red"])
            channels = [element["data"][one] for one in ("red", "green", "blue")]
            least, most = min(map(np.min, channels)), max(map(np.max, channels))
            if values.dtype.kind == "f" and most > MAX_FRACTION:
                raise InputError(
                    f"colours that are no integers must be within 0 to 1 (got {most:g}): divide them by 255"
                )
            if values.dtype.kind in "iu" and not 0 <= least <= most <= 255:
                raise InputError(
                    f"colours that are integers must be within 0 to 255 (got {least:g} to {most:g}): use uchar"
                )
    elements = re.split(r"^element ", header, flags=re.M)
    own = "".join(text for text in elements if text.startswith(("vertex", "face")))
    unread = re.findall(r"^property \w+ (\S*(?:red|green|blue))\s*$", own, re.M | re.I)
    if unread and not coloured:
        yield f"its properties {', '.join(dict.fromkeys(unread))} are left out, because colours have the name red"
    if {"vertex", "face"} <= set(coloured):
        yield "the colours of its faces are left out, because its vertices have colours"
    left_out = sorted(set(re.findall(r"^element (\S+) [1-9]", header, re.M)) - {"vertex", "face"})
    if left_out:
        yield f"its elements {', '.join(left_out)} are left out"


def _off_warnings(path: Path) -> Iterator[str]:
    """Yield a warning if an OFF file has colours.

    Raises:
        InputError: If its positions have four components, or if it has fewer faces than its header states.
    """
    header, rows, count, number = _off_rows(path)
    if "4" in header or "n" in header:
        raise InputError(f"OFF files must have positions of three components (got {header})")
    faces = rows[count + 1 : count + number + 1]
    if len(faces) < number:
        raise InputError(f"its header states {number} faces (got {len(faces)}; is the file complete?)")
    if "C" in header or any(len(row) > int(row[0]) + 1 for row in faces):
        yield "the colours of its vertices and faces are not read, because OFF files store them in several ways"


def _off_rows(path: Path) -> tuple[str, list[list[str]], int, int]:
    """Return the header of an OFF file, the rows of its numbers, and the counts of its vertices and faces."""
    header, text = re.sub(r"#.*", "", path.read_text(errors="replace")).split(None, 1)
    rows = [line.split() for line in text.splitlines() if line.strip()]
    return header, rows, int(rows[0][0]), int(rows[0][1])


class _Resolver(FilePathResolver):  # type: ignore[misc]
    """Files that a mesh names, by the rules of :func:`find_reference`. Textures are relative to their material file."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._source, self._mesh = path, path

    def get(self, name: str) -> bytes:
        """Return the content of a file."""
        name = plain_name(name) if self._mesh.suffix.lower() == ".dae" else name
        found = find_reference(self._source, name, "file", folder=self._mesh.parent)
        if found.suffix.lower() != ".mtl":
            return found.read_bytes()
        self._source = found
        return plain_text(found.read_bytes())


def _polygons(
    path: Path, scene: trimesh.Scene, document: collada.Collada | None
) -> Iterator[tuple[Float64Array, Sequence[Polygon]]]:
    """Yield the positions and the vertices of the polygons of a file, in formats whose polygons trimesh splits."""
    kind = path.suffix.lower()
    if kind == ".ply":
        for mesh in scene.geometry.values():
            face = ply_faces(mesh)
            for name in {"vertex_index", "vertex_indices"} & set(face):
                if "red" in face and any(len(one) != 3 for one in face[name]):
                    raise InputError("faces with colours must be triangles: export it with triangles")
                vertex = mesh.metadata["_ply_raw"]["vertex"]["data"]
                yield np.column_stack([np.ravel(vertex[axis]) for axis in "xyz"]).astype(np.float64), face[name]
    elif kind == ".off":
        _, rows, count, number = _off_rows(path)
        faces = [row[1 : int(row[0]) + 1] for row in rows[count + 1 : count + number + 1]]
        yield np.array([row[:3] for row in rows[1 : count + 1]], dtype=np.float64), [[*map(int, f)] for f in faces]
    elif document is not None:
        for geometry in document.geometries:
            for one in geometry.primitives:
                if hasattr(one, "polystarts"):
                    starts, ends = one.polystarts, one.polyends
                    yield one.vertex, [one.vertex_index[a:b] for a, b in zip(starts, ends, strict=True)]
                elif np.ndim(one.vertex_index) == 2:
                    yield one.vertex, one.vertex_index


def _split_faces(scene: trimesh.Scene, positions: Float64Array, polygons: Sequence[Polygon]) -> bool:
    """Replace the triangles of the only mesh of a scene by those of its polygons, concave ones included.

    Returns:
        False if the mesh has other vertices than the file, or a texture or colours of its faces.
    """
    (mesh,) = scene.geometry.values()
    if not np.array_equal(mesh.vertices, positions) or mesh.visual.kind not in (None, "vertex"):
        return False
    corners = split_polygons(positions, polygons)
    mesh.faces = np.concatenate([np.asarray(one)[rows] for one, rows in zip(polygons, corners, strict=True)])
    return True


def check_textures(mesh: Path) -> None:
    """Refuse a mesh whose material file, materials or textures are missing, because it would be baked in grey.

    Raises:
        InputError: If a file that an OBJ, its MTL or a PLY names is missing, outside of its folder, or no image.
    """
    kind = mesh.suffix.lower()
    if kind == ".obj":
        check_obj_materials(mesh)
    elif kind == ".ply":
        names = _texture_names(_ply_header(mesh))
        if len(names) > 1:  # trimesh uses the last one for all faces
            raise InputError(f"{mesh}: must have one texture (got {', '.join(names)}): merge them")
        for texture in names:
            check_texture(mesh, texture, mesh.parent)


def _texture_names(header: str) -> list[str]:
    """Return the textures that the header of a PLY file names."""
    return re.findall(r"^comment TextureFile +(.+?)\s*$", header, re.M | re.I)
