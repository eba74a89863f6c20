"""Proxy meshes for physics: validation, mass, inertia and contact points."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.mesh_holes import close_holes
from mitsplat.geometry.solids import is_closed, join_meshes, turn_outwards, unite_bodies

_logger = logging.getLogger(__name__)

# Sizes outside of this range indicate wrong units [m].
_MIN_SIZE, _MAX_SIZE = 5e-4, 20.0
# More triangles do not change how an object rests, and CoACD takes hours for them.
_MAX_FACES = 200_000
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
    closed = is_closed(welded)
    turned, surfaces = 0, 1
    if solid and closed:
        welded, turned, surfaces = turn_outwards(welded)
    # Divergence theorem: sum of the tetrahedra from the centre to each triangle. Holes matter least from there.
    volume = float(np.linalg.det(welded.triangles - mesh.bounds.mean(axis=0)).sum()) / 6
    if volume < 0 and (solid or closed):  # an open scan has no inside
        welded.invert()
        turned = surfaces
    if turned == surfaces:
        _logger.warning("%s: the mesh is inside out; physics flips its faces", name)
    elif turned:
        text = "%s: bodies of the mesh are inside out; physics flips their faces (%d of %d surfaces)"
        _logger.warning(text, name, turned, surfaces)
    if solid and abs(volume) < 1e-6 * size**3:
        raise InputError(
            f"{name}: the mesh must enclose a volume (got {abs(volume):.3g} m^3 at {size:g} m across): "
            "is it open or flat?"
        )
    if solid and not closed:
        _logger.warning("%s: the mesh is not closed; mass and inertia are those of its convex pieces", name)
    if len(welded.faces) > _MAX_FACES:
        _logger.warning("%s: physics simplifies the mesh of %d to %d triangles", name, len(welded.faces), _MAX_FACES)
        welded = welded.simplify_quadric_decimation(face_count=_MAX_FACES)
    return welded


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
    """Return the solid of a closed mesh, without overlaps and bodies that are inside out, else the convex pieces."""
    return unite_bodies(turn_outwards(mesh)[0]) if is_closed(mesh) else join_meshes(pieces)


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
