"""Flat Gaussians on a surface: blue-noise placement, spacing that follows detail, and shapes that stop at edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CREASE_ANGLE = np.radians(28.0)
"""Dihedral angle above which an edge is a crease [rad]: Gaussians must not cross it, normals are not smoothed."""

_PACKING = 0.62
"""Points per area r^2 of the sets that :func:`poisson_subset` keeps, measured on a plane (0.70 at saturation)."""
_CANDIDATES = 5.0
"""Candidates per area r^2 that make the set nearly maximal."""
_NORMAL_WEIGHT = 0.6
"""Distance, in units of r, that two opposite normals add to: keeps the two sides of thin sheets apart."""
_PROBES = 4
"""Points per Gaussian at which the surface is tested for gaps."""
_LEAK = 0.03
"""Largest share of light that may pass between Gaussians at a probe."""
_CLOSING_ROUNDS = 10
_CREASE_NEIGHBOURS = 16
_EDGE_SIGMAS = 2.1
"""Standard deviations of a disc between its centre and the nearest crease."""
_THINNEST = 0.16
"""Least standard deviation along the surface in units of the local spacing, however near a crease is."""
_THICKNESS = 0.035
"""Standard deviation along the normal in units of the local spacing."""
_EDGE_REFINEMENT = 0.6
"""Spacing at creases relative to the spacing away from them."""


@dataclass(frozen=True, eq=False)
class Surfels:
    """Points of a surface with frames and extents.

    Attributes:
        points: Centres, just below the surface [m], shape (N, 3).
        frames: Rotations whose columns are two tangents and the outward normal, shape (N, 3, 3).
        scales: Standard deviations along the columns of ``frames`` [m], shape (N, 3).
        faces: Face that each point lies on, shape (N,).
        barycentric: Coordinates in that face, shape (N, 3).
    """

    points: FloatArray
    frames: FloatArray
    scales: FloatArray
    faces: IntArray
    barycentric: FloatArray

    @property
    def normals(self) -> FloatArray:
        """Outward unit normals, shape (N, 3)."""
        return self.frames[:, :, 2]

    @property
    def quats(self) -> FloatArray:
        """Orientations, xyzw, shape (N, 4)."""
        return np.asarray(Rotation.from_matrix(self.frames).as_quat())

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, keep: npt.NDArray[np.bool_]) -> Surfels:
        """Those points where ``keep`` (N,) is true."""
        return Surfels(
            self.points[keep], self.frames[keep], self.scales[keep], self.faces[keep], self.barycentric[keep]
        )


def place_surfels(
    mesh: trimesh.Trimesh, density: npt.ArrayLike, count: int, rng: np.random.Generator, *, spread: float = 0.72
) -> Surfels:
    """About ``count`` surfels on ``mesh``.

    Args:
        mesh: Surface; vertices at one position should be merged, so that creases are known.
        density: Relative density of points on every face, shape (F,), > 0.
        count: How many points to aim for.
        rng: Source of randomness.
        spread: Standard deviation along the surface in units of the local spacing.
    """
    area = mesh.area_faces
    density = np.broadcast_to(np.asarray(density, dtype=np.float64), area.shape)
    creases = _CreaseIndex.build(mesh, spacing=np.sqrt(area.sum() / count) / 2.0)
    extra = _edge_share(creases, area, density, count)
    spacing = np.sqrt(_PACKING * (area * density).sum() * (1.0 + extra) / count / density)

    reach = float(spacing.max())
    points, faces, barycentric = _draw(mesh, area / spacing**2, _CANDIDATES, rng)
    distance = creases.distance(points, reach)
    fine_points, fine_faces, fine_barycentric = _draw(
        mesh, area / spacing**2, _CANDIDATES * (_EDGE_REFINEMENT**-2 - 1.0), rng
    )
    fine_distance = creases.distance(fine_points, reach)
    near = fine_distance < spacing[fine_faces]
    points = np.concatenate([points, fine_points[near]])
    faces = np.concatenate([faces, fine_faces[near]])
    barycentric = np.concatenate([barycentric, fine_barycentric[near]])
    distance = np.concatenate([distance, fine_distance[near]])

    radius = spacing[faces] * np.clip(distance / spacing[faces], _EDGE_REFINEMENT, 1.0)
    normals = mesh.face_normals[faces]
    kept = poisson_subset(points, normals, radius, rng)
    frames, room = _shape(normals[kept], points[kept], radius[kept], creases)
    probe = rng.choice(len(points), size=min(len(points), _PROBES * len(kept)), replace=False)
    probe = probe[distance[probe] > 0.3 * radius[probe]]
    radius = radius[kept, None]
    widest = np.clip(room / _EDGE_SIGMAS, _THINNEST * radius, 1.6 * spread * radius)
    scales = np.concatenate([np.minimum(widest, spread * radius), _THICKNESS * radius], axis=1)
    scales = _closed(points[kept], frames, scales, widest, points[probe], normals[probe])
    # Centres sink below the surface so that the outer sides of the discs lie on it.
    centres = points[kept] - 1.5 * scales[:, 2:] * normals[kept]
    return Surfels(centres, frames, scales, faces[kept], barycentric[kept])


def poisson_subset(
    points: FloatArray, normals: FloatArray, radius: FloatArray, rng: np.random.Generator
) -> IntArray:
    """Indices of a Poisson-disk subset of ``points`` (N, 3): kept points are at least their ``radius`` (N,) apart.

    The parallel form of dart throwing (maximal independent set by random priorities, Luby 1986), from fine radii to
    coarse ones. Opposite ``normals`` (N, 3) count as distance.
    """
    level = np.ceil(2.0 * np.log2(radius / radius.min()) - 1e-9).astype(int)
    kept: list[IntArray] = []
    for current in np.unique(level):
        index = np.flatnonzero(level == current)
        reach = float(radius[index].max())
        lifted = np.concatenate([points, _NORMAL_WEIGHT * reach * normals], axis=1)
        if kept:
            finer = KDTree(lifted[np.concatenate(kept)])
            gap, _ = finer.query(lifted[index], distance_upper_bound=0.85 * reach)
            index = index[np.isinf(gap)]
        pairs = KDTree(lifted[index]).query_pairs(reach, output_type="ndarray")
        kept.append(index[_independent_set(len(index), pairs, rng)])
    return np.sort(np.concatenate(kept))


def _independent_set(count: int, pairs: IntArray, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Maximal independent set of a graph of ``count`` nodes with edges ``pairs`` (P, 2)."""
    priority = rng.permutation(count)
    alive, chosen = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    while alive.any():
        beaten = np.zeros(count, dtype=bool)
        beaten[np.where(priority[pairs[:, 0]] > priority[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
        winners = alive & ~beaten
        chosen |= winners
        alive &= ~winners
        alive[pairs[winners[pairs[:, 0]], 1]] = False
        alive[pairs[winners[pairs[:, 1]], 0]] = False
        pairs = pairs[alive[pairs].all(axis=1)]
    return chosen


def _draw(
    mesh: trimesh.Trimesh, expected: FloatArray, factor: float, rng: np.random.Generator
) -> tuple[FloatArray, IntArray, FloatArray]:
    """``factor`` times ``expected`` (F,) points per face: positions, faces, barycentric coordinates."""
    weights = expected / expected.sum()
    faces = np.sort(rng.choice(len(weights), size=max(1, int(factor * expected.sum())), p=weights))
    u, v = rng.random((2, len(faces)))
    root = np.sqrt(u)
    barycentric = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    return np.einsum("nk,nkd->nd", barycentric, mesh.triangles[faces]), faces, barycentric


def _edge_share(creases: _CreaseIndex, area: FloatArray, density: FloatArray, count: int) -> float:
    """Extra points that refinement at creases costs, as a share of ``count``."""
    spacing = np.sqrt(area.sum() / count)
    strip = 2.0 * creases.length * 0.5 * spacing * (_EDGE_REFINEMENT**-2 - 1.0)
    return float(min(strip / area.sum(), _EDGE_REFINEMENT**-2 - 1.0))


def _shape(
    normals: FloatArray, points: FloatArray, radius: FloatArray, creases: _CreaseIndex
) -> tuple[FloatArray, FloatArray]:
    """Frames (N, 3, 3), first axis towards the nearest crease, and the distances (N, 2) [m] to creases along the axes."""
    towards = creases.offsets(points, _CREASE_NEIGHBOURS)
    in_plane = towards - np.einsum("nkd,nd->nk", towards, normals)[..., None] * normals[:, None]
    distance = np.linalg.norm(in_plane, axis=2)
    # What lies far above or below belongs to another surface.
    distance[distance < 0.5 * np.linalg.norm(towards, axis=2)] = np.inf
    nearest = np.argmin(distance, axis=1)[:, None]
    bounded = np.take_along_axis(distance, nearest, axis=1) < 4.0 * radius[:, None]
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.where(bounded, np.take_along_axis(in_plane, nearest[..., None], axis=1)[:, 0], np.cross(normals, helper))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first), normals], axis=2)
    along = np.abs(np.einsum("nkd,ndi->nki", in_plane, frames[:, :, :2]))
    ahead = np.isfinite(distance)[..., None] & (along > 0.7 * np.minimum(distance, 1e6)[..., None])
    return frames, np.where(ahead, along, np.inf).min(axis=1)


def _closed(
    centres: FloatArray,
    frames: FloatArray,
    scales: FloatArray,
    widest: FloatArray,
    probes: FloatArray,
    normals: FloatArray,
) -> FloatArray:
    """``scales`` (N, 3), grown up to ``widest`` (N, 2) until little light passes between discs at ``probes`` (P, 3)."""
    _, index = KDTree(centres).query(probes, k=min(12, len(centres)))
    local = np.einsum("pkj,pkji->pki", probes[:, None] - centres[index], frames[index][..., :2])
    facing = np.einsum("pkj,pj->pk", frames[index][..., 2], normals) > 0.7
    scales = scales.copy()
    for _ in range(_CLOSING_ROUNDS):
        response = np.exp(-0.5 * ((local / scales[index][..., :2]) ** 2).sum(axis=2)) * facing
        leaking = np.prod(1.0 - response, axis=1) > _LEAK
        if not leaking.any():
            break
        strongest = np.take_along_axis(index[leaking], np.argsort(-response[leaking], axis=1)[:, :2], axis=1)
        grown = np.unique(strongest)
        scales[grown, :2] = np.minimum(1.08 * scales[grown, :2], widest[grown])
    return scales


@dataclass(frozen=True, eq=False)
class _CreaseIndex:
    """Nearest-point queries against the creases and boundaries of a mesh, as a dense set of points on them."""

    tree: KDTree | None
    starts: FloatArray
    units: FloatArray
    lengths: FloatArray
    owner: IntArray

    @classmethod
    def build(cls, mesh: trimesh.Trimesh, spacing: float) -> _CreaseIndex:
        sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > CREASE_ANGLE]
        boundary = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
        edges = np.concatenate([sharp, boundary]).astype(int)
        start, along = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]]
        length = np.linalg.norm(along, axis=1)
        steps = np.maximum(1, np.ceil(length / spacing).astype(int))
        owner = np.repeat(np.arange(len(edges)), steps)
        fraction = (np.arange(len(owner)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[owner]
        tree = KDTree(start[owner] + fraction[:, None] * along[owner]) if len(edges) else None
        return cls(tree, start, along / np.maximum(length, 1e-12)[:, None], length, owner)

    @property
    def length(self) -> float:
        """Length of all creases [m]."""
        return float(self.lengths.sum())

    def distance(self, points: FloatArray, reach: float) -> FloatArray:
        """Distances (N,) [m] to the nearest crease; infinite beyond ``reach`` [m] or without creases."""
        if self.tree is None:
            return np.full(len(points), np.inf)
        return np.asarray(self.tree.query(points, distance_upper_bound=reach)[0])

    def offsets(self, points: FloatArray, count: int) -> FloatArray:
        """Vectors (N, ``count``, 3) to the nearest points of the nearest creases, far away without creases."""
        if self.tree is None:
            return np.full((len(points), count, 3), 1e6)
        _, index = self.tree.query(points, k=np.arange(1, count + 1))
        segment = self.owner[np.minimum(index, len(self.owner) - 1)]
        from_start = points[:, None] - self.starts[segment]
        position = np.einsum("nkd,nkd->nk", from_start, self.units[segment])
        position = np.clip(position, 0.0, self.lengths[segment])
        return position[..., None] * self.units[segment] - from_start
