"""Registration of a mesh from another source to splats, and their distance.

Mesh reconstruction tools first transform the cameras, so that the object is centred and of unit size. Their mesh is in
that frame, and the inverse of this transform takes it back. A CAD mesh has its own frame, and is registered to the
surface of the splats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.geometry.rigid import homogeneous_matrix, split_similarity, transform_points
from mitsplat.renderer.layers import render_splats

_OPAQUE = 0.9
"""Least alpha of a pixel on a surface, away from edges."""
_SAMPLES = 4000
_COARSE_POINTS, _COARSE_STEPS = 400, 16
_FINE_STEPS = 40
_REFINED_POSES = 3
_KERNEL_START, _KERNEL_END = 0.1, 0.01
"""Initial and final width of the robust kernel, as a share of the mesh's diagonal."""
_MAX_DISTANCE = 0.05
"""Upper limit of a point's distance in the misfit, as a share of the diagonal."""
_MAX_SIZE_RATIO = 1.5
"""Ratio of the sizes of mesh and points from which a known scale is wrong; the points show a part of the surface."""
_OFFSET_SHARE = 0.9
"""Share of the points, the nearest ones, that determine an offset."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Registration of a mesh to splats.

    Attributes:
        splats_from_mesh: Similarity transform, shape (4, 4).
        residual: Median distance of the splats' surface from the moved mesh, as a share of its diagonal.
    """

    splats_from_mesh: Float64Array
    residual: float

    @property
    def scale(self) -> float:
        """Scale of the transform."""
        return float(np.cbrt(np.linalg.det(self.splats_from_mesh[:3, :3])))


@dataclass(frozen=True)
class Offset:
    """Distance between a mesh and the surface of splats, as shares of the mesh's diagonal.

    Attributes:
        shift: Length of the translation that aligns them best.
        spread: Median distance between them.
    """

    shift: float
    spread: float


def surface_points(splats: Splats, cameras: Sequence[Camera]) -> Float64Array:
    """Return at most ``_SAMPLES`` points (M, 3) on the splat surface that cameras see.

    At the surface the transmittance falls to one half.

    Raises:
        InputError: If no camera sees an opaque pixel.
    """
    points = []
    for camera in cameras:
        layers = render_splats(splats, camera, quality="fast")
        y, x = np.nonzero((layers.alpha > _OPAQUE) & (layers.depth > 0))
        points.append(camera.unproject(np.stack([x + 0.5, y + 0.5], axis=1), layers.depth[y, x]))
    found: Float64Array = np.concatenate([np.zeros((0, 3)), *points])
    if not len(found):
        raise InputError("the splats show no opaque surface to the cameras: do the splats belong to this capture?")
    if len(found) > _SAMPLES:
        found = found[np.random.default_rng(0).choice(len(found), _SAMPLES, replace=False)]
    return found


def invert_transform(path: Path) -> Float64Array:
    """Read a similarity transform from a text file, 3 x 4 or 4 x 4 numbers, and return its inverse, shape (4, 4).

    Raises:
        InputError: If the file cannot be read or is not a similarity transform.
    """
    try:
        matrix = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: must hold 3 or 4 rows of 4 numbers ({error})") from error
    if matrix.shape == (3, 4):
        matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
    if matrix.shape != (4, 4):
        raise InputError(f"{path}: must be an affine 3 x 4 or 4 x 4 matrix (got shape {matrix.shape})")
    try:
        split_similarity(matrix)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def register_mesh(mesh: trimesh.Trimesh, points: Float64Array, scale: float | None = None) -> Alignment:
    """Register a mesh of any frame to points (N, 3) on parts of the object's surface.

    ``scale`` is the known length of the mesh's unit in the frame of the points; by default it is estimated.

    Iterative closest points with scale, by Gauss-Newton steps on point-to-plane distances (Chen and Medioni 1992). The
    24 proper matches of the principal axes are starting poses. All starts use a few points; the best starts are refined
    with all points.

    Raises:
        InputError: If there are fewer than 100 points, or the size of the mesh contradicts that of the points.
    """
    if len(points) < 100:
        raise InputError(
            f"a registration needs at least 100 points of the splats' surface (got {len(points)}): does the object "
            "fill enough of the photos?"
        )
    surface = DistanceSurface(mesh)
    rng = np.random.default_rng(0)
    few = points[rng.choice(len(points), min(_COARSE_POINTS, len(points)), replace=False)]
    samples = np.asarray(trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)[0])
    missed = _MAX_DISTANCE * mesh.scale
    widths = mesh.scale * np.geomspace(_KERNEL_START, _KERNEL_END, _COARSE_STEPS)
    starts: list[tuple[float, int, Float64Array]] = []
    if scale is not None:
        ratio = scale * _size(samples) / _size(points)
        if not 1 / _MAX_SIZE_RATIO < ratio < _MAX_SIZE_RATIO:
            raise InputError(f"the mesh is {ratio:.3g} times as large as the photographed object: check its units")
    for start in _initial_poses(points, samples, scale):
        found = _icp_steps(surface, few, start, widths, scale is not None)
        starts.append((_misfit(surface, samples[:_COARSE_POINTS], few, found, missed), len(starts), found))
    finals: list[tuple[float, int, Float64Array]] = []
    for _, _, start in sorted(starts)[:_REFINED_POSES]:
        found = _icp_steps(surface, points, start, np.repeat(widths[-1], _FINE_STEPS), scale is not None)
        finals.append((_misfit(surface, samples, points, found, missed), len(finals), found))
    _, _, mesh_from_splats = min(finals)
    distance = surface.nearest(transform_points(mesh_from_splats, points))[2]
    splats_from_mesh = np.asarray(np.linalg.inv(mesh_from_splats), dtype=np.float64)
    return Alignment(splats_from_mesh, float(np.median(distance) / mesh.scale))


def measure_offset(mesh: trimesh.Trimesh, points: Float64Array) -> Offset:
    """Measure the offset of a mesh from surface points (N, 3) in the same frame."""
    nearest, normal, distance = DistanceSurface(mesh).nearest(points)
    near = distance <= np.quantile(distance, _OFFSET_SHARE)
    gap = np.einsum("nd,nd->n", normal, nearest - points)
    # The least-norm solution is zero in directions in which the surface can slide along itself.
    shift, *_ = np.linalg.lstsq(normal[near], gap[near], rcond=1e-3)
    return Offset(float(np.linalg.norm(shift) / mesh.scale), float(np.median(distance) / mesh.scale))


def _size(points: Float64Array) -> float:
    """Return the root mean square distance of points (N, 3) from their mean."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _initial_poses(points: Float64Array, samples: Float64Array, scale: float | None) -> list[Float64Array]:
    """Return the transforms that match centres, sizes and principal axes of two point sets, in all 24 proper ways.

    ``scale`` replaces the ratio of the sizes if it is known, see :func:`register_mesh`.
    """
    frames = []
    for cloud in (points, samples):
        middle = cloud.mean(axis=0)
        axes = np.linalg.svd(cloud - middle, full_matrices=False)[2].T
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        frames.append((middle, axes, _size(cloud)))
    (from_middle, from_axes, from_size), (to_middle, to_axes, to_size) = frames
    ratio = to_size / from_size if scale is None else 1 / scale
    starts = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.eye(3)[list(order)] * signs
        if np.linalg.det(turn) < 0:
            continue
        linear = ratio * to_axes @ turn @ from_axes.T
        starts.append(homogeneous_matrix(linear, to_middle - linear @ from_middle))
    return starts


def _icp_steps(
    surface: DistanceSurface, points: Float64Array, matrix: Float64Array, widths: Float64Array, rigid: bool
) -> Float64Array:
    """Run Gauss-Newton on ``n . (p + w x (p - c) + s (p - c) + t - q)`` for rotation w, scale s and translation t.

    With ``rigid``, s is 0.

    Points have weights by the kernel of Geman and McClure, whose width decreases with the steps (graduated
    non-convexity, Blake and Zisserman 1987). A wide kernel at the start is necessary for nearly round parts: only the
    few farthest points show a wrong rotation.
    """
    for width in widths:
        moved = transform_points(matrix, points)
        nearest, normal, distance = surface.nearest(moved)
        weight = (1 + (distance / width) ** 2) ** -2
        middle = moved.mean(axis=0)
        arm, gap = moved - middle, nearest - moved
        size = float(np.linalg.norm(arm, axis=1).mean())
        arm, gap = arm / size, gap / size
        rows = np.concatenate([np.cross(arm, normal), np.einsum("nd,nd->n", arm, normal)[:, None], normal], axis=1)
        if rigid:
            rows[:, 3] = 0
        wanted = np.einsum("nd,nd->n", gap, normal)
        # The pseudo-inverse makes no step in directions in which the surface slides along itself, such as around the
        # axis of a turned part.
        weighted = rows.T * weight
        update = np.linalg.pinv(weighted @ rows, rcond=1e-5, hermitian=True) @ (weighted @ wanted)
        turn = Rotation.from_rotvec(update[:3]).as_matrix() * (1 + float(np.clip(update[3], -0.1, 0.1)))
        matrix = homogeneous_matrix(turn, middle - turn @ middle + size * update[4:]) @ matrix
        if width == widths[-1] and np.abs(update).max() < 1e-6:
            break
    return matrix


def _misfit(
    surface: DistanceSurface, samples: Float64Array, points: Float64Array, matrix: Float64Array, missed: float
) -> float:
    """Return the sum of the mean distances in both directions.

    A cloud that shrank into a corner is near the mesh, but the mesh is not near the cloud.

    All points count, because the few far points distinguish two poses of a nearly symmetric part. Distances are limited
    to ``missed``, because parts of the surface may be unseen.
    """
    moved = transform_points(matrix, points)
    there, back = surface.nearest(moved)[2], KDTree(moved).query(samples)[0]
    return float(np.minimum(there, missed).mean() + np.minimum(back, missed).mean())
