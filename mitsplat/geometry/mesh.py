"""Proxy meshes for physics: validation, mass and inertia."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import manifold3d
import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.mesh_holes import close_holes
from mitsplat.geometry.mesh_points import points_inside

_logger = logging.getLogger(__name__)

# Sizes outside of this range indicate wrong units [m].
_MIN_SIZE, _MAX_SIZE = 5e-4, 20.0
# More triangles do not change how an object rests, and CoACD takes hours for them.
_MAX_FACES = 200_000
# Share of the volume below which a surface is debris of a scan, whose direction does not matter.
_MIN_SHARE = 1e-6
# Minimum angle between faces at an edge that can penetrate another object [rad].
SHARP = 0.17


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Inertial properties of a rigid body in its own frame.

    Attributes:
        mass: Mass [kg].
        centre: Centre of mass [m], shape (3,).
        inertia: Inertia tensor about the centre of mass, along the axes of the frame [kg m^2], shape (3, 3).
    """

    mass: float
    centre: Float64Array
    inertia: Float64Array


def check_size(mesh: trimesh.Trimesh, name: str) -> float:
    """Return the longest extent of a mesh [m].

    Args:
        mesh: Surface [m].
        name: Name of the mesh in error messages.

    Raises:
        InputError: If the mesh is empty, is not finite, or has a size that indicates wrong units.
    """
    if len(mesh.faces) == 0:
        raise InputError(f"{name}: the mesh must have faces (got none)")
    if not np.isfinite(mesh.vertices).all():
        row = int(np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))[0])
        raise InputError(f"{name}: mesh vertices must be finite (got {mesh.vertices[row].tolist()} at vertex {row})")
    size = float(mesh.extents.max())
    if not _MIN_SIZE <= size <= _MAX_SIZE:
        raise InputError(
            f"{name}: the mesh must be {_MIN_SIZE} m to {_MAX_SIZE} m across, in metres (got {size:g} m: wrong units?)"
        )
    return size


def prepare_mesh(mesh: trimesh.Trimesh, name: str, *, solid: bool = True) -> trimesh.Trimesh:
    """Return a welded copy for physics, with at most 200,000 triangles.

    Faces are oriented so that the volume is positive. Repairs are logged in one sentence.

    Args:
        mesh: Surface [m]; it may be inside out or have holes.
        name: Name of the mesh in messages.
        solid: True if the mesh must enclose a volume, as objects must. A scan of the environment need not. If it is
            open, its faces and holes are kept.

    Raises:
        InputError: If the mesh is empty, is not finite, has no volume, or has a size that indicates wrong units.
    """
    size = check_size(mesh, name)
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    welded.update_faces(welded.nondegenerate_faces())
    welded.remove_unreferenced_vertices()
    if solid:
        welded = close_holes(welded)  # where slivers were removed
    # Divergence theorem: sum of the tetrahedra from the centre to each triangle. Holes matter least from there.
    volume = float(np.linalg.det(welded.triangles - mesh.bounds.mean(axis=0)).sum()) / 6
    if volume < 0 and (solid or is_closed(welded)):  # an open scan has no inside
        _logger.warning("%s: the mesh is inside out; physics flips its faces", name)
        welded.invert()
    if solid and welded.is_watertight and welded.is_winding_consistent:
        welded = _with_outward_bodies(welded, name)
        volume = float(welded.volume)
    if solid and abs(volume) < 1e-6 * size**3:
        raise InputError(
            f"{name}: the mesh must enclose a volume (got {abs(volume):.3g} m^3 at {size:g} m across): "
            "is it open or flat?"
        )
    if solid and not is_closed(welded):
        _logger.warning("%s: the mesh is not closed; mass and inertia are those of its convex pieces", name)
    if len(welded.faces) > _MAX_FACES:
        _logger.warning("%s: physics simplifies the mesh of %d to %d triangles", name, len(welded.faces), _MAX_FACES)
        welded = welded.simplify_quadric_decimation(face_count=_MAX_FACES)
    return welded


def _with_outward_bodies(mesh: trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    """Return a closed mesh whose bodies beside others are not inside out; their volumes would be subtracted.

    Surfaces of negative volume inside another surface are cavities, and stay.
    """
    surface = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    volumes = np.bincount(surface, weights=np.linalg.det(mesh.triangles - mesh.bounds.mean(axis=0)))
    faces, flipped = mesh.faces.copy(), 0
    for number in np.flatnonzero(volumes < -_MIN_SHARE * np.abs(volumes).sum()):
        own = surface == number
        rest = trimesh.Trimesh(mesh.vertices, mesh.faces[~own], process=False)
        if not points_inside(rest, mesh.triangles[own][0, :1]).all():
            faces[own] = faces[own, ::-1]
            flipped += 1
    if not flipped:
        return mesh
    _logger.warning(
        "%s: bodies of the mesh are inside out; physics flips their faces (%d of %d surfaces)",
        name,
        flipped,
        len(volumes),
    )
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def mass_properties(
    mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh], *, density: float, mass: float | None = None
) -> MassProperties:
    """Integrate a uniform density over a mesh, or over its convex pieces if the mesh is not closed.

    Args:
        mesh: Surface of the object [m].
        pieces: Convex pieces of the same object; they may overlap slightly.
        density: Density [kg/m^3]; ignored if ``mass`` is given.
        mass: Mass [kg] or None.
    """
    solid = closed_solid(mesh, pieces)
    actual_density = density if mass is None else mass / float(solid.volume)
    return MassProperties(
        mass=actual_density * float(solid.volume),
        centre=np.array(solid.center_mass, dtype=np.float64),
        inertia=np.array(solid.moment_inertia, dtype=np.float64) * (actual_density / float(solid.density)),
    )


def closed_solid(mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return the mesh if it is closed, else its joined convex pieces."""
    return mesh if is_closed(mesh) else join_meshes(pieces)


def is_closed(mesh: trimesh.Trimesh) -> bool:
    """Return True if the faces enclose solids: they pass each edge equally often in both directions.

    Four faces share an edge where solids touch, or where a coarse solid touches itself. ``is_watertight`` of trimesh
    is then False, although the volume is defined. Faces that are listed twice would count their solid twice, and both
    sides of a sheet without thickness enclose nothing: such meshes are not closed. Nor are those with both sides of a
    whole solid, whose volumes cancel. The faces at which two solids touch end at other faces.
    """
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


def join_meshes(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return all triangles as one mesh."""
    return cast(trimesh.Trimesh, trimesh.util.concatenate(list(meshes)))


def contact_points(mesh: trimesh.Trimesh) -> Float64Array:
    """Return the points at which two solids touch first: vertices, and samples of sharp edges; shape (N, 3) [m].

    If two polyhedra overlap, a vertex of one is inside the other, or two edges cross. Edges are sampled every 0.5 mm,
    or every 1 % of the size if that is larger.
    """
    ends = mesh.vertices[mesh.face_adjacency_edges[mesh.face_adjacency_angles > SHARP]]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    parts = np.ceil(lengths / max(5e-4, 0.01 * float(mesh.extents.max())) - 1e-6).astype(int)
    edge = np.repeat(np.arange(len(ends)), np.maximum(parts - 1, 0))
    step = np.arange(len(edge)) - np.searchsorted(edge, edge) + 1
    share = (step / parts[edge])[:, None]
    between = (1 - share) * ends[edge, 0] + share * ends[edge, 1]
    return np.concatenate([mesh.vertices, between])


def solid_manifold(solid: trimesh.Trimesh) -> manifold3d.Manifold:
    """Return a closed surface as a solid of Manifold, in single precision."""
    # Manifold refuses subclasses of NumPy arrays whose rows are not contiguous. Reordered faces are such arrays.
    vertices = np.ascontiguousarray(solid.vertices, np.float32)
    return manifold3d.Manifold(manifold3d.Mesh(vertices, np.ascontiguousarray(solid.faces, np.uint32)))


def separate_solids(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return the connected surfaces of a closed mesh, each of which has two faces at every edge.

    Surfaces of negative volume are cavities.
    """
    if mesh.is_watertight:
        return list(mesh.split(only_watertight=False))
    surfaces = [solid.to_mesh() for solid in solid_manifold(mesh).decompose()]
    return [trimesh.Trimesh(found.vert_properties[:, :3], found.tri_verts, process=False) for found in surfaces]


def simplify_solid(solid: trimesh.Trimesh, tolerance: float) -> trimesh.Trimesh:
    """Return a closed surface with fewer faces, within about ``tolerance`` [m] of the original (by Manifold)."""
    mesh = solid_manifold(solid).simplify(tolerance).to_mesh()
    simple = trimesh.Trimesh(mesh.vert_properties[:, :3].astype(np.float64), mesh.tri_verts, process=False)
    return simple if simple.is_volume else solid


def check_faces(mesh: trimesh.Trimesh, source: object) -> None:
    """Check that all faces refer to existing vertices, which file readers do not check.

    Raises:
        InputError: If a face refers to a missing vertex. The message begins with the ``source`` of the mesh.
    """
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise InputError(
            f"{source}: not a valid mesh file (a face has vertices {mesh.faces.min()} to {mesh.faces.max()} "
            f"of {len(mesh.vertices)})"
        )
