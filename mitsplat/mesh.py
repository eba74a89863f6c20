"""Proxy meshes for physics: convex pieces, mass and inertia, and the checks before either."""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import coacd
import manifold3d
import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.cache import cache_folder, keep_file
from mitsplat.content_hash import ContentHash
from mitsplat.errors import InputError

_logger = logging.getLogger(__name__)

# Sizes outside of this range are wrong units, not objects of a workcell.
_SMALLEST, _LARGEST = 5e-4, 20.0
# A solid that fills this share of its hull is its hull: what it leaves out is thinner than physics resolves.
_CONVEX = 0.9995
# More parts than this are a scan's debris, which is decomposed as a whole.
_MOST_PARTS = 64
# More triangles than this say nothing about how an object lies, and take CoACD hours.
_MOST_FACES = 200_000
# A mesh of more faces is a scan, whose noise is taken off before it is split: by this share of its size, and no more
# than this [m], a third of what objects may sink into a table.
_SCAN_FACES, _DEVIATION, _MOST_DEVIATION = 3000, 5e-4, 1e-4
# A surface of which sharp valleys are more than this share of all edges, by length, is ragged: no shape, but what is
# left of a bad fit, and comes apart into more pieces than it has faces. Parts and scans have 0.15 at most.
_RAGGED, _RAGGED_THRESHOLD = 0.25, 0.1
# Of CoACD's search for every cut; a scan has more cuts than it has concavities, and any of them will do.
_ITERATIONS, _SCAN_ITERATIONS = 150, 20
# Faces that meet at a larger angle form an edge that can poke into something [rad].
_SHARP = 0.17


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Inertial properties of a rigid body in its own frame.

    Attributes:
        mass: [kg].
        centre: Centre of mass [m], shape (3,).
        inertia: Inertia tensor about the centre of mass, axes of the frame [kg m^2], shape (3, 3).
    """

    mass: float
    centre: Float64Array
    inertia: Float64Array


def prepare_mesh(mesh: trimesh.Trimesh, name: str, *, solid: bool = True) -> trimesh.Trimesh:
    """Return a welded copy for physics, wound so that it encloses a positive volume, of 200,000 triangles at most.

    What is repaired is logged in one sentence.

    Args:
        mesh: Surface [m]; may be wound inside out or have holes.
        name: What to call it in an error.
        solid: Whether it must enclose a volume: objects must, a scan of the surroundings need not.

    Raises:
        InputError: The mesh is empty, not finite, has no volume, or its size tells of wrong units.
    """
    if len(mesh.faces) == 0:
        raise InputError(f"{name}: the mesh must have faces (got none)")
    if not np.isfinite(mesh.vertices).all():
        row = int(np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))[0])
        raise InputError(f"{name}: mesh vertices must be finite (got {mesh.vertices[row].tolist()} at vertex {row})")
    size = float(mesh.extents.max())
    if not _SMALLEST <= size <= _LARGEST:
        raise InputError(
            f"{name}: the mesh must be {_SMALLEST} m to {_LARGEST} m across, in metres (got {size:g} m: wrong units?)"
        )
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    welded.update_faces(welded.nondegenerate_faces())
    welded.remove_unreferenced_vertices()
    welded.fill_holes()  # of three or four edges, such as slivers leave
    # Divergence theorem: tetrahedra from the origin to each triangle.
    volume = float(np.linalg.det(welded.triangles).sum()) / 6
    if volume < 0:
        _logger.warning("%s: the mesh is wound inside out; physics turns its faces", name)
        welded.invert()
    if solid and abs(volume) < 1e-6 * size**3:
        raise InputError(f"{name}: the mesh must enclose a volume (got {abs(volume):.3g} m^3 at {size:g} m across)")
    if solid and not welded.is_watertight:
        _logger.warning("%s: the mesh is not closed; mass and inertia are those of its convex pieces", name)
    if len(welded.faces) > _MOST_FACES:
        _logger.warning("%s: physics simplifies the mesh of %d to %d triangles", name, len(welded.faces), _MOST_FACES)
        welded = welded.simplify_quadric_decimation(face_count=_MOST_FACES)
    return welded


def mass_properties(
    mesh: trimesh.Trimesh,
    pieces: Sequence[trimesh.Trimesh],
    *,
    density: float,
    mass: float | None = None,
) -> MassProperties:
    """Integrate a uniform density over a mesh, or over its convex pieces where the mesh is not watertight.

    Args:
        mesh: Surface of the object [m].
        pieces: Convex pieces of the same object; they may overlap by a little.
        density: [kg/m^3]; ignored where ``mass`` is given.
        mass: [kg] or None.
    """
    solid = mesh if mesh.is_watertight and mesh.is_winding_consistent else join_meshes(pieces)
    actual_density = density if mass is None else mass / float(solid.volume)
    return MassProperties(
        mass=actual_density * float(solid.volume),
        centre=np.array(solid.center_mass, dtype=np.float64),
        inertia=np.array(solid.moment_inertia, dtype=np.float64) * (actual_density / float(solid.density)),
    )


def join_meshes(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """All triangles as one mesh."""
    return cast(trimesh.Trimesh, trimesh.util.concatenate(list(meshes)))


def contact_points(mesh: trimesh.Trimesh) -> Float64Array:
    """Points that touch first when two solids meet: vertices, and points along sharp edges; shape (N, 3) [m].

    Where two polyhedra overlap, a vertex of one is inside the other or two edges cross; edges are sampled every 0.5 mm,
    or 1 % of the size where that is more.
    """
    ends = mesh.vertices[mesh.face_adjacency_edges[mesh.face_adjacency_angles > _SHARP]]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    parts = np.ceil(lengths / max(5e-4, 0.01 * float(mesh.extents.max())) - 1e-6).astype(int)
    edge = np.repeat(np.arange(len(ends)), np.maximum(parts - 1, 0))
    step = np.arange(len(edge)) - np.searchsorted(edge, edge) + 1
    share = (step / parts[edge])[:, None]
    between = (1 - share) * ends[edge, 0] + share * ends[edge, 1]
    return np.concatenate([mesh.vertices, between])


def convex_pieces(mesh: trimesh.Trimesh, *, threshold: float = 0.02) -> tuple[trimesh.Trimesh, ...]:
    """Split a solid into convex pieces whose union follows its surface.

    Parts that are convex stay whole; the others are split by CoACD (Wei et al., *Approximate Convex Decomposition for
    3D Meshes with Collision-Aware Concavity and Tree Search*, 2022). The result is kept in memory and in
    ``$XDG_CACHE_HOME/mitsplat/pieces`` (``~/.cache`` by default), by the hash of the mesh.

    Args:
        mesh: Surface of one object [m].
        threshold: Concavity at which a piece counts as convex, relative to the part's size.
    """
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    return _cached_pieces(vertices.tobytes(), faces.tobytes(), threshold)


@lru_cache(maxsize=256)
def _cached_pieces(vertices: bytes, faces: bytes, threshold: float) -> tuple[trimesh.Trimesh, ...]:
    digest = ContentHash("pieces 3", f"{version('coacd')} {threshold!r}", vertices, faces)
    path = cache_folder() / "pieces" / f"{digest.hexdigest()}.npz"
    pieces = _read_pieces(path)
    if pieces is None:
        mesh = trimesh.Trimesh(
            np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, dtype=np.int64).reshape(-1, 3), process=False
        )
        pieces = tuple(piece for part in _parts(mesh) for piece in _split(part, threshold))
        _write_pieces(path, pieces)
    return pieces


def _parts(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Closed solids that a mesh is made of; the mesh itself where it is open. Cavities are left out."""
    if not mesh.is_watertight:
        mesh.fill_holes()  # a triangle or two that scans lack
    if not mesh.is_watertight:
        return [mesh]
    parts = [part for part in mesh.split(only_watertight=False) if part.volume > 0]
    return parts if 0 < len(parts) <= _MOST_PARTS else [mesh]


def _split(part: trimesh.Trimesh, threshold: float) -> list[trimesh.Trimesh]:
    hull = part.convex_hull
    if part.is_watertight and part.volume >= _CONVEX * hull.volume:
        return [hull]
    # CoACD rebuilds what it thinks no solid from voxels, slowly and a voxel too thick: also solids of which two
    # triangles touch, as in scans.
    scan = len(part.faces) > _SCAN_FACES
    closed = scan and part.is_volume
    solid = simplify_solid(part, min(_DEVIATION * part.scale, _MOST_DEVIATION)) if closed else part
    ragged = _valleys(solid) > _RAGGED
    if ragged:
        threshold = max(threshold, _RAGGED_THRESHOLD)
        _logger.warning(
            "a mesh of %d faces is ragged: physics follows it to %g of its size", len(solid.faces), threshold
        )
    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(solid.vertices, solid.faces),
        threshold=threshold,
        preprocess_mode="off" if closed else "auto",
        mcts_iterations=_SCAN_ITERATIONS if scan or ragged else _ITERATIONS,
        seed=0,
    )
    pieces = [trimesh.Trimesh(vertices, faces, process=False).convex_hull for vertices, faces in found]
    # Slivers carry no contact that their neighbours lack, and have no hull in single precision.
    return [piece for piece in pieces if piece.volume > 1e-6 * hull.volume]


def _valleys(mesh: trimesh.Trimesh) -> float:
    """Share of the edges, by length, at which the surface folds inwards by more than :data:`_SHARP`."""
    ends = mesh.vertices[mesh.face_adjacency_edges]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    sharp = ~mesh.face_adjacency_convex & (mesh.face_adjacency_angles > _SHARP)
    return float(lengths[sharp].sum() / max(lengths.sum(), 1e-300))


def simplify_solid(solid: trimesh.Trimesh, tolerance: float) -> trimesh.Trimesh:
    """A closed surface of fewer faces that follows another to about a ``tolerance`` [m] (Manifold's simplification)."""
    vertices, faces = solid.vertices.astype(np.float32), solid.faces.astype(np.uint32)
    mesh = manifold3d.Manifold(manifold3d.Mesh(vertices, faces)).simplify(tolerance).to_mesh()
    simple = trimesh.Trimesh(mesh.vert_properties[:, :3].astype(np.float64), mesh.tri_verts, process=False)
    return simple if simple.is_volume else solid


def _read_pieces(path: Path) -> tuple[trimesh.Trimesh, ...] | None:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            count = len(stored.files) // 2
            return tuple(
                trimesh.Trimesh(stored[f"vertices_{i}"], stored[f"faces_{i}"], process=False) for i in range(count)
            )
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        _logger.warning("%s: unreadable convex pieces are made anew (%s)", path, error)
        return None


def _write_pieces(path: Path, pieces: Sequence[trimesh.Trimesh]) -> None:
    arrays: dict[str, Any] = {f"vertices_{i}": piece.vertices for i, piece in enumerate(pieces)}
    arrays |= {f"faces_{i}": piece.faces for i, piece in enumerate(pieces)}
    keep_file(path, lambda file: np.savez(file, **arrays))
