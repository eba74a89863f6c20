"""Convex decomposition of solids for physics: few pieces, close to the surface, in seconds."""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import coacd
import manifold3d
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from mitsplat.arrays import Float64Array
from mitsplat.geometry.hull_fit import fit_to_hull
from mitsplat.geometry.mesh import SHARP, contact_points
from mitsplat.geometry.mesh_distance import DistanceSurface, max_outside_distance
from mitsplat.geometry.mesh_holes import close_holes
from mitsplat.geometry.solids import is_closed, separate_solids, simplify_solid
from mitsplat.storage.cache import cache_folder, write_cache_file
from mitsplat.storage.content_hash import ContentHash

_logger = logging.getLogger(__name__)

MAX_PIECES = 32
# Acceptable gap between pieces and mesh [m]; a larger share for objects below 10 mm, a smaller one above 200 mm.
_GAP_LIMIT, _GAP_SHARE_OF_SMALL, _GAP_SHARE_OF_LARGE = 1e-3, 0.1, 0.005
_THRESHOLD = 0.02
# A solid that fills this share of its hull is replaced by the hull. The difference is below the resolution of physics.
_CONVEX = 0.9995
# Minimum volume of a part, as a share of the cube of the diagonal.
_MIN_VOLUME = 1e-12
# More parts than this are debris of a scan, which is decomposed as a whole.
_MAX_PARTS = 64
# A mesh with more faces is a scan. Its noise is removed first, by this share of its size and at most by this distance
# [m], a third of the permitted penetration into a table. More is removed if necessary for few faces.
_SCAN_FACES, _DEVIATION, _MAX_DEVIATION = 3000, 5e-4, 1e-4
_TARGET_FACES, _MAX_ERROR = 5000, 0.003
# A surface is noisy if sharp valleys have more than this share of the length of all edges. It is the result of a bad
# fit and would be split into more pieces than it has faces. Parts and scans have 0.15 at most.
_NOISY, _NOISY_THRESHOLD = 0.25, 0.1
# CoACD search iterations per cut. A scan has more cuts than concavities, so any of them is sufficient. CoACD converts
# an open surface to a thin shell of many faces: with all iterations, a cup of 96 faces takes minutes.
_ITERATIONS, _SCAN_ITERATIONS = 150, 20
# Number of cut planes that are tested along each direction.
_CUTS_PER_AXIS = 15
# Pieces that are cut before joining, per permitted piece; number of pairs whose joint hull is measured per step.
_OVERSHOOT, _PAIRS_PER_STEP = 2, 32
# Safety factor on the limit, because gaps are measured at points; maximum number of sample points on faces; batch size.
_MARGIN, _SAMPLES, _BATCH = 0.75, 8000, 32


def max_gap(size: float) -> float:
    """Return the acceptable gap [m] for an object with a longest extent [m].

    The gap is that between object and support, and that between convex pieces and mesh: 1 mm, but 10 % of the size
    below 10 mm, and 0.5 % above 200 mm.
    """
    return max(min(_GAP_LIMIT, _GAP_SHARE_OF_SMALL * size), _GAP_SHARE_OF_LARGE * size)


def convex_pieces(
    mesh: trimesh.Trimesh, *, threshold: float = _THRESHOLD, max_pieces: int = MAX_PIECES
) -> tuple[trimesh.Trimesh, ...]:
    """Split a solid into convex pieces whose union follows its surface.

    Convex parts stay whole. Parts with few faces are split by CoACD (Wei et al., *Approximate Convex Decomposition for
    3D Meshes with Collision-Aware Concavity and Tree Search*, 2022), whose search would take minutes for scans. Scans
    are cut by the planes that remove most empty volume from the convex hulls. Cutting ends when the gap between pieces
    and surface is acceptable for layouts, or at the maximum number of pieces.
    :func:`mitsplat.geometry.mesh_distance.standoff` measures the gap. The pieces of a closed part get its convex
    hull (:func:`mitsplat.geometry.hull_fit.fit_to_hull`). The result is cached in memory and in
    ``$XDG_CACHE_HOME/mitsplat/pieces`` (``~/.cache`` by default) by the hash of the mesh.

    Args:
        mesh: Surface of one object [m].
        threshold: Concavity below which a piece counts as convex, relative to half of the part's size. For scans, the
            acceptable gap is scaled by the ratio of the threshold to its default.
        max_pieces: Maximum number of pieces of a closed scan.
    """
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    return _cached_pieces(vertices.tobytes(), faces.tobytes(), threshold, max_pieces)


@lru_cache(maxsize=256)
def _cached_pieces(vertices: bytes, faces: bytes, threshold: float, max_pieces: int) -> tuple[trimesh.Trimesh, ...]:
    libraries = f"{version('coacd')} {version('manifold3d')}"  # of meshes with few faces, and of scans
    digest = ContentHash("pieces 12", f"{libraries} {threshold!r} {max_pieces}", vertices, faces)
    path = cache_folder() / "pieces" / f"{digest.hexdigest()}.npz"
    pieces = _read_pieces(path)
    if pieces is None:
        mesh = trimesh.Trimesh(
            np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, dtype=np.int64).reshape(-1, 3), process=False
        )
        pieces = tuple(piece for part in _parts(mesh) for piece in _fit(_split(part, threshold, max_pieces), part))
        _write_pieces(path, pieces)
    return pieces


def _parts(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return the closed solids of a mesh, without cavities; or the mesh itself if it is open."""
    mesh = close_holes(mesh)  # scans lack a few triangles
    if not mesh.is_watertight and not is_closed(mesh):
        return [mesh]
    # Faces between solids that touch may form a surface without a volume.
    parts = [part for part in separate_solids(mesh) if part.volume > _MIN_VOLUME * mesh.scale**3]
    return parts if 0 < len(parts) <= _MAX_PARTS else [mesh]


def _split(part: trimesh.Trimesh, threshold: float, max_pieces: int) -> list[trimesh.Trimesh]:
    """Return the convex pieces of a part: its hull, or by planes for closed scans, else by CoACD."""
    hull = part.convex_hull
    if part.is_watertight and part.volume >= _CONVEX * hull.volume:
        return [hull]
    scan = len(part.faces) > _SCAN_FACES
    if scan and part.is_volume:
        limit = max_gap(float(part.extents.max())) * threshold / _THRESHOLD
        return _Cutter(part, limit).pieces(max_pieces)
    noisy = _concave_edge_share(part) > _NOISY
    if noisy:
        threshold = max(threshold, _NOISY_THRESHOLD)
        _logger.warning(
            "the surface of a mesh of %d faces is noisy: its convex pieces approximate it only to %g of its size",
            len(part.faces),
            threshold,
        )
    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(part.vertices, part.faces),
        threshold=threshold,
        mcts_iterations=_SCAN_ITERATIONS if scan or noisy or not part.is_watertight else _ITERATIONS,
        seed=0,
    )
    pieces = [trimesh.Trimesh(vertices, faces, process=False).convex_hull for vertices, faces in found]
    # Slivers add no contact to those of their neighbours and have no hull in single precision.
    return [piece for piece in pieces if piece.volume > 1e-6 * hull.volume]


def _fit(pieces: Sequence[trimesh.Trimesh], part: trimesh.Trimesh) -> Sequence[trimesh.Trimesh]:
    """Give the pieces of a closed solid its convex hull. CoACD's pieces of an open surface are thicker than it."""
    return fit_to_hull(pieces, part, reach=max_gap(float(part.extents.max()))) if part.is_volume else pieces


def _concave_edge_share(mesh: trimesh.Trimesh) -> float:
    """Return the share of edges, by length, at which the surface folds inwards by more than :data:`SHARP`."""
    ends = mesh.vertices[mesh.face_adjacency_edges]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    sharp = ~mesh.face_adjacency_convex & (mesh.face_adjacency_angles > SHARP)
    return float(lengths[sharp].sum() / max(lengths.sum(), 1e-300))


def denoise_solid(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    """Simplify a closed surface and remove its noise.

    The result has at most 5000 faces, or the minimum number within 0.3 % of the size (diagonal).
    """
    tolerance = min(_DEVIATION * solid.scale, _MAX_DEVIATION)
    thin = simplify_solid(solid, tolerance)
    while len(thin.faces) > _TARGET_FACES:
        tolerance *= 1.2
        thinner = simplify_solid(solid, tolerance)
        if _largest_distance(solid, thinner) > _MAX_ERROR * solid.scale:
            break
        thin = thinner
    return thin


def _largest_distance(first: trimesh.Trimesh, second: trimesh.Trimesh) -> float:
    """Return the maximum distance between two surfaces [m], at the vertices and sample points of each."""
    points = [np.concatenate([mesh.vertices, mesh.sample(_SAMPLES, seed=0)]) for mesh in (first, second)]
    surfaces = DistanceSurface(first), DistanceSurface(second)
    return max(float(surface.nearest(other)[2].max()) for surface, other in zip(surfaces, points[::-1], strict=True))


@dataclass(frozen=True, eq=False)
class _Piece:
    """Part of a solid in one cell.

    Attributes:
        body: The part.
        hull: Its convex hull.
        gap: Maximum distance of the hull from the solid [m].
    """

    body: manifold3d.Manifold
    hull: manifold3d.Manifold
    gap: float


class _Cutter:
    """Recursive cutting of a solid by planes.

    The piece with the largest gap is cut next, by the plane that removes most empty volume from the hulls. The empty
    volume is weighted with the volume of the hull. This cuts the rim off a can, although the hull of the rim is as
    empty.

    Args:
        part: The solid.
        limit: Acceptable gap between pieces and solid [m].
    """

    def __init__(self, part: trimesh.Trimesh, limit: float) -> None:
        self._solid = _manifold(denoise_solid(part))
        self._surface, self._limit = DistanceSurface(part), _MARGIN * limit
        self._min_volume = 1e-6 * self._solid.hull().volume()  # slivers add no contact
        self._points = _mesh(self._solid).vertices
        self._contact_distance = 1e-4 * part.scale

    def pieces(self, max_pieces: int) -> list[trimesh.Trimesh]:
        """Return at most ``max_pieces`` convex pieces.

        More pieces are cut at first. They are then joined where that adds the smallest gap.
        """
        pieces = [self._piece(self._solid)]
        done: list[_Piece] = []
        while pieces and len(pieces) + len(done) < _OVERSHOOT * max_pieces:
            worst = max(range(len(pieces)), key=lambda i: pieces[i].gap)
            if pieces[worst].gap <= self._limit:
                break
            piece = pieces.pop(worst)
            cut = [self._piece(body) for body in _best_cut(piece.body, self._limit) if body.volume() > self._min_volume]
            if len(cut) > 1:
                pieces += cut
            else:
                done.append(piece)
        return [_mesh(hull).convex_hull for hull in self._join(pieces + done, max_pieces)]

    def _piece(self, body: manifold3d.Manifold) -> _Piece:
        hull = body.hull()
        return _Piece(body, hull, self._gap(hull))

    def _gap(self, hull: manifold3d.Manifold) -> float:
        """Return the maximum distance of a hull from the solid [m]; 0 if it is below the limit."""
        mesh = _mesh(hull)
        low, high = mesh.bounds
        inside = self._points[((self._points > low) & (self._points < high)).all(axis=1)]
        normals, offsets = np.split(ConvexHull(mesh.vertices).equations, [3], axis=1)
        depths = -(inside @ normals.T + offsets.T)
        face = depths.argmin(axis=1)
        depth = depths[np.arange(len(inside)), face][:, None]
        above = (inside + depth * normals[face])[depth[:, 0] > self._limit]
        samples = min(_SAMPLES, round(float(mesh.area) / (3 * self._limit) ** 2))
        points = np.concatenate([above, contact_points(mesh), mesh.sample(samples, seed=0)])
        return max_outside_distance(self._surface, points, min_distance=self._limit, batch=_BATCH)

    def _join(self, pieces: Sequence[_Piece], max_pieces: int) -> list[manifold3d.Manifold]:
        """Join pieces if the gap of their common hull is acceptable, or if there are too many; return all hulls."""
        hulls: dict[int, manifold3d.Manifold] = {}
        joints: dict[tuple[int, int], tuple[float, manifold3d.Manifold]] = {}
        gaps: dict[tuple[int, int], float] = {}

        def add(new: int, hull: manifold3d.Manifold) -> None:
            low, high = np.reshape(hull.bounding_box(), (2, 3)) + self._contact_distance * np.array([[-1.0], [1.0]])
            for old, other in hulls.items():
                corners = np.reshape(other.bounding_box(), (2, 3))
                if (low <= corners[1]).all() and (corners[0] <= high).all():
                    joint = manifold3d.Manifold.batch_hull([other, hull])
                    joints[old, new] = joint.volume() - other.volume() - hull.volume(), joint
            hulls[new] = hull

        numbers = count()
        for piece in pieces:
            add(next(numbers), piece.hull)
        while joints:
            # Gaps are slow to measure, so only the pairs that add the least empty volume are tested.
            candidates = sorted(joints, key=lambda pair: (joints[pair][0], pair))[:_PAIRS_PER_STEP]
            gaps |= {pair: self._gap(joints[pair][1]) for pair in candidates if pair not in gaps}
            pair = min(candidates, key=lambda pair: (gaps[pair], pair))
            if gaps[pair] > self._limit and len(hulls) <= max_pieces:
                break
            joint = joints[pair][1]
            joints = {other: found for other, found in joints.items() if not {*pair} & {*other}}
            for number in pair:
                del hulls[number]
            add(next(numbers), joint)
        return list(hulls.values())


def _best_cut(body: manifold3d.Manifold, min_thickness: float) -> list[manifold3d.Manifold]:
    """Return the connected parts of a body on both sides of the plane with the least empty volume.

    If no plane is valid, the body itself is returned.

    Args:
        body: Body to cut.
        min_thickness: Minimum distance of the plane from the ends of the body [m].
    """
    mesh = _mesh(body)
    _, principal = np.linalg.eigh(np.cov(mesh.vertices.T))
    best, plane = np.inf, (np.zeros(3), 0.0)

    def search(normal: Float64Array, low: float, high: float) -> None:
        nonlocal best, plane
        heights = mesh.vertices @ normal
        low, high = max(low, float(heights.min()) + min_thickness), min(high, float(heights.max()) - min_thickness)
        for offset in np.linspace(low, high, _CUTS_PER_AXIS) if low < high else ():
            empty_volume = _weighted_empty_volume(mesh, heights - offset, offset * normal)
            if empty_volume < best:
                best, plane = empty_volume, (normal, float(offset))

    for normal in (*np.eye(3), *principal.T):
        search(normal, -np.inf, np.inf)
    if best == np.inf:
        return [body]
    normal, offset = plane
    step = float(np.ptp(mesh.vertices @ normal)) / _CUTS_PER_AXIS
    search(normal, offset - step, offset + step)
    return [part for side in body.split_by_plane(*plane) for part in side.decompose()]


def _weighted_empty_volume(mesh: trimesh.Trimesh, heights: Float64Array, origin: Float64Array) -> float:
    """Return the sum over the hulls on both sides of a plane through ``origin`` of empty volume times hull volume."""
    above = heights > 0
    if above.all() or not above.any():
        return np.inf
    ends = mesh.edges_unique[above[mesh.edges_unique].sum(axis=1) == 1]
    share = heights[ends[:, 0]] / (heights[ends[:, 0]] - heights[ends[:, 1]])
    rim = mesh.vertices[ends[:, 0]] + share[:, None] * (mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]])
    # Tetrahedra have their tips in the plane, so that the cut face adds no volume. If the plane cuts one corner off a
    # triangle, the volume of that corner is proportional to the product of the cut shares of both edges.
    volumes = np.linalg.det(mesh.triangles - origin) / 6
    corners = heights[mesh.faces]
    high = (corners > 0).sum(axis=1)
    upper = volumes[high == 3].sum()
    for one_above in (True, False):
        cut = high == (1 if one_above else 2)
        tip, *others = np.sort(corners[cut] if one_above else -corners[cut], axis=1).T[::-1]
        corner = volumes[cut] * tip**2 / ((tip - others[0]) * (tip - others[1]))
        upper += corner.sum() if one_above else (volumes[cut] - corner).sum()
    total = 0.0
    for side, volume in ((above, upper), (~above, volumes.sum() - upper)):
        hull = manifold3d.Manifold.hull_points(np.concatenate([mesh.vertices[side], rim])).volume()
        total += hull * max(0.0, hull - volume)
    return float(total)


def _manifold(solid: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(
        manifold3d.Mesh64(np.asarray(solid.vertices, np.float64), np.asarray(solid.faces, np.uint64))
    )


def _mesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False)


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
        _logger.warning("%s: cached convex pieces are unreadable and are computed again (%s)", path, error)
        return None


def _write_pieces(path: Path, pieces: Sequence[trimesh.Trimesh]) -> None:
    arrays: dict[str, Any] = {f"vertices_{i}": piece.vertices for i, piece in enumerate(pieces)}
    arrays |= {f"faces_{i}": piece.faces for i, piece in enumerate(pieces)}
    write_cache_file(path, lambda file: np.savez(file, **arrays))
