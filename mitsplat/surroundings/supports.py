"""Flat, level surfaces of a place that things can stand on, a table, a shelf, the floor; and the walls behind them.

Planes are found by random samples among the points that photos see of upward surfaces (Fischler and Bolles 1981), the
largest first, and fitted by least squares in which points count by Cauchy's weights. What lies in a plane falls into
connected parts, and each is described by the smallest rectangle around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh
from scipy.ndimage import binary_closing, binary_opening, label

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.camera import direction
from mitsplat.importing.upright import POINTS, largest_plane, rotation_to_z
from mitsplat.surroundings.depth_views import SurfacePoints

_SAME = 25.0
"""Angle between the normal of a point and of a plane up to which it may belong to that [degrees]."""
_TOLERANCE = 0.008
"""Distance from a plane up to which a point may belong to it, as a share of the typical depth."""
_SPREADS, _LEAST = 5.0, 0.001
"""The same once the plane is fitted: in median distances from it, and at least as a share of the typical depth."""
_SMALLEST = 0.02
"""Share of the upward points from which a plane is looked into."""
_MOST = 6
"""Planes that are looked for."""
_CELL = 0.01
"""Edge of the cells that parts of a plane are found by, as a share of the typical depth."""
_RIM = 0.5
"""Cells in a row of a rectangle, as a share of its median row's, from which the row is no spur."""
_TRIMS = 6

_SIDES = 6
"""Directions that walls are looked for in."""
_LEANING = 10.0
"""Angle to the vertical up to which a surface is a wall [degrees]."""
_BEHIND = 0.05
"""Points behind a wall, as a share of those in it, from which it is none."""
_FILLED = 0.5
"""Share of its rectangle that a support must fill at least."""
_LEAST_AREA = 0.02
"""Area of a support, as a share of the typical depth squared."""


@dataclass(frozen=True, eq=False)
class Support:
    """A flat rectangle that things can stand on.

    Attributes:
        pose: Its frame in the place: z its normal, x along its longer side, its middle the origin, (4, 4).
        size: Along x and y.
        roughness: Median distance of the points on it from its plane.
        tilt: Of its normal against z [degrees].
        filled: Share of the rectangle that is seen as surface.
        looked_at: Share of the middles of the photos that it takes up.
    """

    pose: Float64Array
    size: tuple[float, float]
    roughness: float
    tilt: float
    filled: float
    looked_at: float

    @property
    def height(self) -> float:
        """Where its middle is along z."""
        return float(self.pose[2, 3])

    @property
    def angle(self) -> float:
        """Turn of its longer side about z [degrees]."""
        return float(np.degrees(np.arctan2(self.pose[1, 0], self.pose[0, 0])))

    def local(self, points: Float64Array) -> Float64Array:
        """Points (N, 3) of the place in the support's frame."""
        return np.asarray((points - self.pose[:3, 3]) @ self.pose[:3, :3])

    def holds(self, points: Float64Array, margin: float) -> BoolArray:
        """Which points (N, 3) of the place lie in the rectangle, up to a ``margin``."""
        return np.asarray((np.abs(self.local(points)) <= (*(np.array(self.size) / 2 + margin), margin)).all(axis=1))

    def transformed(self, motion: Float64Array) -> Support:
        """The support after a similarity (4, 4)."""
        scale = float(np.cbrt(np.linalg.det(motion[:3, :3])))
        pose = motion @ self.pose
        pose[:3, :3] /= scale
        return Support(
            pose,
            (scale * self.size[0], scale * self.size[1]),
            scale * self.roughness,
            float(np.degrees(np.arccos(np.clip(pose[2, 2], -1, 1)))),
            self.filled,
            self.looked_at,
        )


def find_supports(points: SurfacePoints, up: Float64Array, scale: float, within: float) -> list[Support]:
    """Level surfaces, the one that photos look at most first.

    Args:
        points: What photos see.
        up: Unit vector, shape (3,).
        scale: The photos' typical depth.
        within: Tilt against ``up`` that surfaces may have [degrees].
    """
    upward = points.normals @ up > np.cos(np.radians(within + _SAME))
    places, normals = points.places[upward], points.normals[upward]
    weights = points.central[upward].astype(np.float64) / max(int(points.central.sum()), 1)
    total, found = len(places), list[Support]()
    left = np.ones(total, dtype=bool)
    rng = np.random.default_rng(0)
    for _ in range(_MOST):
        rows = np.flatnonzero(left)
        if len(rows) < max(3, _SMALLEST * total):
            break
        sample = places[rng.choice(rows, min(POINTS, len(rows)), replace=False)]
        plane = largest_plane(sample, _TOLERANCE * scale, towards=up, within=within)
        if plane is None or plane.share * len(rows) < _SMALLEST * total:
            break
        normal, height, spread = fit_plane(places[left], plane.normal, plane.height, _TOLERANCE * scale)
        inside = left & (np.abs(places @ normal - height) < max(_SPREADS * spread, _LEAST * scale))
        inside &= normals @ normal > np.cos(np.radians(_SAME))
        left &= np.abs(places @ normal - height) >= 2 * _TOLERANCE * scale
        if inside.any():
            found += _parts(places[inside], weights[inside], normal, height, spread, up, scale)
    found = [support for support in found if support.filled >= _FILLED]
    return sorted(found, key=lambda support: -support.looked_at)


def find_walls(points: SurfacePoints, scale: float) -> list[Support]:
    """Upright surfaces with nothing behind them, as :func:`find_supports` finds level ones; sides of things have a top.

    Args:
        points: What photos see, z up.
        scale: The photos' typical depth.
    """
    found = list[Support]()
    for turn in range(_SIDES):
        towards = direction(2 * np.pi * turn / _SIDES, 0.0)
        for wall in find_supports(points, towards, scale, within=180 / _SIDES):
            upright = abs(wall.pose[2, 2]) < np.sin(np.radians(_LEANING))
            if upright and _bounds(wall, points, scale) and not any(_coincide(wall, other, scale) for other in found):
                found.append(wall)
    return found


def _bounds(wall: Support, points: SurfacePoints, scale: float) -> bool:
    """Whether photos see next to nothing behind a surface, as far as it is wide or high."""
    local = wall.local(points.places)
    before = (np.abs(local[:, :2]) <= np.array(wall.size) / 2 + _CELL * scale).all(axis=1)
    depth = local[before, 2]
    behind = (depth < -2 * _TOLERANCE * scale) & (depth > -min(wall.size))
    return bool(behind.sum() < _BEHIND * (np.abs(depth) < 2 * _TOLERANCE * scale).sum())


def _coincide(one: Support, other: Support, scale: float) -> bool:
    """Whether the middle of one surface lies in another that faces as it does."""
    inside = other.holds(one.pose[None, :3, 3], _TOLERANCE * scale)[0]
    return bool(inside and one.pose[:3, 2] @ other.pose[:3, 2] > np.cos(np.radians(_SAME)))


def fit_plane(
    points: Float64Array, normal: Float64Array, height: float, tolerance: float
) -> tuple[Float64Array, float, float]:
    """Unit normal and height of a plane through those of points (N, 3) near it, and their median distance from it."""
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


def _parts(
    places: Float64Array,
    weights: Float64Array,
    normal: Float64Array,
    height: float,
    spread: float,
    up: Float64Array,
    scale: float,
) -> list[Support]:
    """The connected parts of a plane that are large enough."""
    turn = np.eye(4)
    turn[:3, :3] = rotation_to_z(normal)
    flat = (places @ turn[:3, :3].T)[:, :2]
    cell = _CELL * scale
    low = flat.min(axis=0) - 4 * cell
    index = ((flat - low) / cell).astype(np.int64)
    seen: BoolArray = np.zeros(index.max(axis=0) + 5, dtype=bool)
    seen[tuple(index.T)] = True
    # Gaps between samples are closed, and what only touches by a corner is apart.
    solid = binary_opening(binary_closing(seen, np.ones((3, 3)), iterations=2), np.ones((3, 3)), iterations=2)
    parts, count = label(solid)
    of_part = parts[tuple(index.T)]
    found = []
    for number in range(1, count + 1):
        cells = np.argwhere(parts == number)
        if len(cells) * cell**2 < _LEAST_AREA * scale**2:
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
                looked_at=float(weights[of_part == number].sum()),
            )
        )
    return found


def _rectangle(middles: Float64Array, cell: float) -> Float64Array:
    """Corners (4, 2) of the smallest rectangle around cells (N, 2), rims that are hardly filled cut off."""
    corners = np.zeros((4, 2))
    for _ in range(_TRIMS):
        corners = np.array(shapely.oriented_envelope(shapely.MultiPoint(middles)).exterior.coords)[:4]
        kept = np.ones(len(middles), dtype=bool)
        for side in (corners[1] - corners[0], corners[2] - corners[1]):
            along = (middles - corners[0]) @ (side / max(float(np.hypot(*side)), 1e-12)) / cell
            row = np.rint(along - along.min()).astype(np.int64)
            full = np.flatnonzero(np.bincount(row) >= _RIM * np.median(np.bincount(row)))
            kept &= (row >= full[0]) & (row <= full[-1])
        if kept.all():
            break
        middles = middles[kept]
    return corners


def flattened(mesh: trimesh.Trimesh, supports: Sequence[Support], margin: float) -> trimesh.Trimesh:
    """A mesh whose vertices lie in supports where they are within ``margin`` of these, as splats' depth is rough."""
    vertices = np.array(mesh.vertices, dtype=np.float64)
    for support in supports:
        local, inside = support.local(vertices), support.holds(vertices, margin)
        local[inside, 2] = 0
        vertices[inside] = local[inside] @ support.pose[:3, :3].T + support.pose[:3, 3]
    return trimesh.Trimesh(vertices, mesh.faces, process=False)
