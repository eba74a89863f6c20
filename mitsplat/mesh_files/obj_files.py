"""OBJ files and their material files: text in the form that trimesh reads, their textures, and what is not read."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from mitsplat.errors import InputError
from mitsplat.images.picture_files import describe_fault
from mitsplat.mesh_files.file_references import find_reference
from mitsplat.mesh_files.mesh_file import MAX_FRACTION, FilePart
from mitsplat.storage.files import IMAGE_ERRORS

_CONTINUATION = re.compile(rb"\\\r?\n")
_KEPT = (b"map_", b"mtllib")
"""Beginnings of the keys whose values are file names."""
_NAMES = (b"usemtl", b"newmtl", b"g", b"o")
"""Keys whose values may contain the character that begins a comment."""
_PAINT = re.compile(rb"^\s*#MRGB\s+(?:[0-9a-fA-F]{8})+\s*$")
_BARE_CORNER = re.compile(rb" (\d+)(?:/(\d*))?/?(?!\S)")
"""Corner of a face without a normal: ``v``, ``v/t``, ``v/`` or ``v/t/``."""
_COLOURED = re.compile(rb"^v(?: \S+){3}((?: \S+){3})$", re.M)
_ODD_VERTEX = re.compile(rb"^v(?: \S+){5}$|^v(?: \S+){7,}$", re.M)
_LEFT_OUT = {
    rb"^(?:curv|curv2|surf) ": "its free-form curves and surfaces are left out",
    rb"^[lp] ": "its points and lines are left out",
    rb"^#MRGB": "the colours of its vertices (#MRGB) are left out, because their number is not that of the vertices",
    rb"^call ": "the files that it calls are left out",
}


def plain_text(content: bytes) -> bytes:
    """Return an OBJ or MTL file in UTF-8 in one spelling.

    It has single blanks, line feeds and colours of three values, and no comments or continued lines.
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        content = content.decode("utf-16").encode()
    lines = _CONTINUATION.sub(b" ", content.removeprefix(codecs.BOM_UTF8)).splitlines()
    painted = [line.split(maxsplit=1)[1].strip() for line in lines if _PAINT.match(line)]
    return b"\n".join(_painted_lines([_plain_line(line) for line in lines], b"".join(painted))) + b"\n"


def face_corners(content: bytes) -> bytes:
    """Return the corners of all faces of the plain text of an OBJ file, each after a blank."""
    return b"".join(re.findall(rb"^f( .*)$", content, re.M))


def with_all_normals(content: bytes) -> bytes:
    """Return the plain text of an OBJ file whose corners either all have a normal, or none; absent ones are zero.

    trimesh would read ``v/t`` after a face with ``v//n`` as ``v//n``, and drops the normals of other mixed faces.
    """
    faces = face_corners(content)
    if len(re.findall(rb"/\d*/\d", faces)) in (0, faces.count(b" ")):
        return content
    zero = b"%d" % (len(re.findall(rb"^vn ", content, re.M)) + 1)

    def fill(corner: re.Match[bytes]) -> bytes:
        return b" %b/%b/%b" % (corner[1], corner[2] or b"", zero)

    return re.sub(rb"^f .*$", lambda face: _BARE_CORNER.sub(fill, face[0]), content, flags=re.M) + b"vn 0 0 0\n"


def _painted_lines(lines: list[bytes], colours: bytes) -> list[bytes]:
    """Return lines whose vertices have the colours of ZBrush's polypaint, eight digits MMRRGGBB a vertex (M: mask).

    Colours that do not fit the vertices stay a comment.
    """
    vertices = [number for number, line in enumerate(lines) if line.startswith(b"v ")]
    if not colours:
        return lines
    if len(colours) != 8 * len(vertices) or any(len(lines[number].split()) != 4 for number in vertices):
        return [*lines, b"#MRGB"]
    values = np.frombuffer(bytes.fromhex(colours.decode()), np.uint8).reshape(-1, 4)[:, 1:] / 255.0
    painted = list(lines)
    for number, colour in zip(vertices, values, strict=True):
        painted[number] += b" %.6f %.6f %.6f" % tuple(colour)
    return painted


def _plain_line(line: bytes) -> bytes:
    """Return a line of an OBJ or MTL file without comments and in the spelling that trimesh reads."""
    if b"#" in line:
        key = line.split(maxsplit=1)[0].lower()
        if key.startswith(b"#") or not (key in _NAMES or key.startswith(_KEPT)):
            line = line.partition(b"#")[0]
    words = line.split()
    if words and words[0].lower().startswith(_KEPT):
        return b" ".join(line.strip().split(maxsplit=1))
    if len(words) == 2 and words[0].lower() in (b"ka", b"kd", b"ks"):
        words += words[1:] * 2  # a single value stands for all three
    if len(words) == 2 and words[0] == b"vt":
        words.append(b"0")
    return b" ".join(words)


def obj_warnings(content: bytes, parts: tuple[FilePart, ...]) -> Iterator[str]:
    """Yield a warning about each kind of data of an OBJ file that is not read.

    Args:
        content: Its plain text.
        parts: What is read.

    Raises:
        InputError: If colours of vertices are not within 0 to 1, or have an opacity.
    """
    if (odd := _ODD_VERTEX.search(content)) is not None:
        count = len(odd[0].split()) - 1
        raise InputError(f"vertices must have 3 numbers, or 6 with red, green and blue (got {count}): leave out others")
    for pattern, sentence in _LEFT_OUT.items():
        if re.search(pattern, content, re.M):
            yield sentence
    colours = _COLOURED.findall(content)
    if not colours:
        return
    most = np.array(b" ".join(colours).split(), dtype=np.float64).max()
    if most > 1:
        raise InputError(f"colours of vertices must be within 0 to 1 (got {most:g}): divide them by 255")
    if len(colours) < len(re.findall(rb"^v ", content, re.M)):
        yield "the colours of its vertices are left out, because some vertices have none"
    elif any(part.colours is None for part in parts):
        yield "the colours of its vertices are left out, because its faces have materials: remove mtllib to use them"


def obj_fault(content: bytes) -> str:
    """Return a sentence about the first wrong number in an OBJ file, or an empty text if there is none."""
    lines = [line.split() for line in plain_text(content).splitlines()]
    count = sum(words[:1] == [b"v"] for words in lines)
    for number, words in enumerate(lines, 1):
        got = b" ".join(words).decode(errors="replace")
        if words[:1] == [b"v"]:
            try:
                is_finite = bool(np.isfinite(np.array(words[1:], dtype=np.float64)).all())
            except ValueError:
                is_finite = False
            if not is_finite:
                return f"line {number}: vertices must be finite numbers (got {got})"
        if words[:1] == [b"f"]:
            corners = [word.partition(b"/")[0] for word in words[1:]]
            if not all(re.fullmatch(rb"-?\d+", corner) and 1 <= abs(int(corner)) <= count for corner in corners):
                return f"line {number}: faces must name vertices from 1 to {count}, the number in the file (got {got})"
    return ""


def values_of(path: Path, content: bytes, key: str) -> list[str]:
    """Return the values of all lines of an OBJ or MTL file that begin with a key.

    Args:
        path: The file, for messages.
        content: Its plain text.
        key: The key, in lower case.

    Raises:
        InputError: If a value is not UTF-8.
    """
    names = []
    for found in re.finditer(rb"^" + key.encode() + rb" (.*)$", content, re.M | re.I):
        try:
            names.append(found[1].decode("utf-8"))
        except UnicodeDecodeError:
            name = found[1].decode("cp1252", errors="replace")
            raise InputError(f"{path}: names must be UTF-8: save it so, or rename it (got {key} {name})") from None
    return names


def check_obj_materials(mesh: Path) -> None:
    """Refuse an OBJ file whose material file, materials or textures are missing or cannot be read.

    Raises:
        InputError: If one is missing, outside of the folder, or damaged.
    """
    content = plain_text(mesh.read_bytes())
    libraries = list(dict.fromkeys(values_of(mesh, content, "mtllib")))
    if len(libraries) > 1:
        raise InputError(f"{mesh}: must have one material file (got {', '.join(libraries)}): join them")
    known: list[str] = []
    for library in libraries:
        words = library.split()
        if len(words) > 1 and all((mesh.parent / word).is_file() for word in words):
            raise InputError(f"{mesh}: must have one material file (got {library})")
        path = find_reference(mesh, library, "material file")
        known += _check_library(path, mesh.parent)
    missing = sorted(set(values_of(mesh, content, "usemtl")) - set(known)) if libraries else []
    if missing:
        raise InputError(
            f"{mesh}: its material {missing[0]} is not in {', '.join(libraries)}: add it, or give a colour"
        )


def _check_library(path: Path, folder: Path) -> list[str]:
    """Check a material file of a mesh in ``folder``, and return the names of its materials."""
    content = plain_text(path.read_bytes())
    for texture in values_of(path, content, "map_kd"):
        if texture.startswith("-"):
            raise InputError(f"{path}: options of a texture are not supported: remove them (got map_Kd {texture})")
        check_texture(path, texture, folder)
    for key in ("ka", "kd", "ks"):
        for colour in values_of(path, content, key):
            _check_colour(path, key, colour)
    for key in ("pr", "pm"):
        for value in values_of(path, content, key):
            _check_share(path, key, value)
    names = values_of(path, content, "newmtl")
    bodies = [body.strip() for body in re.split(rb"^newmtl .*$", content, flags=re.M | re.I)[1:]]
    first: dict[str, bytes] = {}
    for name, body in zip(names, bodies, strict=True):
        if first.setdefault(name, body) != body:
            count = names.count(name)
            raise InputError(f"{path}: materials must have different names (got {count} with the name {name})")
    return names


def _check_colour(path: Path, key: str, colour: str) -> None:
    try:
        values = np.array(colour.split(), dtype=np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) != 3 or (key == "kd" and values.max() > MAX_FRACTION):
        name = key.capitalize()
        raise InputError(f"{path}: {name} must be red, green and blue from 0 to 1 (got {name} {colour})")


def _check_share(path: Path, key: str, value: str) -> None:
    try:
        is_share = 0 <= float(value) <= 1
    except ValueError:
        is_share = False
    if not is_share:
        meaning, name = {"pr": "roughness", "pm": "metalness"}[key], key.capitalize()
        raise InputError(f"{path}: {name}, the {meaning}, must be a number from 0 to 1 (got {name} {value})")


def check_texture(path: Path, texture: str, folder: Path) -> None:
    """Refuse a texture that the file ``path`` of a mesh in ``folder`` names if it is missing or damaged.

    Raises:
        InputError: If it is missing, outside of the folder, or no image.
    """
    found = find_reference(path, texture, "texture", folder=folder)
    try:
        with Image.open(found) as image:
            image.load()
    except IMAGE_ERRORS as error:
        raise InputError(
            f"{path}: its texture {texture} cannot be read ({describe_fault(error)}); replace it, or give a colour"
        ) from None
