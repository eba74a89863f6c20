"""Which way is up in splats whose file does not say so, and the flat surfaces that things stand on.

Files of splats name no axes. Two things tell of the vertical: what is usual for the format, and a large flat surface
that everything else lies above, such as the table that an object was photographed on or the floor of a room. Planes are
found by random samples of three points (Fischler and Bolles 1981, RANSAC) and fitted to their inliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
import shapely
from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_files import Axis
from mitsplat.reconstruct.segment_splats import visible_area

POINTS = 4000
"""Gaussians that planes are looked for among, drawn by the area that they show."""
_SAMPLES = 3000
_TOLERANCE = 0.006
"""Distance from a plane up to which a point belongs to it, as a share of the diagonal of what there is."""
_BELOW = 0.01
"""Share of the points that may lie below what an object stands on."""
_NEAR = 35.0
"""Angle to the usual axis up to which a plane is taken for what is horizontal [degrees]."""
_SMALL, _LARGE = 0.04, 0.25
"""Shares of the points from which a plane near the usual axis, or any other one, says where up is."""
_BROAD = 0.85
"""Share of the ground below everything that a surface must span for an object to be turned by it."""
_SNAP = 1.0
"""Angle up to which the usual axis itself is taken [degrees]."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A flat surface.

    Attributes:
        normal: Unit normal, shape (3,).
        height: Distance from the origin along it.
        share: Share of what there is that lies in it.
        thickness: Standard deviation of that from the plane.
    """

    normal: Float64Array
    height: float
    share: float
    thickness: float


@dataclass(frozen=True, eq=False)
class Upright:
    """Where up is.

    Attributes:
        up: Unit vector in the file's axes, shape (3,).
        reason: Why, in a few words.
        support: The horizontal plane that things stand on, or None.
    """

    up: Float64Array
    reason: str
    support: Plane | None

    @property
    def rotation(self) -> Float64Array:
        """The smallest rotation that takes up to z, shape (3, 3)."""
        return rotation_to_z(self.up)


def axis_vector(axis: str) -> Float64Array:
    """Unit vector of an axis such as ``-y``.

    Raises:
        InputError: If it is none.
    """
    if axis not in get_args(Axis):
        raise InputError(f"up must be auto, {', '.join(get_args(Axis))} (got {axis!r})")
    return np.asarray(np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0))


def rotation_to_z(up: Float64Array) -> Float64Array:
    """The smallest rotation that takes a unit vector to z, shape (3, 3); of -z the one about x."""
    axis = np.cross(up, (0.0, 0.0, 1.0))
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    return np.asarray(Rotation.from_rotvec(axis * np.arctan2(sine, up[2])).as_matrix())


def find_up(splats: Splats, kind: str, usual: Axis, given: Axis | None = None) -> Upright:
    """Which way is up, and the flat surface that things stand on.

    Args:
        splats: What there is, without floaters.
        kind: Of ``object`` nearly all lies above what it stands on; an ``environment`` may go on below a table.
        usual: Axis that points up where nothing says otherwise.
        given: Axis that does; then only the surface is looked for.
    """
    points = visible_points(splats)
    tolerance = _TOLERANCE * float(np.linalg.norm(np.ptp(np.quantile(points, (0.01, 0.99), axis=0), axis=0)))
    wanted = axis_vector(given or usual)
    below = _BELOW if kind == "object" else 1.0
    near = largest_plane(points, tolerance, towards=wanted, within=_NEAR, below=below)
    if near is not None and near.share < _SMALL:
        near = None
    if given is not None:
        return Upright(wanted, f"{given}, as given", near)
    name = f"{usual}, as is usual for such files"
    # What is narrower than the object may be a sole or a side of it, which need not be level.
    if near is not None and (kind == "environment" or _reach(points, near, tolerance) >= _BROAD):
        angle = float(np.degrees(np.arccos(np.clip(near.normal @ wanted, -1, 1))))
        flat = f"a flat surface with {near.share:.0%} of what is seen faces there"
        if angle <= _SNAP:
            return Upright(wanted, f"{name}, and {flat}", near)
        return Upright(near.normal, f"{angle:.0f} degrees from {usual}, where {flat}", near)
    other = largest_plane(points, tolerance, below=0.5 if kind == "environment" else below)
    if near is None and other is not None and other.share >= _LARGE:
        return Upright(other.normal, f"a flat surface with {other.share:.0%} of what is seen faces there", other)
    if near is None and kind == "environment":
        spread, axes = np.linalg.eigh(np.cov(points.T))
        if spread[0] < 0.25 * spread[1]:
            thin = axes[:, 0] * (1.0 if axes[:, 0] @ wanted >= 0 else -1.0)
            return Upright(thin, "the surroundings are thinnest there", None)
    return Upright(wanted, f"{name}; no broad flat surface says otherwise", near)


def visible_points(splats: Splats) -> Float64Array:
    """Centres (:data:`POINTS`, 3) of Gaussians, drawn with the same chance for the same opaque area."""
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
    """The plane that most points (N, 3) lie in, or None.

    Args:
        points: The points.
        tolerance: Distance up to which one belongs to a plane.
        towards: Direction that its normal faces; towards more of the points if None.
        within: Angle that it may differ from there [degrees].
        below: Share of the points that may lie behind it.
    """
    rng = np.random.default_rng(0)
    corners = points[rng.integers(0, len(points), (_SAMPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
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
    return None if best is None else _fitted(points, best[1], tolerance)


def _fitted(points: Float64Array, plane: Float64Array, tolerance: float) -> Plane:
    """A plane through its inliers by least squares, three times over; ``plane`` is normal and height."""
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


def _reach(points: Float64Array, plane: Plane, tolerance: float) -> float:
    """How much of the ground below all points those in the plane span, 0 to 1."""
    flat = points @ rotation_to_z(plane.normal).T
    contact = np.abs(flat[:, 2] - plane.height) <= tolerance
    spans = []
    for spread in (flat[contact, :2], flat[:, :2]):
        low, high = np.quantile(spread, (0.01, 0.99), axis=0)
        bulk = spread[((spread >= low) & (spread <= high)).all(axis=1)]
        spans.append(float(shapely.MultiPoint(bulk).convex_hull.area))
    return spans[0] / max(spans[1], 1e-300)


def cut_support(splats: Splats, support: Plane) -> BoolArray:
    """Which Gaussians (N,) are left without a flat surface and what is below it.

    What lies in the surface stays where something stands on it: where Gaussians lie right above.
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
