"""Refinement of the pose of a registered mesh towards the masks of photographs.

Splats on metal have an inaccurate surface, because reflections move with the camera. A mesh that was registered to it
is therefore off by several pixels. Masks do not depend on reflections.

Points on the outlines of the mesh are moved onto the boundaries of the masks by nonlinear least squares. The residual
of a point is its signed distance from the nearest boundary [px], with the robust loss of Cauchy. The outlines are
traced again after each solution, as in iterative closest points. A third of the views is not fitted and decides.

Nearly symmetric parts, such as a hexagon with a thread, have several poses that a registration cannot distinguish.
Turns about the principal axes that nearly map the mesh to itself are therefore further starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from skimage.measure import find_contours

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.progress import Progress
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.reconstruct.silhouette_refinement import Refinement, is_gain
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, wrapped
from mitsplat.runtime.variant import ensure_variant

_VALIDATION_EVERY = 3
"""Interval of the validation views."""
_ROUNDS, _STEPS = 12, 20
"""Largest number of solutions, each with new outlines, and of evaluations in a solution."""
_POINTS = 250
"""Largest number of points on the outline of a view."""
_CANDIDATES, _INTERVAL = 2000, 1.0
"""Largest number of points on edges that may be on the outline of a view, and their least distance [px]."""
_ASIDE = 0.1
"""Distance of the rays beside an edge [px]."""
_FINER = 2
"""Rays per pixel and axis for an IoU."""
_MAX_TURN, _MAX_SHIFT, _MAX_GROWTH = 0.35, 0.25, 0.15
"""Largest rotation about each axis [rad], translation along it in radii, and change of the logarithm of the scale."""
_MIN_WIDTH = 0.5
"""Least width of the robust loss [px]."""
_CONVERGED = 2e-4
"""Change of all parameters at which the pose is final."""
_TURN_POINTS, _TURN_DISTANCE = 1000, 0.04
"""Points that compare a turned mesh with itself, and their largest mean distance, as a share of the diagonal."""
_FEW_VIEWS, _FEW_ROUNDS = 8, 3
"""Largest numbers of views and solutions that rank the turns."""
_TURN_GAIN, _TURN_MISFIT = 2.0, 0.9
"""Least gain of a turn in standard errors, and largest ratio of its distances to those without a turn.

They are strict, because a turn also exchanges features inside the outlines.
"""
_MISSED = 5.0
"""Limit of the distances that rank the turns [px]."""
_DIFFERENCE = 1e-4
"""Step of the derivatives of projected points, in units of the parameters."""
_EXACT = 4.0
"""Distance from a boundary up to which distances are exact [px]."""


@dataclass(frozen=True, eq=False)
class RefinedPose(Refinement):
    """Result of a pose refinement.

    Attributes:
        motion: Similarity transform of the mesh to its refined pose, shape (4, 4); the identity if it was rejected.
    """

    least_views = 6
    motion: Float64Array = field(kw_only=True)


def refine_pose(
    mesh: trimesh.Trimesh, views: Sequence[MaskedView], *, rigid: bool, progress: Progress | None = None
) -> RefinedPose:
    """Refine the pose of a mesh so that its silhouettes match masks.

    Every third view is a validation view and is not fitted. The refined pose is accepted if the mean IoU of these views
    rises by more than its standard error. A pose that starts from a turn is used only if it is clearly better.

    Args:
        mesh: Mesh close to its pose, in the frame of the cameras.
        views: Cameras of any lens, and their masks.
        rigid: Keep the scale.
        progress: Called after each solution.
    """
    ensure_variant()
    frame = _PoseFrame.of(mesh)
    outlines = [
        _OutlineView(view)
        for view in views
        if np.linalg.norm(view.camera.centre - frame.middle) > 1.2 * frame.radius and _contours(view.mask)
    ]
    if len(outlines) < RefinedPose.least_views:
        return RefinedPose(False, motion=np.eye(4))
    validation = outlines[_VALIDATION_EVERY // 2 :: _VALIDATION_EVERY]
    training = [view for view in outlines if view not in validation]
    silhouettes = _Silhouettes(mesh)
    limits = np.array([_MAX_TURN] * 3 + [_MAX_SHIFT] * 3 + [_MAX_GROWTH] * (not rigid))
    turned = [replace(frame, start=start) for start in _turns(mesh)]
    few = training[:: -(-len(training) // _FEW_VIEWS)]

    def report_progress(number: int) -> None:
        if progress is not None:
            progress(number, len(turned) + 2, "refining the pose of the mesh")

    before = _overlaps(validation, silhouettes, np.eye(4))
    motion, misfit = _solve(training, silhouettes, frame, limits, _ROUNDS)
    after = _overlaps(validation, silhouettes, motion)
    kept = is_gain(after - before)
    report_progress(1)
    misfits = []
    for number, start in enumerate(turned):
        misfits.append(_solve(few, silhouettes, start, limits, _FEW_ROUNDS)[1])
        report_progress(2 + number)
    if turned:
        turned_motion, turned_misfit = _solve(training, silhouettes, turned[np.argmin(misfits)], limits, _ROUNDS)
        overlaps = _overlaps(validation, silhouettes, turned_motion)
        if turned_misfit < _TURN_MISFIT * misfit and is_gain(overlaps - (after if kept else before), _TURN_GAIN):
            motion, after, kept = turned_motion, overlaps, True
    report_progress(len(turned) + 2)
    motion = motion if kept else np.eye(4)
    return RefinedPose(kept, float(before.mean()), float(after.mean()), len(validation), motion=motion)


def _solve(
    views: Sequence[_OutlineView], silhouettes: _Silhouettes, frame: _PoseFrame, limits: Float64Array, rounds: int
) -> tuple[Float64Array, float]:
    """Fit a pose to views; return the motion (4, 4) and the mean distance of outline points from boundaries [px].

    Distances are limited to ``_MISSED``.
    """
    pose = np.zeros(len(limits))
    misfit = _MISSED
    for number in range(rounds + 1):
        outline = _Outline([_Match.of(view, silhouettes, frame, pose) for view in views])
        distances = np.abs(outline.residuals(np.zeros_like(pose)))
        if len(distances) < len(pose):
            break
        misfit = float(np.minimum(distances, _MISSED).mean())
        if number == rounds:
            break
        step = least_squares(
            outline.residuals,
            np.zeros_like(pose),
            outline.jacobian,
            bounds=(-limits - pose, limits - pose),
            loss="cauchy",
            f_scale=max(_MIN_WIDTH, 1.5 * float(np.median(distances))),
            xtol=1e-5,
            max_nfev=_STEPS,
        ).x
        pose = np.clip(pose + step, -0.999 * limits, 0.999 * limits)
        if np.abs(step).max() < _CONVERGED:
            break
    return frame.motion(pose), misfit


def _overlaps(views: Sequence[_OutlineView], silhouettes: _Silhouettes, motion: Float64Array) -> Float64Array:
    return np.array([view.overlap(silhouettes, motion) for view in views])


def _turns(mesh: trimesh.Trimesh) -> list[Float64Array]:
    """Return rotations (4, 4) about the principal axes of a mesh that nearly map it to itself, without the identity.

    They are multiples of 30 degrees, and a solution reaches the angles between them.
    """
    surface = DistanceSurface(mesh)
    points = np.asarray(trimesh.sample.sample_surface(mesh, _TURN_POINTS, seed=0)[0])
    middle = points.mean(axis=0)
    found = []
    for axis in np.linalg.svd(points - middle, full_matrices=False)[2]:
        for angle in np.radians(np.arange(30, 360, 30)):
            turn = trimesh.transformations.rotation_matrix(angle, axis, middle)
            distance = surface.nearest(points @ turn[:3, :3].T + turn[:3, 3])[2]
            if distance.mean() < _TURN_DISTANCE * mesh.scale:
                found.append(np.asarray(turn))
    return found


@dataclass(frozen=True, eq=False)
class _PoseFrame:
    """Start of a pose, and the centre and radius of the mesh, to which the parameters relate.

    The parameters are a rotation vector, a translation in radii and, if the scale is free, its logarithm.
    """

    middle: Float64Array
    radius: float
    start: Float64Array

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> _PoseFrame:
        """Return the frame of a mesh that starts at its pose."""
        return cls(mesh.bounds.mean(axis=0), float(np.linalg.norm(mesh.extents) / 2), np.eye(4))

    def motion(self, pose: Float64Array) -> Float64Array:
        """Return the transform (4, 4) of parameters; rotation and scale are about the centre."""
        linear = np.exp(pose[6:].sum()) * Rotation.from_rotvec(pose[:3]).as_matrix()
        translation = self.middle + self.radius * pose[3:6] - linear @ self.middle
        whole: Float64Array = homogeneous_matrix(linear, translation) @ self.start
        return whole


class _Silhouettes:
    """A mesh whose silhouettes are traced."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._scene = ray_scene({"mesh": plain_mesh(mesh)})
        self._bounds = trimesh.bounds.corners(mesh.bounds)
        welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        welded.merge_vertices(merge_tex=True, merge_norm=True)
        self._vertices = np.asarray(welded.vertices)
        self._edges: Int64Array = np.asarray(welded.face_adjacency_edges)
        self._opposite: Int64Array = np.asarray(welded.face_adjacency_unshared)
        rows = trimesh.grouping.group_rows(welded.edges_sorted, require_count=2)
        self._other_edges = np.unique(np.delete(welded.edges_sorted, rows.ravel(), axis=0), axis=0)

    def outline(self, camera: Camera) -> Float64Array:
        """Return points (N, 3) on the outline of the mesh, at about equal intervals in the image.

        An edge is on the outline if both of its faces lie on one side of the plane through it and the camera, and rays
        that pass it hit the mesh on one side only. Edges that do not have two faces may be on it.
        """
        start, end = (self._vertices[self._edges[:, i]] - camera.centre for i in (0, 1))
        sides = np.einsum("ekd,ed->ek", self._vertices[self._opposite] - camera.centre, np.cross(start, end))
        edges = np.concatenate([self._edges[sides.prod(axis=1) > 0], self._other_edges])
        start, end = self._vertices[edges].swapaxes(0, 1)
        pixels = np.stack([camera.project(start)[0], camera.project(end)[0]])
        length = np.nan_to_num(np.linalg.norm(pixels[1] - pixels[0], axis=1))
        reach = np.concatenate([[0], np.cumsum(length)])
        at = np.arange(0.5 * _INTERVAL, reach[-1], max(_INTERVAL, reach[-1] / _CANDIDATES))
        row = np.minimum(np.searchsorted(reach, at, side="right") - 1, len(edges) - 1)
        share = ((at - reach[row]) / np.maximum(length[row], 1e-12))[:, None]
        points = start[row] + share * (end - start)[row]
        along = (pixels[1] - pixels[0])[row] / np.maximum(length[row], 1e-12)[:, None]
        across = _ASIDE * along[:, ::-1] * (1, -1)
        middle, _ = camera.project(points)
        hit = self._hits(camera, np.concatenate([middle - across, middle + across])).reshape(2, -1)
        found: Float64Array = points[hit[0] != hit[1]]
        return found

    def coverage(self, camera: Camera) -> Float64Array:
        """Return the share of each pixel that the mesh covers, (H, W)."""
        share = np.zeros((camera.height, camera.width))
        left, top, right, bottom = self._window(camera)
        if left < right and top < bottom:
            part = camera.cropped(left, top, right - left, bottom - top)
            fine = part.resized(_FINER * part.width, _FINER * part.height)
            y, x = np.mgrid[: fine.height, : fine.width] + 0.5
            hit = self._hits(fine, np.column_stack([x.ravel(), y.ravel()]))
            share[top:bottom, left:right] = hit.reshape(part.height, _FINER, part.width, _FINER).mean(axis=(1, 3))
        return share

    def _hits(self, camera: Camera, pixels: Float64Array) -> BoolArray:
        """Return True for pixel positions (N, 2) at which a camera sees the mesh."""
        slopes = np.nan_to_num(camera.ray_slopes(pixels), nan=1e3)
        ahead = np.column_stack([slopes, np.ones(len(slopes))]) @ camera.world_from_camera[:3, :3].T
        origin = mi.Point3f(*[dr.opaque(mi.Float, float(value)) for value in camera.centre])
        direction = mi.Vector3f(*[wrapped(mi.Float, axis.astype(np.float32)) for axis in ahead.T])
        return np.array(self._scene.ray_test(mi.Ray3f(origin, direction)))

    def _window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Return a rectangle that contains the silhouette: left, top, right and bottom [px]."""
        pixels, _ = camera.project(self._bounds)
        if not camera.is_pinhole or np.isnan(pixels).any():
            return 0, 0, camera.width, camera.height
        size = (camera.width, camera.height)
        low = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])


class _OutlineView:
    """A mask with the signed distances of its pixels from its boundary."""

    def __init__(self, view: MaskedView) -> None:
        self.camera, self._mask, self._known = view.camera, view.mask, view.known
        self._distance = _signed_distances(view.mask)
        self._slopes = np.gradient(self._distance)
        # The boundary of the image counts as unknown.
        self._to_unknown = distance_transform_edt(np.pad(view.known, 1))[1:-1, 1:-1]

    def distances(self, pixels: Float64Array) -> Float64Array:
        """Return the signed distances (N,) [px] of pixel positions (N, 2) from the boundary, negative in the mask."""
        return _interpolated(self._distance, pixels)

    def gradients(self, pixels: Float64Array) -> Float64Array:
        """Return the gradients (N, 2) of :meth:`distances`."""
        return np.column_stack([_interpolated(slope, pixels) for slope in self._slopes[::-1]])

    def has_boundary(self, pixels: Float64Array) -> BoolArray:
        """Return True for pixel positions (N, 2) whose nearest boundary is known."""
        return np.abs(self.distances(pixels)) + 1 < _interpolated(self._to_unknown, pixels)

    def overlap(self, silhouettes: _Silhouettes, motion: Float64Array) -> float:
        """Return the IoU of the silhouette of the moved mesh with the mask, by coverage of known pixels."""
        share = silhouettes.coverage(self.camera.transformed(np.linalg.inv(motion)))
        both, either = (float(pick(share, self._mask)[self._known].sum()) for pick in (np.minimum, np.maximum))
        return both / max(either, 1e-9)


@dataclass(frozen=True, eq=False)
class _Match:
    """Points on the outline of a mesh in one view.

    Attributes:
        view: The view.
        pixels: Pixel positions, (N, 2).
        slopes: Derivatives of the pixel positions by the parameters of the pose, (N, 2, P).
    """

    view: _OutlineView
    pixels: Float64Array
    slopes: Float64Array

    @classmethod
    def of(cls, view: _OutlineView, silhouettes: _Silhouettes, frame: _PoseFrame, pose: Float64Array) -> _Match:
        """Trace the outline of the mesh at a pose; points whose nearest boundary is unknown are left out."""
        points = silhouettes.outline(view.camera.transformed(np.linalg.inv(frame.motion(pose))))

        def project(pose: Float64Array) -> Float64Array:
            motion = frame.motion(pose)
            return view.camera.project(points @ motion[:3, :3].T + motion[:3, 3])[0]

        start = project(pose)
        rows = np.flatnonzero(view.has_boundary(start))
        rows = rows[np.linspace(0, len(rows) - 1, min(_POINTS, len(rows))).astype(int)]
        points, start = points[rows], start[rows]
        slopes = np.stack([project(pose + step) - start for step in _DIFFERENCE * np.eye(len(pose))], axis=2)
        valid = np.isfinite(slopes).all(axis=(1, 2))
        return cls(view, start[valid], slopes[valid] / _DIFFERENCE)


@dataclass(frozen=True, eq=False)
class _Outline:
    """Points on the outlines of a mesh in all views."""

    matches: Sequence[_Match]

    def residuals(self, step: Float64Array) -> Float64Array:
        """Return the signed distances [px] of the points from the boundaries after a step of the pose."""
        return np.concatenate([match.view.distances(match.pixels + match.slopes @ step) for match in self.matches])

    def jacobian(self, step: Float64Array) -> Float64Array:
        """Return the derivatives of :meth:`residuals`, (N, P)."""
        parts = [
            np.einsum("nd,ndp->np", match.view.gradients(match.pixels + match.slopes @ step), match.slopes)
            for match in self.matches
        ]
        return np.concatenate(parts)


def _contours(values: npt.NDArray[np.floating]) -> list[Float64Array]:
    """Return the contours of an image at one half as pixel positions (N, 2)."""
    return [contour[:, ::-1] + 0.5 for contour in find_contours(values, 0.5)]  # type: ignore[no-untyped-call]


def _interpolated(values: Float64Array, pixels: Float64Array) -> Float64Array:
    """Return an image (H, W) at pixel positions (N, 2)."""
    return np.asarray(map_coordinates(values, pixels.T[::-1] - 0.5, order=1, mode="nearest"))


def _signed_distances(mask: Float32Array) -> Float64Array:
    """Return the signed distances of pixel centres from the contours of a mask [px], negative inside, (H, W).

    They are exact near the contours. Elsewhere they have the error of a distance between pixels.
    """
    inside = mask > 0.5
    distance = np.asarray(distance_transform_edt(inside) + distance_transform_edt(~inside)) - 0.5
    row, column = np.nonzero(distance < _EXACT)
    centres = np.column_stack([column, row]) + 0.5
    contours = _contours(mask)
    starts = np.concatenate([contour[:-1] for contour in contours])
    steps = np.concatenate([np.diff(contour, axis=0) for contour in contours])
    near = KDTree(starts + 0.5 * steps).query(centres, k=min(4, len(starts)))[1].reshape(len(centres), -1)
    away, step = centres[:, None] - starts[near], steps[near]
    along = np.einsum("nkd,nkd->nk", away, step) / np.maximum(np.einsum("nkd,nkd->nk", step, step), 1e-12)
    distance[row, column] = np.linalg.norm(away - np.clip(along, 0, 1)[..., None] * step, axis=2).min(axis=1)
    return np.where(inside, -distance, distance)
