"""Closing of small holes of meshes, such as missing triangles of scans."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import trimesh
from trimesh.grouping import group_rows

from mitsplat.arrays import Float64Array, Int64Array

_MAX_SHARE = 0.005
"""Maximum area of a hole, relative to the area of the mesh. The opening of a box or of a cup is larger."""
_MAX_EDGES = 100
"""Maximum number of edges of a hole, because the time grows with its third power: 0.1 s for 100 edges."""


def close_holes(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh whose small holes are closed; a closed mesh is returned unchanged.

    Small holes have an area of at most 0.5 % of the mesh, or three edges. Each gets its triangulation of minimum area
    (Barequet and Sharir, *Filling Gaps in the Boundary of a Polyhedron*, 1995). Larger openings stay open.
    """
    if mesh.is_watertight:
        return mesh
    edges = set(map(tuple, mesh.edges_sorted.tolist()))
    found: list[Int64Array] = []
    for hole in _holes(mesh):
        if len(hole) > _MAX_EDGES:
            continue
        triangles, area = _smallest_patch(hole, mesh.vertices[hole], edges)
        if area <= (_MAX_SHARE * mesh.area if len(hole) > 3 else np.inf):
            found.append(triangles)
    if not found:
        return mesh
    return trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces, *found]), process=False)


def _holes(mesh: trimesh.Trimesh) -> Iterator[Int64Array]:
    """Yield the vertices (N,) around each hole, in the order of the faces that fill it.

    Where holes touch at a vertex, the next edge around the vertex follows. A hole that touches itself contains the
    vertex twice. Outlines that do not return to their start, because faces differ in winding, are left out.
    """
    outline = mesh.edges[group_rows(mesh.edges_sorted, require_count=1)][:, ::-1]
    leaving: dict[int, list[int]] = defaultdict(list)
    for edge, start in enumerate(outline[:, 0].tolist()):
        leaving[start].append(edge)
    following: dict[int, int] = {}
    for edge, (start, end) in enumerate(outline.tolist()):
        ways = leaving[end]
        if ways:
            nearest = _angles(mesh, end, start, outline[ways, 1]).argmin() if len(ways) > 1 else 0
            following[edge] = ways[int(nearest)]
    for first in list(following):
        edge, hole = first, []
        while edge in following:
            hole.append(edge)
            edge = following.pop(edge)
        if hole and edge == first:
            yield outline[hole, 0]


def _angles(mesh: trimesh.Trimesh, vertex: int, start: int, ends: Int64Array) -> Float64Array:
    """Return the angles (N,) [rad] at a vertex from ``ends`` (N,) to ``start``, anticlockwise seen from outside."""
    normal = mesh.vertex_normals[vertex]
    one, others = mesh.vertices[start] - mesh.vertices[vertex], mesh.vertices[ends] - mesh.vertices[vertex]
    angles = np.arctan2(np.cross(others, one) @ normal, others @ one - (others @ normal) * (one @ normal))
    return np.asarray(angles % (2 * np.pi))


def _smallest_patch(loop: Int64Array, points: Float64Array, edges: set[tuple[int, int]]) -> tuple[Int64Array, float]:
    """Return the triangles (N - 2, 3) of minimum total area that fill a loop, and this area.

    Args:
        loop: Vertices of the loop, shape (N,).
        points: Their positions, shape (N, 3).
        edges: Edges of the mesh, which the patch does not use a second time.
    """
    count = len(loop)
    area, tips = np.zeros((count, count)), np.zeros((count, count), dtype=np.int64)
    for width in range(2, count):
        for first in range(count - width):
            last = first + width
            between = np.arange(first + 1, last)
            cross = np.cross(points[between] - points[first], points[last] - points[first])
            total = area[first, between] + area[between, last] + 0.5 * np.linalg.norm(cross, axis=1)
            best = int(total.argmin())
            tips[first, last] = between[best]
            one, other = sorted((int(loop[first]), int(loop[last])))
            is_taken = one == other or (width < count - 1 and (one, other) in edges)
            area[first, last] = np.inf if is_taken else total[best]
    triangles, spans = [], [(0, count - 1)]
    while spans:
        first, last = spans.pop()
        if last - first > 1:
            tip = int(tips[first, last])
            triangles.append((first, tip, last))
            spans += [(first, tip), (tip, last)]
    return loop[np.array(triangles)], float(area[0, -1])
