"""Flat Gaussians on a surface: blue-noise placement, spacing that follows detail, and discs that end at creases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.gaussians.poisson_disks import PACKING, poisson_subset, query_neighbours
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.mesh_normals import CREASE_ANGLE

_OPACITY = 0.98
_CANDIDATES = 5.0
"""Candidates per area r^2, sufficient for a nearly maximal set."""
_PROBES = 4
"""Points per Gaussian at which the surface is tested for gaps."""
_MAX_TRANSMITTANCE = 0.02
"""Maximum transmittance between Gaussians at a probe."""
_CLOSING_ROUNDS = 14
_ROW_OFFSET = 0.45
"""Distance of surfel rows from a crease, in units of the local spacing."""
_CREASE_NEIGHBOURS = 16
_EDGE_SIGMAS = 1.5
"""Standard deviations of a disc between its centre and the nearest crease."""
_SPREAD = 0.72
"""Standard deviation along the surface, in units of the local spacing."""
_MIN_SPREAD = 0.27
"""Minimum standard deviation along the surface near a crease, in units of the local spacing."""
_THICKNESS = 0.035
"""Standard deviation along the normal, in units of the local spacing."""
_REFINEMENT = 0.55
"""Spacing at creases and tight bends, relative to the spacing elsewhere."""
_BEND = 0.5
"""Angle [rad] between neighbouring surfels above which the spacing is reduced."""
_OVERHANG = 0.15
"""Maximum height of disc tips above a bent surface, in standard deviations of an unconstrained disc."""
_SHARES = (2.0, 1.6, 1.25, 1.0, 0.8, 0.63, 0.5)
"""Disc sizes that are tested against the overhang limit, relative to an unconstrained disc."""
_COUNT_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Surfels:
    """Surface points with frames and extents.

    Attributes:
        points: Positions on the surface [m], shape (N, 3).
        frames: Rotations whose columns are two tangents and the outward normal, shape (N, 3, 3).
        scales: Standard deviations along the columns of ``frames`` [m], shape (N, 3).
        faces: Index of the face of each point, shape (N,).
        barycentric: Barycentric coordinates in the face, shape (N, 3).
    """

    points: Float64Array
    frames: Float64Array
    scales: Float64Array
    faces: Int64Array
    barycentric: Float64Array

    @property
    def centres(self) -> Float64Array:
        """Gaussian centres for which the outer sides of the Gaussians lie on the surface [m], shape (N, 3)."""
        return self.points - 1.5 * self.scales[:, 2:] * self.normals

    def splats(self, sh: Float64Array) -> Splats:
        """Return nearly opaque Gaussians of these shapes with SH coefficients (N, K, 3)."""
        return Splats(
            means=self.centres.astype(np.float32),
            quats=self.quats.astype(np.float32),
            scales=self.scales.astype(np.float32),
            opacities=np.full(len(self), _OPACITY, dtype=np.float32),
            sh=sh.astype(np.float32),
        )

    @property
    def normals(self) -> Float64Array:
        """Outward unit normals, shape (N, 3)."""
        return self.frames[:, :, 2]

    @property
    def quats(self) -> Float64Array:
        """Orientations, xyzw, shape (N, 4)."""
        return np.asarray(Rotation.from_matrix(self.frames).as_quat())

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, keep: BoolArray) -> Surfels:
        """Return the surfels where ``keep`` (N,) is true."""
        return Surfels(
            self.points[keep], self.frames[keep], self.scales[keep], self.faces[keep], self.barycentric[keep]
        )


def place_surfels(mesh: trimesh.Trimesh, density: npt.ArrayLike, count: int, rng: np.random.Generator) -> Surfels:
    """Place about ``count`` surfels on ``mesh``.

    Args:
        mesh: Surface. Vertices at the same position should be merged, so that creases are found.
        density: Relative density of points on every face, shape (F,), > 0.
        count: Target number of surfels.
        rng: Random generator.
    """
    area = mesh.area_faces
    density = np.broadcast_to(np.asarray(density, dtype=np.float64), area.shape)
    spacing = np.sqrt(PACKING * (area * density).sum() / count / density)
    creases = _CreaseIndex.build(mesh, spacing / 2.0)
    for _ in range(_COUNT_ROUNDS):
        pool = _Pool.draw(mesh, spacing, creases, rng)
        rows = creases.rows(pool, _ROW_OFFSET)
        kept = poisson_subset(pool.points, pool.normals, pool.radius, rng, first=rows)
        if abs(len(kept) / count - 1.0) < 0.08:
            break
        spacing = spacing * np.sqrt(len(kept) / count)
    radius = pool.radius[kept, None]
    frames, room = _frames(pool.normals[kept], pool.points[kept], pool.radius[kept], creases)
    widest = np.clip(room / _EDGE_SIGMAS, _MIN_SPREAD * radius, _SHARES[0] * _SPREAD * radius)
    bent = pool.uneven[kept]
    widest[bent] = np.minimum(
        widest[bent], _overhang_limit(pool, pool.points[kept][bent], frames[bent], radius[bent] * _SPREAD)
    )
    scales = np.concatenate([np.minimum(widest, _SPREAD * radius), _THICKNESS * radius], axis=1)
    probe = rng.choice(len(pool.points), size=min(len(pool.points), _PROBES * len(kept)), replace=False)
    probe = probe[pool.crease_distance[probe] > 0.15 * pool.radius[probe]]
    scales = _close_gaps(pool.points[kept], frames, scales, widest, pool.points[probe], pool.normals[probe])
    return Surfels(pool.points[kept], frames, scales, pool.faces[kept], pool.barycentric[kept])


@dataclass(frozen=True, eq=False)
class _Pool:
    """Candidate points, several per surfel, with a density in proportion to that of the surfels.

    Attributes:
        points: Positions [m], shape (P, 3).
        normals: Unit normals of their faces, shape (P, 3).
        faces: Face indices, shape (P,).
        barycentric: Barycentric coordinates, shape (P, 3).
        radius: Minimum distance to other surfels [m], shape (P,).
        crease_distance: Distance to the nearest crease [m], infinite where it is far, shape (P,).
        uneven: Mask of the points near a possible crease or bend, shape (P,).
    """

    points: Float64Array
    normals: Float64Array
    faces: Int64Array
    barycentric: Float64Array
    radius: Float64Array
    crease_distance: Float64Array
    uneven: BoolArray

    @classmethod
    def draw(
        cls, mesh: trimesh.Trimesh, spacing: Float64Array, creases: _CreaseIndex, rng: np.random.Generator
    ) -> _Pool:
        """Draw candidates for surfels at distances ``spacing`` (F,), which are reduced near creases and bends."""
        expected = mesh.area_faces / spacing**2
        points, faces, barycentric = _draw(mesh, expected, _CANDIDATES, rng)
        distance, bend = np.full(len(points), np.inf), np.zeros(len(points))
        # Flat regions, often most of a surface, need no distance queries.
        uneven = _uneven_faces(mesh, spacing, creases)
        reach = float(spacing[uneven].max(initial=0.0))
        look = uneven[faces]
        distance[look] = creases.distance(points[look], reach)
        extra = _draw(mesh, expected * uneven, _CANDIDATES * (_REFINEMENT**-2 - 1.0), rng)
        extra_distance, extra_bend = creases.distance(extra[0], reach), np.zeros(len(extra[0]))
        if look.any():
            tree = KDTree(points[look])
            bend[look] = _bend(tree, mesh.face_normals[faces[look]], spacing[faces[look]])
            extra_bend = bend[look][query_neighbours(tree, extra[0])[1]]
        near = (extra_distance < spacing[extra[1]]) | (extra_bend > _BEND)
        points = np.concatenate([points, extra[0][near]])
        faces = np.concatenate([faces, extra[1][near]])
        barycentric = np.concatenate([barycentric, extra[2][near]])
        distance = np.concatenate([distance, extra_distance[near]])
        bend = np.concatenate([bend, extra_bend[near]])
        relative = np.minimum(distance / spacing[faces], _BEND / np.maximum(bend, 1e-9))
        radius = spacing[faces] * np.clip(relative, _REFINEMENT, 1.0)
        return cls(points, mesh.face_normals[faces], faces, barycentric, radius, distance, uneven[faces])


def _uneven_faces(mesh: trimesh.Trimesh, spacing: Float64Array, creases: _CreaseIndex) -> BoolArray:
    """Return a mask of the faces (F,) within about one ``spacing`` (F,) of a crease or a bend."""
    uneven = np.zeros(len(mesh.faces), dtype=bool)
    uneven[mesh.face_adjacency[mesh.face_adjacency_angles > 1e-3]] = True
    size = np.linalg.norm(mesh.triangles - mesh.triangles_center[:, None], axis=2).max(axis=1)
    reach = size + 1.5 * spacing
    uneven |= creases.distance(mesh.triangles_center, float(reach.max())) < reach
    for _ in range(2):
        uneven[mesh.face_adjacency[uneven[mesh.face_adjacency].any(axis=1)]] = True
    return uneven


def _bend(tree: KDTree, normals: Float64Array, reach: Float64Array) -> Float64Array:
    """Return the angle [rad], shape (P,), by which the surface bends within ``reach`` (P,) of each tree point."""
    distance, index = query_neighbours(tree, tree.data, k=range(1, 1 + min(10, tree.n)))
    cosine = np.einsum("pkd,pd->pk", normals[index], normals)
    return np.asarray(np.arccos(np.clip(np.where(distance < reach[:, None], cosine, 1.0).min(axis=1), -1.0, 1.0)))


def _overhang_limit(pool: _Pool, points: Float64Array, frames: Float64Array, sigma: Float64Array) -> Float64Array:
    """Return the maximum standard deviations (N, 2) along the tangents at which discs stay close to the surface.

    Tips at two standard deviations may rise above the nearest surface point by a fraction of ``sigma`` (N, 1).
    """
    tree = KDTree(pool.points)
    limit = np.empty((len(points), 2))
    for axis in range(2):
        share, undecided = np.full(len(points), _SHARES[-1]), np.arange(len(points))
        for candidate in _SHARES[:-1]:
            reach = 2.0 * candidate * sigma[undecided] * frames[undecided, :, axis]
            rise = np.zeros(len(undecided))
            for tips in (points[undecided] + reach, points[undecided] - reach):
                _, nearest = query_neighbours(tree, tips)
                above = np.einsum("nd,nd->n", tips - pool.points[nearest], pool.normals[nearest])
                rise = np.maximum(rise, above)
            close = rise < _OVERHANG * sigma[undecided, 0]
            share[undecided[close]] = candidate
            undecided = undecided[~close]
        limit[:, axis] = share * sigma[:, 0]
    return limit


def _draw(
    mesh: trimesh.Trimesh, expected: Float64Array, factor: float, rng: np.random.Generator
) -> tuple[Float64Array, Int64Array, Float64Array]:
    """Draw ``factor`` times ``expected`` (F,) points per face: positions, faces, barycentric coordinates."""
    total = expected.sum()
    count = int(np.ceil(factor * total))
    faces = np.sort(rng.choice(len(expected), size=count, p=expected / total if total > 0 else None))
    u, v = rng.random((2, len(faces)))
    root = np.sqrt(u)
    barycentric = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    return np.einsum("nk,nkd->nd", barycentric, mesh.triangles[faces]), faces, barycentric


def _frames(
    normals: Float64Array, points: Float64Array, radius: Float64Array, creases: _CreaseIndex
) -> tuple[Float64Array, Float64Array]:
    """Return frames (N, 3, 3) and distances (N, 2) [m] to creases along their axes.

    The first axis of a frame points to the nearest crease.
    """
    towards, beside = creases.offsets(points, _CREASE_NEIGHBOURS)
    in_plane = towards - np.einsum("nkd,nd->nk", towards, normals)[..., None] * normals[:, None]
    distance = np.linalg.norm(in_plane, axis=2)
    # Creases far above or below belong to another surface.
    distance[distance < 0.5 * np.linalg.norm(towards, axis=2)] = np.inf
    nearest = np.argmin(distance, axis=1)[:, None]
    bounded = np.take_along_axis(distance, nearest, axis=1) < 4.0 * radius[:, None]
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.where(bounded, np.take_along_axis(in_plane, nearest[..., None], axis=1)[:, 0], np.cross(normals, helper))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first), normals], axis=2)
    across = np.abs(np.einsum("nkd,ndi->nki", in_plane, frames[:, :, :2]))
    ahead = (beside & np.isfinite(distance))[..., None] & (across > 0.7 * np.minimum(distance, 1e6)[..., None])
    return frames, np.where(ahead, across, np.inf).min(axis=1)


def _close_gaps(
    centres: Float64Array,
    frames: Float64Array,
    scales: Float64Array,
    widest: Float64Array,
    probes: Float64Array,
    normals: Float64Array,
) -> Float64Array:
    """Enlarge discs until little light passes between them.

    ``scales`` (N, 3) grow up to ``widest`` (N, 2). The transmittance is tested at ``probes`` (P, 3).
    """
    _, index = query_neighbours(KDTree(centres), probes, k=range(1, 1 + min(12, len(centres))))
    own = frames[index]
    local = np.einsum("pkj,pkji->pki", probes[:, None] - centres[index], own[..., :2])
    facing = np.einsum("pkj,pj->pk", own[..., 2], normals) > 0.7
    scales = scales.copy()
    for _ in range(_CLOSING_ROUNDS):
        across, along = ((local[..., axis] / scales[index, axis]) ** 2 for axis in range(2))
        response = np.exp(-0.5 * (across + along)) * facing
        leaking = np.prod(1.0 - response, axis=1) > _MAX_TRANSMITTANCE
        if not leaking.any():
            break
        # A closed gap stays closed, because discs only grow.
        index, local, facing, response = index[leaking], local[leaking], facing[leaking], response[leaking]
        grown = np.unique(np.take_along_axis(index, np.argpartition(-response, 1, axis=1)[:, :2], axis=1))
        scales[grown, :2] = np.minimum(1.08 * scales[grown, :2], widest[grown])
    return scales


@dataclass(frozen=True, eq=False)
class _CreaseIndex:
    """Creases and boundaries of a mesh, sampled as points.

    Attributes:
        tree: Search tree of the points; None without creases.
        starts, units, lengths: Start [m], direction and length [m] of each edge. An edge occurs once per adjacent face.
        owner: Index of the edge of each point.
        inward: Direction across the edge into its face, and normal of the face, shape (E, 2, 3).
    """

    tree: KDTree | None
    starts: Float64Array
    units: Float64Array
    lengths: Float64Array
    owner: Int64Array
    inward: Float64Array

    @classmethod
    def build(cls, mesh: trimesh.Trimesh, spacing: Float64Array) -> _CreaseIndex:
        """Sample the creases at the distance ``spacing`` (F,) [m] of their adjacent faces."""
        is_sharp = mesh.face_adjacency_angles > CREASE_ANGLE
        sharp, beside = mesh.face_adjacency_edges[is_sharp], mesh.face_adjacency[is_sharp]
        open_rows = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
        # A crease occurs once per adjacent face.
        edges = np.concatenate([sharp, sharp, mesh.edges_sorted[open_rows]]).astype(int)
        face = np.concatenate([beside[:, 0], beside[:, 1], mesh.edges_face[open_rows]]).astype(int)
        start, along = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]]
        length = np.linalg.norm(along, axis=1)
        steps = np.maximum(1, np.ceil(length / spacing[face]).astype(int))
        owner = np.repeat(np.arange(len(edges)), steps)
        fraction = (np.arange(len(owner)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[owner]
        tree = KDTree(start[owner] + fraction[:, None] * along[owner]) if len(edges) else None
        unit = along / np.maximum(length, 1e-12)[:, None]
        inward = np.cross(mesh.face_normals[face], unit)
        inward *= np.sign(np.einsum("nd,nd->n", mesh.triangles_center[face] - start, inward))[:, None]
        return cls(tree, start, unit, length, owner, np.stack([inward, mesh.face_normals[face]], axis=1))

    def rows(self, pool: _Pool, offset: float) -> Int64Array:
        """Return the candidates (M,) nearest to rows along the creases, ``offset`` local spacings inside."""
        if self.tree is None:
            return np.empty(0, dtype=np.int64)
        near = np.flatnonzero(np.isfinite(pool.crease_distance))
        if not len(near):
            return near
        local = KDTree(pool.points[near])
        inward, normal = self.inward[self.owner, 0], self.inward[self.owner, 1]
        spacing = pool.radius[near][query_neighbours(local, self.tree.data)[1]]
        distance, index = query_neighbours(
            local, self.tree.data + offset * spacing[:, None] * inward, k=np.arange(1, 5)
        )
        index = near[np.minimum(index, len(near) - 1)]
        alike = np.einsum("nkd,nd->nk", pool.normals[index], normal) > 0.9
        alike &= distance < 0.4 * spacing[:, None]
        first = np.argmax(alike, axis=1)
        return np.unique(index[np.arange(len(index)), first][alike.any(axis=1)])

    def distance(self, points: Float64Array, reach: float) -> Float64Array:
        """Return distances (N,) [m] to the nearest crease; infinite beyond ``reach`` [m] or without creases."""
        if self.tree is None:
            return np.full(len(points), np.inf)
        return np.asarray(query_neighbours(self.tree, points, distance_upper_bound=reach)[0])

    def offsets(self, points: Float64Array, count: int) -> tuple[Float64Array, BoolArray]:
        """Return vectors (N, ``count``, 3) to the nearest points of the nearest creases; they are long without creases.

        Also return a mask (N, ``count``) of the points inside their edges. Ends of edges do not define a distance
        across.
        """
        if self.tree is None:
            return np.full((len(points), count, 3), 1e6), np.zeros((len(points), count), dtype=bool)
        _, index = query_neighbours(self.tree, points, k=np.arange(1, count + 1))
        segment = self.owner[np.minimum(index, len(self.owner) - 1)]
        from_start = points[:, None] - self.starts[segment]
        position = np.einsum("nkd,nkd->nk", from_start, self.units[segment])
        inside = np.clip(position, 0.0, self.lengths[segment])
        return inside[..., None] * self.units[segment] - from_start, inside == position
