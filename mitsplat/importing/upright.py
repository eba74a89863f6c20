"""Up direction of splats whose file does not state it, and the flat surfaces that objects stand on.

Splat files name no axes. Two cues define the vertical: the usual up axis of the format, and a large flat surface below
everything else, such as the table under an object or the floor of a room. Planes are found by random samples of three
points (Fischler and Bolles 1981, RANSAC) and fitted to their inliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
import shapely
import trimesh
from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_files import Axis
from mitsplat.reconstruct.segment_splats import visible_area

POINTS = 4000
"""Number of Gaussians for the search of planes, drawn in proportion to their visible area."""
_SAMPLES = 3000
_PLANE_TOLERANCE = 0.006
"""Maximum distance of inliers from a plane, as a fraction of the diagonal of all points."""
_MAX_BELOW = 0.01
"""Maximum fraction of the points below the surface that an object stands on."""
_MAX_ANGLE = 35.0
"""Maximum angle between the usual up axis and the normal of a horizontal plane [degrees]."""
_MIN_SHARE_NEAR, _MIN_SHARE_ANY = 0.04, 0.25
"""Minimum fractions of inliers with which a plane defines up: near the usual axis, and in any other orientation."""
_MIN_SPAN = 0.85
"""Minimum span of a surface below an object, relative to the object's footprint, with which it defines up."""
_SNAP_ANGLE = 1.0
"""Angle up to which the up direction snaps to the usual axis [degrees]."""


@dataclass(frozen=True, eq=False)
class Plane:
    """Flat surface.

    Attributes:
        normal: Unit normal, shape (3,).
        height: Distance from the origin along the normal.
        share: Fraction of the points that lie in the plane.
        thickness: Standard deviation of these points from the plane.
    """

    normal: Float64Array
    height: float
    share: float
    thickness: float


@dataclass(frozen=True, eq=False)
class Upright:
    """Up direction of splats.

    Attributes:
        up: Unit vector in the file's axes, shape (3,).
        reason: Short text that explains the choice.
        support: Horizontal plane that objects stand on, or None.
    """

    up: Float64Array
    reason: str
    support: Plane | None

    @property
    def rotation(self) -> Float64Array:
        """Smallest rotation that maps up to z, shape (3, 3)."""
        return rotation_to_z(self.up)


def axis_vector(axis: str) -> Float64Array:
    """Return the unit vector (3,) of an axis such as ``-y``.

    Raises:
        InputError: If the name is no axis.
    """
    if axis not in get_args(Axis):
        raise InputError(f"up must be auto, {', '.join(get_args(Axis))} (got {axis!r})")
    return np.asarray(np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0))


def rotation_to_z(up: Float64Array) -> Float64Array:
    """Return the smallest rotation that maps a unit vector to z, shape (3, 3); for -z, the rotation about x."""
    axis = np.cross(up, (0.0, 0.0, 1.0))
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    return np.asarray(Rotation.from_rotvec(axis * np.arctan2(sine, up[2])).as_matrix())


def find_up(splats: Splats, kind: str, usual: Axis, given: Axis | None = None) -> Upright:
    """Estimate the up direction, and find the flat surface that objects stand on.

    Args:
        splats: Splats without floaters.
        kind: ``object`` or ``environment``. Nearly all points of an object lie above its support; an environment may
            continue below a table.
        usual: Axis that points up if there is no other evidence.
        given: Known up axis; only the surface is searched then.
    """
    points = visible_points(splats)
    tolerance = _PLANE_TOLERANCE * float(np.linalg.norm(np.ptp(np.quantile(points, (0.01, 0.99), axis=0), axis=0)))
    wanted = axis_vector(given or usual)
    below = _MAX_BELOW if kind == "object" else 1.0
    near = largest_plane(points, tolerance, towards=wanted, within=_MAX_ANGLE, below=below)
    if near is not None and near.share < _MIN_SHARE_NEAR:
        near = None
    if given is not None:
        return Upright(wanted, f"{given}, as given", near)
    name = f"{usual}, as is usual for such files"
    # A plane narrower than the object may be its sole or one of its sides, which need not be level.
    if near is not None and (kind == "environment" or _relative_span(points, near, tolerance) >= _MIN_SPAN):
        angle = float(np.degrees(np.arccos(np.clip(near.normal @ wanted, -1, 1))))
        flat = f"a flat surface with {near.share:.0%} of the visible area faces there"
        if angle <= _SNAP_ANGLE:
            return Upright(wanted, f"{name}, and {flat}", near)
        return Upright(near.normal, f"{angle:.0f} degrees from {usual}, where {flat}", near)
    other = largest_plane(points, tolerance, below=0.5 if kind == "environment" else below)
    if near is None and other is not None and other.share >= _MIN_SHARE_ANY:
        return Upright(other.normal, f"a flat surface with {other.share:.0%} of the visible area faces there", other)
    if near is None and kind == "environment":
        spread, axes = np.linalg.eigh(np.cov(points.T))
        if spread[0] < 0.25 * spread[1]:
            thin = axes[:, 0] * (1.0 if axes[:, 0] @ wanted >= 0 else -1.0)
            return Upright(thin, "the environment is thinnest there", None)
    return Upright(wanted, f"{name}; no broad flat surface indicates another direction", near)


def visible_points(splats: Splats) -> Float64Array:
    """Draw centres (:data:`POINTS`, 3) of Gaussians with probabilities proportional to their opaque area."""
    weight = visible_area(splats)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(splats), POINTS, p=weight / weight.sum()) if weight.sum() > 0 else np.arange(len(splats))
    return splats.means[chosen].astype(np.float64)


def largest_plane(
    points: Float64Array,
    tolerance: float,
    *,
    towards: Float64Array | None = None,
    within: float = 180.0,
    below: float = 1.0,
) -> Plane | None:
    """Return the plane with the most inliers among points (N, 3), or None.

    Args:
        points: Points.
        tolerance: Maximum distance of inliers from the plane.
        towards: Direction that the normal faces; if None, it faces the side with more points.
        within: Maximum angle between the normal and that direction [degrees].
        below: Maximum fraction of the points behind the plane.
    """
    rng = np.random.default_rng(0)
    corners = points[rng.integers(0, len(points), (_SAMPLES, 3))]
    normals = trimesh.triangles.cross(corners)
    lengths = np.linalg.norm(normals, axis=1)
    apart = lengths > 1e-12
    normals, corners = normals[apart] / lengths[apart, None], corners[apart, 0]
    if towards is not None:
        normals = normals * np.where(normals @ towards < 0, -1.0, 1.0)[:, None]
        straight = normals @ towards >= np.cos(np.radians(within))
        normals, corners = normals[straight], corners[straight]
    best: tuple[int, Float64Array] | None = None
    for normal, corner in zip(normals, corners, strict=True):
        distance = (points - corner) @ normal
        if towards is None and (distance > tolerance).sum() < (distance < -tolerance).sum():
            distance, normal = -distance, -normal
        count = int((np.abs(distance) <= tolerance).sum())
        if (best is None or count > best[0]) and (distance < -2 * tolerance).mean() <= below:
            best = count, np.append(normal, normal @ corner)
    return None if best is None else _fit_plane(points, best[1], tolerance)


def _fit_plane(points: Float64Array, plane: Float64Array, tolerance: float) -> Plane:
    """Refine a plane by least squares on its inliers, in three iterations; ``plane`` is normal and height."""
    normal, height = plane[:3], plane[3]
    inside: BoolArray = np.abs(points @ normal - height) <= tolerance
    for _ in range(3):
        middle = points[inside].mean(axis=0)
        fitted = np.linalg.svd(points[inside] - middle, full_matrices=False)[2][2]
        normal = fitted if fitted @ normal > 0 else -fitted
        height = float(normal @ middle)
        found = np.abs(points @ normal - height) <= tolerance
        if found.sum() < 3:
            break
        inside = found
    thickness = float((points[inside] @ normal - height).std())
    return Plane(np.asarray(normal), float(height), float(inside.mean()), thickness)


def _relative_span(points: Float64Array, plane: Plane, tolerance: float) -> float:
    """Return the area of the points in the plane relative to the footprint of all points, 0 to 1."""
    flat = points @ rotation_to_z(plane.normal).T
    contact = np.abs(flat[:, 2] - plane.height) <= tolerance
    spans = []
    for spread in (flat[contact, :2], flat[:, :2]):
        low, high = np.quantile(spread, (0.01, 0.99), axis=0)
        bulk = spread[((spread >= low) & (spread <= high)).all(axis=1)]
        spans.append(float(shapely.MultiPoint(bulk).convex_hull.area))
    return spans[0] / max(spans[1], 1e-300)


def cut_support(splats: Splats, support: Plane) -> BoolArray:
    """Return a mask (N,) of the Gaussians that remain after removal of a flat surface and everything below it.

    Gaussians in the surface remain where an object stands on it, that is, where Gaussians lie directly above.
    """
    margin = 3 * support.thickness
    turn = rotation_to_z(support.normal)
    flat = splats.means.astype(np.float64) @ turn.T
    above = flat[:, 2] - support.height
    size = float(np.ptp(np.quantile(flat[above > margin], (0.01, 0.99), axis=0), axis=0).max(initial=0.0))
    slab = (above > margin) & (above < margin + 0.1 * size) & (splats.opacities > 0.1)
    kept = above > margin
    if slab.any():
        low, high = np.quantile(flat[slab, :2], (0.01, 0.99), axis=0)
        cell = 0.01 * size
        inside = ((flat[:, :2] >= low) & (flat[:, :2] <= high)).all(axis=1)
        place = ((np.where(inside[:, None], flat[:, :2], low) - low) / cell).astype(np.int64)
        foot = np.zeros(place.max(axis=0) + 1, dtype=bool)
        foot[tuple(place[slab & inside].T)] = True
        foot = binary_erosion(binary_fill_holes(binary_closing(np.pad(foot, 3), iterations=2)))[3:-3, 3:-3]
        frames = Rotation.from_quat(splats.quats).as_matrix()
        upright = np.linalg.norm(np.einsum("i,nij->nj", support.normal, frames) * splats.scales, axis=1)
        kept |= inside & (np.abs(above) <= margin) & (upright < margin) & foot[tuple(place.T)]
    return np.asarray(kept)
