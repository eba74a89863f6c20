"""Polygons of mesh files as triangles, and OBJ files that trimesh reads correctly.

trimesh splits polygons by fans, which overlap where a polygon is concave, and counts the relative indices of an OBJ
file from its end instead of from their line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

import mapbox_earcut
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array, Int64Array, IntegerArray

Polygon = Sequence[int] | IntegerArray
"""Vertices of a polygon."""

_KINDS = (b"v", b"vt", b"vn")
_TO_REWRITE = re.compile(rb"^f (?:[^\n]*[ /])?[-0]|^f(?: \S+){4}", re.M)
_FLAT = 1e-6
"""Share of the area of a polygon up to which a reversed triangle of its fan is rounding."""


def plain_obj(content: bytes) -> bytes:
    """Return the plain text of an OBJ file with absolute indices and triangles in place of polygons.

    Raises:
        ValueError: If a face is damaged or refers to a missing vertex.
    """
    if not _TO_REWRITE.search(content):
        return content
    counts = dict.fromkeys(_KINDS, 0)
    positions: list[list[bytes]] = []
    polygons: list[list[tuple[int, ...]]] = []
    lines: list[bytes | int] = []  # an integer is the number of a polygon
    for line in content.splitlines():
        words = line.split()
        if words and words[0] == b"f" and len(words) >= 4:
            lines.append(len(polygons))
            polygons.append([_absolute(word, counts) for word in words[1:]])
            continue
        lines.append(line)
        if words and words[0] in counts:
            counts[words[0]] += 1
            if words[0] == b"v":
                positions.append(words[1:4])
    corners = split_polygons(np.array(positions, dtype=np.float64), [[c[0] - 1 for c in one] for one in polygons])
    rows = []
    for item in lines:
        if isinstance(item, bytes):
            rows.append(item)
            continue
        words = [b"/".join(b"%d" % i if i else b"" for i in corner) for corner in polygons[item]]
        rows += [b"f %b %b %b" % (words[a], words[b], words[c]) for a, b, c in corners[item]]
    return b"\n".join(rows) + b"\n"


def split_polygons(positions: Float64Array, polygons: Sequence[Polygon]) -> list[Int64Array]:
    """Split polygons into triangles of their corners: by fans, except for concave polygons.

    Args:
        positions: Positions, shape (V, 3).
        polygons: Vertices of each polygon.

    Returns:
        Corners of the triangles of each polygon, numbered from 0 in the polygon, shape (K, 3).

    Raises:
        ValueError: If a polygon has a missing vertex.
    """
    found: list[Int64Array] = [np.zeros((0, 3), dtype=np.int64)] * len(polygons)
    for numbers, rows in _equal_lengths(polygons, len(positions)):
        second = np.arange(1, rows.shape[1] - 1)
        fan = np.stack([np.zeros_like(second), second, second + 1], axis=1)
        if len(fan) == 2:
            fan = np.array([[0, 1, 2], [2, 3, 0]])
        normals, overlap = _fans(positions, rows)
        for number, row, normal, is_concave in zip(numbers, rows, normals, overlap, strict=True):
            found[number] = _ears(positions[row], normal) if is_concave else fan
    return found


def has_concave(positions: Float64Array, polygons: Sequence[Polygon]) -> bool:
    """Return True if the fan of a polygon overlaps itself.

    Raises:
        ValueError: If a polygon has a missing vertex.
    """
    return any(_fans(positions, rows)[1].any() for _, rows in _equal_lengths(polygons, len(positions)))


def _equal_lengths(polygons: Sequence[Polygon], count: int) -> Iterator[tuple[Int64Array, Int64Array]]:
    """Yield the numbers of the polygons of each length, and their vertices (N, length) of ``count``.

    Raises:
        ValueError: If a polygon has a missing vertex.
    """
    lengths = np.array([len(one) for one in polygons], dtype=np.int64)
    for length in np.unique(lengths[lengths > 2]):
        numbers = np.nonzero(lengths == length)[0]
        rows = np.array([polygons[int(number)] for number in numbers], dtype=np.int64)
        if rows.min() < 0 or rows.max() >= count:
            raise ValueError(f"a face refers to vertices {rows.min() + 1} to {rows.max() + 1} of {count}")
        yield numbers, rows


def _fans(positions: Float64Array, rows: Int64Array) -> tuple[Float64Array, npt.NDArray[np.bool_]]:
    """Return the normals (N, 3) of polygons of equal length, and True where the fan of one overlaps itself, (N,)."""
    sides = positions[rows[:, 1:]] - positions[rows[:, :1]]
    areas = np.cross(sides[:, :-1], sides[:, 1:])
    normals = areas.sum(axis=1)
    least = -_FLAT * (normals**2).sum(axis=1, keepdims=True)
    return normals, (np.einsum("nkc,nc->nk", areas, normals) < least).any(axis=1)


def _ears(outline: Float64Array, normal: Float64Array) -> Int64Array:
    """Split a polygon (N, 3) with a normal into triangles, seen along the axis of the largest component."""
    axis = int(np.abs(normal).argmax())
    plane = outline[:, [(axis + 1) % 3, (axis + 2) % 3]]
    found = mapbox_earcut.triangulate_float64(plane, np.array([len(outline)], dtype=np.uint32))
    faces = found.astype(np.int64).reshape(-1, 3)
    a, b, c = (outline[faces[:, k]] for k in range(3))
    is_reversed = np.cross(b - a, c - a) @ normal < 0
    return np.where(is_reversed[:, None], faces[:, ::-1], faces)


def _absolute(corner: bytes, counts: Mapping[bytes, int]) -> tuple[int, ...]:
    """Return the absolute indices of a corner ``v/vt/vn``, and 0 for an absent one.

    Raises:
        ValueError: If an index is 0 or no number.
    """
    found = []
    for index, kind in zip(corner.split(b"/"), _KINDS, strict=False):
        number = int(index) if index else 0
        if index and number == 0:
            raise ValueError(f"indices of faces must begin with 1 (got {corner.decode(errors='replace')})")
        found.append(number + counts[kind] + 1 if number < 0 else number)
    return tuple(found)
