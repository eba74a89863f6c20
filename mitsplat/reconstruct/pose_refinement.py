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

import numpy as np
import trimesh
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.geometry.rigid import homogeneous_matrix, transform_points
from mitsplat.progress import Progress
from mitsplat.reconstruct.mesh_outlines import MaskBoundary, MeshOutlines, contours_of
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.reconstruct.silhouette_refinement import Refinement, is_gain
from mitsplat.runtime.variant import ensure_variant

_VALIDATION_EVERY = 3
"""Interval of the validation views."""
_ROUNDS, _STEPS = 12, 20
"""Largest number of solutions, each with new outlines, and of evaluations in a solution."""
_POINTS = 250
"""Largest number of points on the outline of a view."""
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
    boundaries = [
        MaskBoundary(view)
        for view in views
        if np.linalg.norm(view.camera.centre - frame.middle) > 1.2 * frame.radius and contours_of(view.mask)
    ]
    if len(boundaries) < RefinedPose.least_views:
        return RefinedPose(False, motion=np.eye(4))
    validation = boundaries[_VALIDATION_EVERY // 2 :: _VALIDATION_EVERY]
    training = [view for view in boundaries if view not in validation]
    outlines = MeshOutlines(mesh)
    limits = np.array([_MAX_TURN] * 3 + [_MAX_SHIFT] * 3 + [_MAX_GROWTH] * (not rigid))
    turns = _turns(mesh)
    few = training[:: -(-len(training) // _FEW_VIEWS)]

    def report_progress(number: int) -> None:
        if progress is not None:
            progress(number, 2 * len(turns) + 2, "refining the pose of the mesh")

    before = _overlaps(validation, outlines, np.eye(4))
    motion, misfit = _solve(training, outlines, frame, limits, _ROUNDS)
    after = _overlaps(validation, outlines, motion)
    kept = is_gain(after - before)
    report_progress(1)
    turned, least, number = frame, np.inf, 1
    for _ in range(2):  # a prism has turns about its axis in either direction of this axis
        for start in [replace(turned, start=turned.start @ turn) for turn in turns]:
            distance = _solve(few, outlines, start, limits, _FEW_ROUNDS)[1]
            if distance < least:
                turned, least = start, distance
            number += 1
            report_progress(number)
    if turns:
        turned_motion, turned_misfit = _solve(training, outlines, turned, limits, _ROUNDS)
        overlaps = _overlaps(validation, outlines, turned_motion)
        if turned_misfit < _TURN_MISFIT * misfit and is_gain(overlaps - (after if kept else before), _TURN_GAIN):
            motion, after, kept = turned_motion, overlaps, True
    report_progress(2 * len(turns) + 2)
    motion = motion if kept else np.eye(4)
    return RefinedPose(kept, float(before.mean()), float(after.mean()), len(validation), motion=motion)


def _solve(
    views: Sequence[MaskBoundary], outlines: MeshOutlines, frame: _PoseFrame, limits: Float64Array, rounds: int
) -> tuple[Float64Array, float]:
    """Fit a pose to views; return the motion (4, 4) and the mean distance of outline points from boundaries [px].

    Distances are limited to ``_MISSED``.
    """
    pose = np.zeros(len(limits))
    misfit = _MISSED
    for number in range(rounds + 1):
        outline = _Outline([_Match.of(view, outlines, frame, pose) for view in views])
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


def _overlaps(views: Sequence[MaskBoundary], outlines: MeshOutlines, motion: Float64Array) -> Float64Array:
    return np.array([view.overlap(outlines, motion) for view in views])


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
            distance = surface.nearest(transform_points(turn, points))[2]
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


@dataclass(frozen=True, eq=False)
class _Match:
    """Points on the outline of a mesh in one view.

    Attributes:
        view: The view.
        pixels: Pixel positions, (N, 2).
        slopes: Derivatives of the pixel positions by the parameters of the pose, (N, 2, P).
    """

    view: MaskBoundary
    pixels: Float64Array
    slopes: Float64Array

    @classmethod
    def of(cls, view: MaskBoundary, outlines: MeshOutlines, frame: _PoseFrame, pose: Float64Array) -> _Match:
        """Trace the outline of the mesh at a pose; points whose nearest boundary is unknown are left out."""
        points = outlines.outline(view.camera.transformed(np.linalg.inv(frame.motion(pose))))

        def project(pose: Float64Array) -> Float64Array:
            return view.camera.project(transform_points(frame.motion(pose), points))[0]

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
