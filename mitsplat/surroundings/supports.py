"""Flat, level surfaces of a scene on which objects can stand (table, shelf, floor), and walls.

Planes are found by RANSAC (Fischler and Bolles 1981) among points on upward surfaces, the largest first. They are
refined by least squares with Cauchy weights. The points of a plane are split into connected parts, and each part is
described by the smallest enclosing rectangle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh
from scipy.ndimage import binary_closing, binary_opening, label

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.camera_poses import direction
from mitsplat.geometry.rigid import homogeneous_matrix, split_similarity, transform_points
from mitsplat.importing.upright import POINTS, largest_plane, rotation_to_z
from mitsplat.surroundings.depth_views import SurfacePoints

_NORMAL_ANGLE = 25.0
"""Largest angle between the normals of a point and of its plane [degrees]."""
_TOLERANCE = 0.008
"""Largest distance of a point from its plane, as a share of the typical depth."""
_FIT_SPREADS, _MIN_TOLERANCE = 5.0, 0.001
"""Largest distance after the fit, in median distances, and its lower limit as a share of the typical depth."""
_MIN_PLANE_SHARE = 0.02
"""Least share of the upward points in a plane."""
_MAX_PLANES = 6
"""Largest number of planes."""
_CELL = 0.01
"""Edge of the cells that define the parts of a plane, as a share of the typical depth."""
_MIN_ROW_FILL = 0.5
"""Least number of cells in an outer row of a rectangle, relative to its median row; emptier rows are cut off."""
_TRIMS = 6

_WALL_DIRECTIONS = 6
"""Number of directions in the search for walls."""
_MAX_WALL_LEAN = 10.0
"""Largest angle of a wall to the vertical [degrees]."""
_MAX_BEHIND = 0.05
"""Largest number of points behind a wall, as a share of the points in it."""
_MIN_FILLED = 0.5
"""Least filled share of a support's rectangle."""
_MIN_AREA = 0.02
"""Least area of a support, as a share of the typical depth squared."""


@dataclass(frozen=True, eq=False)
class Support:
    """A flat rectangle on which objects can stand.

    Attributes:
        pose: Frame of the rectangle in the scene, (4, 4): z is its normal, x its longer side, its centre is the origin.
        size: Edges along x and y.
        roughness: Median distance of its points from its plane.
        tilt: Angle of its normal to z [degrees].
        filled: Share of the rectangle that is visible as surface.
        central_share: Share of the central points of all photos that lie on it.
    """

    pose: Float64Array
    size: tuple[float, float]
    roughness: float
    tilt: float
    filled: float
    central_share: float

    @property
    def height(self) -> float:
        """Height z of its centre."""
        return float(self.pose[2, 3])

    @property
    def angle(self) -> float:
        """Rotation of its longer side about z [degrees]."""
        return float(np.degrees(np.arctan2(self.pose[1, 0], self.pose[0, 0])))

    def local(self, points: Float64Array) -> Float64Array:
        """Transform points (N, 3) from the scene to the support's frame."""
        return np.asarray((points - self.pose[:3, 3]) @ self.pose[:3, :3])

    def contains(self, points: Float64Array, margin: float) -> BoolArray:
        """Return True for points (N, 3) of the scene in the rectangle, up to a distance ``margin``."""
        return np.asarray((np.abs(self.local(points)) <= (*(np.array(self.size) / 2 + margin), margin)).all(axis=1))

    def transformed(self, motion: Float64Array) -> Support:
        """Return the support after a similarity transform (4, 4)."""
        rotation, scale, translation = split_similarity(motion)
        pose = homogeneous_matrix(rotation @ self.pose[:3, :3], scale * rotation @ self.pose[:3, 3] + translation)
        return Support(
            pose,
            (scale * self.size[0], scale * self.size[1]),
            scale * self.roughness,
            float(np.degrees(np.arccos(np.clip(pose[2, 2], -1, 1)))),
            self.filled,
            self.central_share,
        )


def find_supports(points: SurfacePoints, up: Float64Array, scale: float, within: float) -> list[Support]:
    """Find level surfaces, sorted by their share of the photos' central points.

    Args:
        points: Surface points of the photos.
        up: Unit vector, shape (3,).
        scale: Typical depth of the photos.
        within: Largest tilt of surfaces against ``up`` [degrees].
    """
    upward = points.normals @ up > np.cos(np.radians(within + _NORMAL_ANGLE))
    places, normals = points.places[upward], points.normals[upward]
    weights = points.central[upward].astype(np.float64) / max(int(points.central.sum()), 1)
    total, found = len(places), list[Support]()
    left = np.ones(total, dtype=bool)
    rng = np.random.default_rng(0)
    for _ in range(_MAX_PLANES):
        rows = np.flatnonzero(left)
        if len(rows) < max(3, _MIN_PLANE_SHARE * total):
            break
        sample = places[rng.choice(rows, min(POINTS, len(rows)), replace=False)]
        plane = largest_plane(sample, _TOLERANCE * scale, towards=up, within=within)
        if plane is None or plane.share * len(rows) < _MIN_PLANE_SHARE * total:
            break
        normal, height, spread = fit_plane(places[left], plane.normal, plane.height, _TOLERANCE * scale)
        inside = left & (np.abs(places @ normal - height) < max(_FIT_SPREADS * spread, _MIN_TOLERANCE * scale))
        inside &= normals @ normal > np.cos(np.radians(_NORMAL_ANGLE))
        left &= np.abs(places @ normal - height) >= 2 * _TOLERANCE * scale
        if inside.any():
            found += _plane_parts(places[inside], weights[inside], normal, height, spread, up, scale)
    found = [support for support in found if support.filled >= _MIN_FILLED]
    return sorted(found, key=lambda support: -support.central_share)


def find_walls(points: SurfacePoints, scale: float) -> list[Support]:
    """Find upright surfaces with almost no visible points behind them.

    The side of an object is not a wall: the top of the object gives points behind its side.

    Args:
        points: Surface points of the photos, z up.
        scale: Typical depth of the photos.
    """
    found = list[Support]()
    for turn in range(_WALL_DIRECTIONS):
        towards = direction(2 * np.pi * turn / _WALL_DIRECTIONS, 0.0)
        for wall in find_supports(points, towards, scale, within=180 / _WALL_DIRECTIONS):
            upright = abs(wall.pose[2, 2]) < np.sin(np.radians(_MAX_WALL_LEAN))
            if (
                upright
                and _is_boundary(wall, points, scale)
                and not any(_coincide(wall, other, scale) for other in found)
            ):
                found.append(wall)
    return found


def _is_boundary(wall: Support, points: SurfacePoints, scale: float) -> bool:
    """Return True if there are almost no points behind a surface, up to its smaller edge."""
    local = wall.local(points.places)
    before = (np.abs(local[:, :2]) <= np.array(wall.size) / 2 + _CELL * scale).all(axis=1)
    depth = local[before, 2]
    behind = (depth < -2 * _TOLERANCE * scale) & (depth > -min(wall.size))
    return bool(behind.sum() < _MAX_BEHIND * (np.abs(depth) < 2 * _TOLERANCE * scale).sum())


def _coincide(one: Support, other: Support, scale: float) -> bool:
    """Return True if the centre of one surface lies in another with the same orientation."""
    inside = other.contains(one.pose[None, :3, 3], _TOLERANCE * scale)[0]
    return bool(inside and one.pose[:3, 2] @ other.pose[:3, 2] > np.cos(np.radians(_NORMAL_ANGLE)))


def fit_plane(
    points: Float64Array, normal: Float64Array, height: float, tolerance: float
) -> tuple[Float64Array, float, float]:
    """Refine a plane with the points (N, 3) near it; return its unit normal, height and median point distance."""
    spread = tolerance / 2
    for _ in range(10):
        distance = points @ normal - height
        near = np.abs(distance) < tolerance
        if near.sum() < 3:
            break
        weight = 1 / (1 + (distance[near] / spread) ** 2)
        middle = weight @ points[near] / weight.sum()
        offset = points[near] - middle
        fitted = np.linalg.eigh((offset * weight[:, None]).T @ offset)[1][:, 0]
        normal = fitted * (1.0 if fitted @ normal > 0 else -1.0)
        height = float(normal @ middle)
        spread = max(float(np.median(np.abs(offset @ normal))), 1e-3 * tolerance)
    return np.asarray(normal), height, spread


def _plane_parts(
    places: Float64Array,
    weights: Float64Array,
    normal: Float64Array,
    height: float,
    spread: float,
    up: Float64Array,
    scale: float,
) -> list[Support]:
    """Return the connected parts of a plane that are large enough."""
    turn = homogeneous_matrix(rotation_to_z(normal))
    flat = (places @ turn[:3, :3].T)[:, :2]
    cell = _CELL * scale
    low = flat.min(axis=0) - 4 * cell
    index = ((flat - low) / cell).astype(np.int64)
    seen: BoolArray = np.zeros(index.max(axis=0) + 5, dtype=bool)
    seen[tuple(index.T)] = True
    # Closing fills gaps between samples; opening separates parts that only touch at a corner.
    solid = binary_opening(binary_closing(seen, np.ones((3, 3)), iterations=2), np.ones((3, 3)), iterations=2)
    parts, count = label(solid)
    of_part = parts[tuple(index.T)]
    found = []
    for number in range(1, count + 1):
        cells = np.argwhere(parts == number)
        if len(cells) * cell**2 < _MIN_AREA * scale**2:
            continue
        corners = _rectangle(low + (cells + 0.5) * cell, cell)
        sides = sorted((corners[1] - corners[0], corners[2] - corners[1]), key=lambda side: -float(np.hypot(*side)))
        along = sides[0] if sides[0][0] >= 0 else -sides[0]
        size = (float(np.hypot(*sides[0])) + cell, float(np.hypot(*sides[1])) + cell)
        pose = trimesh.transformations.rotation_matrix(float(np.arctan2(along[1], along[0])), (0, 0, 1))
        pose[:3, 3] = *corners.mean(axis=0), height
        found.append(
            Support(
                pose=np.linalg.inv(turn) @ pose,
                size=size,
                roughness=spread,
                tilt=float(np.degrees(np.arccos(np.clip(normal @ up, -1, 1)))),
                filled=min(1.0, len(cells) * cell**2 / (size[0] * size[1])),
                central_share=float(weights[of_part == number].sum()),
            )
        )
    return found


def _rectangle(middles: Float64Array, cell: float) -> Float64Array:
    """Return the corners (4, 2) of the smallest rectangle around cells (N, 2), without sparse outer rows."""
    corners = np.zeros((4, 2))
    for _ in range(_TRIMS):
        corners = np.array(shapely.oriented_envelope(shapely.MultiPoint(middles)).exterior.coords)[:4]
        kept = np.ones(len(middles), dtype=bool)
        for side in (corners[1] - corners[0], corners[2] - corners[1]):
            along = (middles - corners[0]) @ (side / max(float(np.hypot(*side)), 1e-12)) / cell
            row = np.rint(along - along.min()).astype(np.int64)
            full = np.flatnonzero(np.bincount(row) >= _MIN_ROW_FILL * np.median(np.bincount(row)))
            kept &= (row >= full[0]) & (row <= full[-1])
        if kept.all():
            break
        middles = middles[kept]
    return corners


def flatten_mesh(mesh: trimesh.Trimesh, supports: Sequence[Support], margin: float) -> trimesh.Trimesh:
    """Move vertices within ``margin`` of supports onto them, because the depth of splats is noisy."""
    vertices = np.array(mesh.vertices, dtype=np.float64)
    for support in supports:
        local, inside = support.local(vertices), support.contains(vertices, margin)
        local[inside, 2] = 0
        vertices[inside] = transform_points(support.pose, local[inside])
    return trimesh.Trimesh(vertices, mesh.faces, process=False)
