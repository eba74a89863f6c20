"""Closed surfaces: test, separation into solids, direction of faces, cavities, union and simplification.

A closed mesh consists of surfaces. A surface encloses a body or a cavity. The winding number of the mesh is the number
of bodies minus the number of cavities around a point (Jacobson et al., *Robust Inside-Outside Segmentation using
Generalized Winding Numbers*, 2013).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import cast

import manifold3d
import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.mesh_points import points_inside, winding_numbers

_MIN_SHARE = 1e-6
"""Share of the volume below which a surface is debris of a scan, whose direction does not matter."""
_CLOSE = 1e-6
"""Distance relative to the size below which surfaces touch."""
_POINTS = 16
"""Maximum number of faces of a cavity that are tested for being inside of a body."""
_SAME_ANGLE = 1e-4
"""Angle about a common edge below which faces of two solids coincide [rad]."""


def is_closed(mesh: trimesh.Trimesh) -> bool:
    """Return True if the faces enclose solids: they pass each edge equally often in both directions.

    Four faces share an edge where solids touch, or where a coarse solid touches itself. ``is_watertight`` of trimesh
    is then False, although the volume is defined. Faces that are listed twice would count their solid twice, and both
    sides of a sheet without thickness enclose nothing: such meshes are not closed. Nor are those with both sides of a
    whole solid, whose volumes cancel, and those without faces. The faces at which two solids touch end at other faces.
    """
    if not len(mesh.faces):
        return False
    if mesh.is_watertight:
        return bool(mesh.is_winding_consistent)
    directions = np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1)
    edges, edge = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)
    if np.bincount(edge.ravel(), directions, len(edges)).any():
        return False
    corners = np.sort(mesh.faces, axis=1)
    turns = np.sign(np.linalg.det(np.eye(3)[np.argsort(mesh.faces, axis=1)]))  # the direction of equal corners
    if len(np.unique(np.column_stack([corners, turns]), axis=0)) < len(corners):
        return False
    one, other = mesh.face_adjacency.T  # the faces of edges that two faces share
    if (corners[one] == corners[other]).all(axis=1).any():
        return False
    _, twin, counts = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    sides = edge.reshape(-1, 3)[counts[twin.ravel()] == 2]  # edges of faces that are listed in both directions
    links = np.concatenate([sides[:, :2], sides[:, 1:]])
    patch = trimesh.graph.connected_component_labels(links, node_count=len(edges))
    at_end = np.bincount(sides.ravel(), minlength=len(edges)) == 2
    return bool(np.isin(patch[sides[:, 0]], patch[at_end]).all())


def separate_solids(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return the connected surfaces of a closed mesh, each of which has two faces at every edge.

    Surfaces of negative volume are cavities, or inside out. Where solids touch, the surfaces of both get a vertex in
    the middle of each common edge.
    """
    mesh = _with_two_faces_per_edge(mesh)
    label = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    groups = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    if len(groups) == 1:
        return [mesh]
    surfaces = []
    for group in groups:
        vertices, faces = np.unique(mesh.faces[group], return_inverse=True)
        surfaces.append(trimesh.Trimesh(mesh.vertices[vertices], faces.reshape(-1, 3), process=False))
    return surfaces


def _with_two_faces_per_edge(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a closed mesh in which each pair of faces has its own vertex on an edge that more than two faces share."""
    if mesh.is_watertight:
        return mesh
    one, other = np.array(list(_pairs_at_shared_edges(mesh))).T
    vertices = np.concatenate([mesh.vertices, mesh.vertices[mesh.edges[one]].mean(axis=1)])
    middles = np.full((len(mesh.faces), 3), -1)
    middles.flat[one] = middles.flat[other] = len(mesh.vertices) + np.arange(len(one))
    divided = (middles >= 0).any(axis=1)
    faces = [*mesh.faces[~divided].tolist()]
    for corners, own in zip(mesh.faces[divided].tolist(), middles[divided].tolist(), strict=True):
        outline = [vertex for pair in zip(corners, own, strict=True) for vertex in pair]
        first = next(place for place in (1, 3, 5) if outline[place] >= 0)
        fan = [vertex for vertex in outline[first:] + outline[:first] if vertex >= 0]
        faces += [[fan[0], *side] for side in pairwise(fan[1:])]
    return trimesh.Trimesh(vertices, faces, process=False)


def _pairs_at_shared_edges(mesh: trimesh.Trimesh) -> Iterator[tuple[int, int]]:
    """Yield the pairs of rows of ``mesh.edges`` that enclose solids, at edges that more than two faces share.

    Around an edge, each solid begins at a face and ends at the next face of opposite direction, as parentheses do.
    Where faces of two solids coincide, one solid ends before the other begins.
    """
    _, edge, counts = np.unique(mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    rows = np.flatnonzero(counts[edge] > 2)
    ends, vertices = mesh.edges_sorted[rows], np.asarray(mesh.vertices)
    along = vertices[ends[:, 1]] - vertices[ends[:, 0]]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    sideways = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    apex = vertices[np.roll(mesh.faces, 1, axis=1).ravel()[rows]] - vertices[ends[:, 0]]
    begins = mesh.edges[rows, 0] > mesh.edges[rows, 1]
    angles = np.arctan2(np.einsum("nd,nd->n", apex, np.cross(along, sideways)), np.einsum("nd,nd->n", apex, sideways))
    order = np.lexsort([(angles - _SAME_ANGLE * ~begins) % (2 * np.pi), edge[rows]])
    for group in np.split(order, np.flatnonzero(np.diff(edge[rows][order])) + 1):
        open_faces: list[int] = []
        paired: set[int] = set()
        for place in [*group.tolist()] * 2:  # twice, because a solid may begin before the angle 0
            if place in paired:
                continue
            if begins[place]:
                open_faces += [place] * (place not in open_faces)
            elif open_faces:
                begin = open_faces.pop()
                paired |= {begin, place}
                yield int(rows[begin]), int(rows[place])


def turn_outwards(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, int, int]:
    """Turn the surfaces of a closed mesh that are inside out.

    All surfaces are turned first if the volume of the mesh is negative. A surface of negative volume is then a cavity
    if it is inside a body, and else a body that is inside out. A surface of positive volume within such a body is its
    cavity.

    Returns:
        The mesh, the number of turned surfaces, and the number of all surfaces.
    """
    surfaces = separate_solids(mesh)
    volumes = np.array([signed_volume(surface) for surface in surfaces])
    bounds = np.array([surface.bounds for surface in surfaces])
    sign = -1 if volumes.sum() < 0 else 1
    volumes *= sign
    debris = np.abs(volumes) < _MIN_SHARE * np.abs(volumes).sum()
    negative = bounds[(volumes < 0) & ~debris]
    is_turned = np.full(len(surfaces), sign < 0)
    for number in np.flatnonzero(~debris):
        if not _around(negative, bounds[number]).any():  # a surface is around itself
            continue
        point = _inner_point(surfaces[number])
        others = [other for other in np.flatnonzero(_around(bounds, np.stack([point, point]))) if other != number]
        winding = sign * sum(float(winding_numbers(surfaces[other], point[None])[0]) for other in others)
        if winding < (-0.5 if volumes[number] > 0 else 0.5):
            is_turned[number] ^= True
    if not is_turned.any():
        return mesh, 0, len(surfaces)
    turned = [
        trimesh.Trimesh(surface.vertices, surface.faces[:, ::-1] if turn else surface.faces, process=False)
        for surface, turn in zip(surfaces, is_turned, strict=True)
    ]
    return join_meshes(turned), int(is_turned.sum()), len(surfaces)


def unite_bodies(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Unite the bodies of a closed mesh that touch or overlap, whose common volume would count twice."""
    surfaces = sorted(separate_solids(mesh), key=signed_volume)
    volumes = np.array([signed_volume(surface) for surface in surfaces])
    least = _MIN_SHARE * np.abs(volumes).sum()
    first, last = np.searchsorted(volumes, [-least, least])
    cavities, debris, outlines = surfaces[:first], surfaces[first:last], surfaces[last:]
    if len(outlines) < 2:
        return mesh
    meets = _meeting(np.array([outline.bounds for outline in outlines]), _CLOSE * mesh.scale)
    if not meets.any():
        return mesh
    bodies = [[outline] for outline in outlines]
    for cavity in cavities:  # belongs to the smallest body around it
        points = cavity.triangles_center[:: len(cavity.faces) // _POINTS + 1]  # its vertices may touch the body
        for body in bodies:
            if points_inside(body[0], points).all():
                body.append(cavity)
                break
    united = [_body(*bodies[number]) for number in np.flatnonzero(meets)]
    union = manifold3d.Manifold.batch_boolean(united, manifold3d.OpType.Add)
    apart = [surface for number in np.flatnonzero(~meets) for surface in bodies[number]]
    return join_meshes([*debris, *apart, _mesh_of(union)])


def _body(outline: trimesh.Trimesh, *cavities: trimesh.Trimesh) -> manifold3d.Manifold:
    """Return a body without its cavities, which may overlap, as a solid of Manifold."""
    voids = [trimesh.Trimesh(cavity.vertices, cavity.faces[:, ::-1], process=False) for cavity in cavities]
    solids = [solid_manifold(solid) for solid in (outline, *voids)]
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Subtract)


def signed_volume(surface: trimesh.Trimesh) -> float:
    """Return the volume of a closed surface, negative if it is a cavity or inside out."""
    return float(np.linalg.det(surface.triangles - surface.vertices[0]).sum()) / 6


def _inner_point(surface: trimesh.Trimesh) -> Float64Array:
    """Return a point inside a closed surface, close to the middle of its largest face."""
    face = int(surface.area_faces.argmax())
    inwards = -np.sign(signed_volume(surface)) * surface.face_normals[face]
    return np.asarray(surface.triangles_center[face] + _CLOSE * surface.scale * inwards)


def _around(bounds: Float64Array, inner: Float64Array) -> BoolArray:
    """Return a mask of the bounds (N, 2, 3) that contain inner bounds (2, 3)."""
    return np.asarray(((bounds[:, 0] <= inner[0]) & (inner[1] <= bounds[:, 1])).all(axis=1))


def _meeting(bounds: Float64Array, distance: float) -> BoolArray:
    """Return a mask of the bounds (N, 2, 3) within a distance of others, along each axis."""
    low, high = np.moveaxis(bounds[np.argsort(bounds[:, 0, 0])], 1, 0)
    meets = np.zeros(len(bounds), dtype=bool)
    for first, end in enumerate(np.searchsorted(low[:, 0], high[:, 0] + distance)):
        later = slice(first + 1, end)
        near = ((low[later] < high[first] + distance) & (low[first] < high[later] + distance)).all(axis=1)
        meets[later] |= near
        meets[first] |= near.any()
    return meets[np.argsort(np.argsort(bounds[:, 0, 0]))]


def join_meshes(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return all triangles as one mesh."""
    return cast(trimesh.Trimesh, trimesh.util.concatenate(list(meshes)))


def solid_manifold(solid: trimesh.Trimesh) -> manifold3d.Manifold:
    """Return a closed surface as a solid of Manifold, in single precision."""
    solid = _with_two_faces_per_edge(solid)  # Manifold would lose faces
    # Manifold refuses subclasses of NumPy arrays whose rows are not contiguous. Reordered faces are such arrays.
    vertices = np.ascontiguousarray(solid.vertices, np.float32)
    return manifold3d.Manifold(manifold3d.Mesh(vertices, np.ascontiguousarray(solid.faces, np.uint32)))


def _mesh_of(manifold: manifold3d.Manifold) -> trimesh.Trimesh:
    """Return the surface of a solid of Manifold."""
    mesh = manifold.to_mesh()
    return trimesh.Trimesh(mesh.vert_properties[:, :3].astype(np.float64), mesh.tri_verts, process=False)


def simplify_solid(solid: trimesh.Trimesh, *tolerances: float, most: int = 0) -> trimesh.Trimesh:
    """Return a closed surface with fewer faces, within about a tolerance [m] of the original (by Manifold).

    Args:
        solid: The closed surface.
        tolerances: Tolerances that are tried in turn.
        most: Number of faces that is low enough.
    """
    manifold, fewest = solid_manifold(solid), solid
    for tolerance in tolerances:
        simple = manifold.simplify(tolerance)
        if simple.num_tri() < len(fewest.faces):
            found = _mesh_of(simple)
            fewest = found if found.is_volume else fewest
        if len(fewest.faces) <= most:
            break
    return fewest
