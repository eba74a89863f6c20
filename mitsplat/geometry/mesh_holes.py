"""Closing of small holes of meshes, such as missing triangles of scans, and removal of loose fragments."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import trimesh
from trimesh.grouping import group_rows

from mitsplat.arrays import Float64Array, Int64Array

_MAX_SHARE = 0.005
"""Maximum area of a hole, relative to the area of its body. The opening of a box or of a cup is larger."""
_FRAGMENT = 0.001
"""Maximum number of faces of a fragment, relative to those of the mesh."""
_FLAT = 0.999
"""Area of a hole of three edges, relative to that of its body, above which the body is a flat sheet in this outline."""
_SAME_ANGLE = 1e-4
"""Angle below which the sides of a hole coincide [rad], such as those of a face without area."""
_MAX_EDGES = 400
"""Maximum number of edges of a hole, because the time grows with its square: 2 s for 400 edges."""


def close_holes(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh without fragments, whose small holes are closed; a closed mesh is returned unchanged.

    Small holes have three edges, or an area of at most 0.5 % of the connected faces around them. Each gets its
    triangulation of minimum area (Barequet and Sharir, *Filling Gaps in the Boundary of a Polyhedron*, 1995). Larger
    openings stay open, and sheets stay sheets, also beside larger bodies in the same mesh.

    Fragments are open sheets of at most 0.1 % of the faces. They are removed if they have at most 0.5 % of the area
    together, such as the loose triangles of a scan, which would make it open.
    """
    mesh = _without_fragments(mesh)
    if mesh.is_watertight:
        return mesh
    body = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    sizes = np.bincount(body, weights=mesh.area_faces)[body][mesh.edges_face]
    single = group_rows(mesh.edges_sorted, require_count=1)
    vertices, ends = np.asarray(mesh.vertices), np.asarray(mesh.edges)[:, 1]
    on_outline = np.zeros(len(mesh.vertices), dtype=bool)
    on_outline[mesh.edges[single]] = True
    edges = set(map(tuple, mesh.edges_sorted[on_outline[mesh.edges_sorted].all(axis=1)].tolist()))
    found: list[Int64Array] = []
    for rim in _holes(mesh, single):
        if len(rim) > _MAX_EDGES:
            continue
        hole = ends[rim]
        largest = (_MAX_SHARE if len(hole) > 3 else _FLAT) * float(sizes[rim].max())
        if _smallest_area(vertices[hole]) > largest:
            continue
        triangles, area = _smallest_patch(hole, vertices[hole], edges)
        if area <= largest:
            found.append(triangles)
    if not found:
        return mesh
    return trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces, *found]), process=False)


def _without_fragments(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh without small open sheets; see :func:`close_holes`."""
    if mesh.is_watertight or len(mesh.faces) * _FRAGMENT < 1:
        return mesh
    body = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    counts, areas = np.bincount(body), np.bincount(body, weights=mesh.area_faces)
    fragment = counts <= _FRAGMENT * len(mesh.faces)
    is_open = np.zeros(len(counts), dtype=bool)
    is_open[body[mesh.edges_face[group_rows(mesh.edges_sorted, require_count=1)]]] = True
    fragment &= is_open
    if not fragment.any() or areas[fragment].sum() > _MAX_SHARE * areas.sum():
        return mesh
    rest = trimesh.Trimesh(mesh.vertices, mesh.faces[~fragment[body]], process=False)
    rest.remove_unreferenced_vertices()
    return rest


def _holes(mesh: trimesh.Trimesh, single: Int64Array) -> Iterator[Int64Array]:
    """Yield the edges (N,) around each hole, in the order of the faces that fill it, of the edges of ``single`` faces.

    Where holes touch at a vertex, the next edge around the vertex follows. A hole that touches itself contains the
    vertex twice. Outlines that do not return to their start, because faces differ in winding, are left out.
    """
    outline = np.asarray(mesh.edges)[single][:, ::-1]
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    leaving: dict[int, list[int]] = defaultdict(list)
    for edge, start in enumerate(outline[:, 0].tolist()):
        leaving[start].append(edge)
    following: dict[int, int] = {}
    for edge, (start, end) in enumerate(outline.tolist()):
        ways = leaving[end]
        if ways:
            spokes = vertices[[start, *outline[ways, 1]]] - vertices[end]
            following[edge] = ways[int(_angles(spokes, normals[end]).argmin()) if len(ways) > 1 else 0]
    for first in list(following):
        edge, hole = first, []
        while edge in following:
            hole.append(edge)
            edge = following.pop(edge)
        if hole and edge == first:
            yield single[hole]


def _angles(spokes: Float64Array, normal: Float64Array) -> Float64Array:
    """Return the angles (N,) [rad] about a normal from ``spokes[1:]`` to ``spokes[0]``, anticlockwise from outside."""
    one, others = spokes[0], spokes[1:]
    angles = np.arctan2(np.cross(others, one) @ normal, others @ one - (others @ normal) * (one @ normal))
    return np.asarray((angles + _SAME_ANGLE) % (2 * np.pi))


def _smallest_area(points: Float64Array) -> float:
    """Return a lower bound of the area of any patch of a loop (N, 3): the length of its vector area."""
    spokes = points - points[0]
    return 0.5 * float(np.linalg.norm(np.cross(spokes[:-1], spokes[1:]).sum(axis=0)))


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
