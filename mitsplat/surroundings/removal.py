"""Removal of an object from a support, and completion of the surfaces behind it.

Points that stand on the support are separated into connected objects. Each Gaussian belongs to the object of its
nearest point, and so do Gaussians that reach into its volume. No photo shows the support below the object, or a wall
close behind it. Both are filled with patches of the same surface (:mod:`.texture_fill`), as sheets of flat Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_fill_holes, label
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.capture.capture import Capture
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.rigid import transform_points
from mitsplat.progress import Progress
from mitsplat.surroundings.coverage import MAX_THING_HEIGHT, SUPPORT_TOLERANCE
from mitsplat.surroundings.depth_views import SurfacePoints, depth_views
from mitsplat.surroundings.ground import CELL, Grid, Ground
from mitsplat.surroundings.supports import Support, find_walls
from mitsplat.surroundings.texture_fill import dilated, fill_texture

_VOXEL = 0.02
"""Edge of the voxels that separate objects, as a share of the typical depth."""
_SPARSE_SHARE = 0.05
"""Number of points in a voxel below which it counts as free, as a share of the median number."""
_PICK_TOLERANCE = 3
"""Largest distance between a picked position and a point of the object [voxels]."""
_MAX_OVERHANG = 3
"""Largest overhang of an object beyond its support [voxels]."""
_RADIUS_SIGMAS = 2.0
"""Radius of a Gaussian in standard deviations."""
_OTHER_DISTANCE = 0.5
"""Distance from the surface of another object above which a Gaussian over the footprint does not belong to that object
[voxels].
"""
_OWNER_MARGIN = 4
"""Margin around an object in which the nearest point decides on the owner of a Gaussian [voxels]."""
_BLEED_WIDTH = 2
"""Width of the border around the hidden area whose colours the object affects, in units of ``SUPPORT_TOLERANCE``."""
_FEET_RANGE = 0.4
"""Half the height range of an object's feet around half of :data:`SUPPORT_TOLERANCE`, as a share of it."""
_STRAY_SHARE = 0.02
"""Share of an object's points that are ignored for its distance from a wall."""


@dataclass(frozen=True, eq=False)
class RemovedObject:
    """A removed object, in the support's frame.

    Attributes:
        pick: The pick as given.
        support: Index of its support.
        gaussians: Number of its Gaussians.
        low: Least x, y and z of its visible points, shape (3,).
        high: Largest x, y and z of its visible points, shape (3,).
        filled: Centres of the filled cells, (N, 2).
        area: Area of these cells.
        behind: Filled area on walls behind it.
        copied: Share of the filled area that repeats other parts of the same surface; the rest is a smooth
            interpolation.
    """

    pick: str
    support: int
    gaussians: int
    low: Float64Array
    high: Float64Array
    filled: Float64Array
    area: float
    behind: float
    copied: float

    @property
    def filled_area(self) -> float:
        """Total filled area."""
        return self.area + self.behind


def remove_objects(
    splats: Splats,
    picks: Sequence[str],
    capture: Capture,
    supports: Sequence[Support],
    points: SurfacePoints,
    scale: float,
    progress: Progress | None = None,
) -> tuple[Splats, list[RemovedObject]]:
    """Remove picked objects one after the other, and fill the surfaces that they hid.

    Args:
        splats: Splats of the scene.
        picks: PHOTO:X,Y [px] on each object.
        capture: Photos in the splats' frame.
        supports: Supports of objects.
        points: Surface points of the training photos.
        scale: Typical depth of the photos.
        progress: Called after each object.

    Returns:
        The splats, and the removed objects.

    Raises:
        InputError: If there is no such photo, or the pixel shows nothing that stands on a support.
    """
    walls = find_walls(points, scale)
    surfaces = [*supports, *walls]
    fitted, places, grounds, removed = splats, points.places, dict[int, Ground](), list[RemovedObject]()

    def ground(number: int) -> Ground:
        """Return the texture of a surface, including earlier fills."""
        if number not in grounds:
            grounds[number] = Ground.of(surfaces[number], fitted, capture, scale)
        return grounds[number]

    for pick in picks:
        number, spot = _find_pick(splats, pick, capture, supports, scale)
        splats, own, places, body = _remove_object(splats, pick, number, spot, ground(number), walls, places, scale)
        for place, wall in enumerate(walls, len(supports)):
            if _is_close_to_wall(own, wall, scale):
                splats, area, copied = _fill_behind(splats, own, places, ground(place), scale)
                if area > 0:
                    share = (body.copied * body.filled_area + copied * area) / (body.filled_area + area)
                    body = replace(body, behind=body.behind + area, copied=share)
        removed.append(body)
        if progress is not None:
            progress(len(removed), len(picks), "removing objects")
    return splats, removed


def _remove_object(
    splats: Splats,
    pick: str,
    number: int,
    spot: Float64Array,
    ground: Ground,
    walls: Sequence[Support],
    places: Float64Array,
    scale: float,
) -> tuple[Splats, Float64Array, Float64Array, RemovedObject]:
    """Return the splats without the object, its points (M, 3), all other points (N, 3), and its description."""
    support, grid = ground.support, ground.grid
    inverse = np.asarray(np.linalg.inv(support.pose))
    # Points on walls are excluded, so that an object that touches a wall ends there.
    loose = ~np.any(
        [np.zeros(len(places), dtype=bool), *(w.contains(places, SUPPORT_TOLERANCE * scale) for w in walls)], axis=0
    )
    body, others = _separate_object(support.local(places), loose, spot, support, scale)
    if body is None:
        raise InputError(f"{pick}: the photos do not show enough of the object to separate it from its surroundings")
    standing, footprint, hole = _hidden_cells(ground, body, others, scale)
    gone = _object_gaussians(splats.transformed(inverse), body, others, grid, footprint, hole, scale)
    sheet, copied = _fill_hole(ground, standing, hole)
    removed = RemovedObject(
        pick=pick,
        support=number,
        gaussians=int(gone.sum()),
        low=body.min(axis=0),
        high=body.max(axis=0),
        filled=grid.middles[hole],
        area=float(hole.sum()) * grid.cell**2,
        behind=0.0,
        copied=copied,
    )
    left = Splats.concatenate([splats.select(~gone), sheet])
    cells = grid.cells(others[:, :2])
    feet = (
        (cells >= 0).all(axis=1)
        & footprint[tuple(cells.T)]
        & (np.abs(others[:, 2] / (SUPPORT_TOLERANCE * scale) - 0.5) < _FEET_RANGE)
    )
    parts = np.concatenate([body, others[feet]]), others[~feet]
    own, rest = (transform_points(support.pose, part) for part in parts)
    return left, own, rest, removed


def _is_close_to_wall(body: Float64Array, wall: Support, scale: float) -> bool:
    """Return True if points (N, 3) of an object are in front of a wall and nearer to it than the object is wide.

    An object farther away hides nothing from all cameras, because some of them see past it.
    """
    local = wall.local(body)
    before = (np.abs(local[:, :2]) <= np.array(wall.size) / 2).all(axis=1)
    if not before.any() or np.median(local[:, 2]) < SUPPORT_TOLERANCE * scale:
        return False
    return bool(
        -SUPPORT_TOLERANCE * scale < np.quantile(local[:, 2], _STRAY_SHARE) < np.ptp(local[:, :2], axis=0).max()
    )


def _fill_behind(
    splats: Splats, body: Float64Array, others: Float64Array, ground: Ground, scale: float
) -> tuple[Splats, float, float]:
    """Fill the area of a wall that a removed object hid; return the splats, the area, and the share that is copied."""
    wall = ground.support
    standing, _, hole = _hidden_cells(ground, wall.local(body), wall.local(others), scale)
    if not hole.any():
        return splats, 0.0, 1.0
    guessed = _hole_gaussians(splats.transformed(np.linalg.inv(wall.pose)), ground.grid, hole, scale)
    sheet, copied = _fill_hole(ground, standing, hole)
    area = float(hole.sum()) * ground.grid.cell**2
    return Splats.concatenate([splats.select(~guessed), sheet]), area, copied


def _hidden_cells(
    ground: Ground, body: Float64Array, others: Float64Array, scale: float
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return cells of a surface that other points stand on, that an object is above, and that it hid, (X, Y) each.

    Points are in the surface's frame, shape (N, 3).
    """
    height, top, margin = others[:, 2], float(body[:, 2].max()), round(SUPPORT_TOLERANCE / CELL)
    standing = ground.grid.covered(others[(height > SUPPORT_TOLERANCE * scale) & (height < top)])
    footprint = dilated(ground.grid.outline(body), margin) & ~standing  # surface points lie away from edges
    parts, _ = label(~ground.seen & ~standing)
    hidden = np.isin(parts, np.setdiff1d(parts[footprint], [0]))
    core = binary_fill_holes(hidden & dilated(footprint, 4 * margin))
    return standing, footprint, dilated(np.asarray(core), _BLEED_WIDTH * margin) & ~standing


def _fill_hole(ground: Ground, standing: BoolArray, hole: BoolArray) -> tuple[Splats, float]:
    """Return a sheet for a hole of a surface, and the share of it that is copied; the hole then counts as seen."""
    margin = round(SUPPORT_TOLERANCE / CELL)
    ground.texture, copied = fill_texture(ground.texture, ground.seen & ~hole & ~dilated(standing, margin), hole)
    ground.seen = ground.seen | hole
    # The sheet also covers the border of the hole, where Gaussians of the object extended.
    sheet = ground.grid.sheet(ground.texture, ground.seen & dilated(hole, margin))
    return sheet.transformed(ground.support.pose), copied


def _find_pick(
    splats: Splats, pick: str, capture: Capture, supports: Sequence[Support], scale: float
) -> tuple[int, Float64Array]:
    """Return the index of the support below the object at a pixel, and the position (3,) in the support's frame."""
    photo, pixel = capture.picked(pick)
    camera = photo.camera
    (view,) = depth_views(splats, [camera])
    ray = camera.world_from_camera[:3, :3] @ camera.rays([pixel])[0]
    depth = float(view.depths_at((camera.centre + scale * ray)[None])[1][0])
    spot = camera.centre + (depth if np.isfinite(depth) else np.nan) * ray  # NaN stands on no support
    found, lowest = -1, np.inf
    for number, support in enumerate(supports):
        local = support.local(spot)
        above = SUPPORT_TOLERANCE * scale < local[2] < min(lowest, MAX_THING_HEIGHT * scale)
        if above and (np.abs(local[:2]) <= np.array(support.size) / 2).all():
            found, lowest = number, float(local[2])
    if found < 0:
        raise InputError(f"{pick}: an object to remove must stand on one of the detected level surfaces")
    return found, supports[found].local(spot)


def _separate_object(
    points: Float64Array, loose: BoolArray, spot: Float64Array, support: Support, scale: float
) -> tuple[Float64Array | None, Float64Array]:
    """Return the points of the object at a position, or None, and all other points without stray ones.

    The result is in the support's frame.

    Only ``loose`` points (N,) can belong to an object. An overhang of a few voxels beyond the support is included.
    """
    over = (np.abs(points[:, :2]) <= np.array(support.size) / 2).all(axis=1)
    high = loose & (points[:, 2] > SUPPORT_TOLERANCE * scale) & (points[:, 2] < MAX_THING_HEIGHT * scale)
    standing = np.flatnonzero(over & high)
    if not len(standing):
        return None, points
    edge = _VOXEL * scale
    voxel = np.floor(points[standing] / edge).astype(np.int64)
    low = voxel.min(axis=0) - 1
    voxel -= low
    count: Int64Array = np.zeros(voxel.max(axis=0) + 2, dtype=np.int64)
    np.add.at(count, tuple(voxel.T), 1)
    parts = np.asarray(label(count > _SPARSE_SHARE * np.median(count[count > 0]), np.ones((3, 3, 3)))[0])
    near = np.argwhere(parts > 0)
    gaps = np.linalg.norm((near + low + 0.5) * edge - spot, axis=1)
    if not len(near) or gaps.min() > _PICK_TOLERANCE * edge:
        return None, points
    part = parts[tuple(voxel.T)]
    own = part == parts[tuple(near[gaps.argmin()])]
    body = points[standing[own]]
    beside = np.flatnonzero(~over & high)
    away = KDTree(_subsample(body, 0.5 * edge)).query(points[beside], distance_upper_bound=_MAX_OVERHANG * edge)[0]
    beside = beside[np.isfinite(away)]
    gone = np.concatenate([standing[own | (part == 0)], beside])
    return np.concatenate([body, points[beside]]), np.delete(points, gone, axis=0)


def _object_gaussians(
    splats: Splats,
    body: Float64Array,
    others: Float64Array,
    grid: Grid,
    footprint: BoolArray,
    hole: BoolArray,
    scale: float,
) -> BoolArray:
    """Return True for Gaussians (N,) to remove: on the surface and inside the object, and in or below the hole."""
    reach, means = _VOXEL * scale, splats.means.astype(np.float64)
    beside = _OWNER_MARGIN * reach
    low, high = body.min(axis=0) - beside, body.max(axis=0) + beside
    low[2] = -MAX_THING_HEIGHT * scale
    rows = np.flatnonzero(((means > low) & (means < high)).all(axis=1))
    around = others[((others > low - beside) & (others < high + beside)).all(axis=1)]
    surface, around = _subsample(body, 0.25 * reach), _subsample(around, 0.25 * reach)
    both = np.concatenate([surface, around])
    away, nearest = KDTree(both).query(means[rows])
    own, bare = nearest < len(surface), both[nearest, 2] < SUPPORT_TOLERANCE * scale
    cells = grid.cells(means[rows, :2])
    height = means[rows, 2]
    floor, top = SUPPORT_TOLERANCE * scale, float(body[:, 2].max()) + 0.5 * reach
    inside = np.asarray((cells >= 0).all(axis=1))
    cells = np.where(inside[:, None], cells, 0)
    over = inside & footprint[tuple(cells.T)]
    goes = (own | (over & (bare | (away > _OTHER_DISTANCE * reach)) & (height < top))) & (height > floor)
    gone = _gaussians_reaching(splats, grid.inside(body, footprint, reach)) | _hole_gaussians(splats, grid, hole, scale)
    gone[rows[goes]] = True
    return gone


def _hole_gaussians(splats: Splats, grid: Grid, hole: BoolArray, scale: float) -> BoolArray:
    """Return True for Gaussians (N,) in the hole of a surface, or below it and reaching out of it.

    The splats are in the surface's frame.
    """
    means = splats.means.astype(np.float64)
    floor, height, cells = SUPPORT_TOLERANCE * scale, means[:, 2], grid.cells(means[:, :2])
    near = (cells >= 0).all(axis=1) & (height <= floor) & (height > -MAX_THING_HEIGHT * scale)
    rows = np.flatnonzero(near)
    rows = rows[hole[tuple(cells[rows].T)]]
    axes = Rotation.from_quat(splats.quats[rows]).as_matrix()[:, 2]
    tip = height[rows] + _RADIUS_SIGMAS * np.sqrt(((axes * splats.scales[rows]) ** 2).sum(axis=1))
    guessed = np.zeros(len(splats), dtype=bool)
    guessed[rows[(height[rows] >= -floor) | (tip > floor)]] = True
    return guessed


def _gaussians_reaching(splats: Splats, places: Float64Array) -> BoolArray:
    """Return True for Gaussians (N,) that reach any of the given positions.

    The positions were hidden, so no photo constrains Gaussians there.
    """
    found = np.zeros(len(splats), dtype=bool)
    if not len(places):
        return found
    middle = places.mean(axis=0)
    radius = np.linalg.norm(places - middle, axis=1).max()
    away = np.linalg.norm(splats.means - middle, axis=1)
    rows = np.flatnonzero(away < radius + _RADIUS_SIGMAS * splats.scales.max(axis=1))
    means, scales = splats.means[rows].astype(np.float64), splats.scales[rows]
    axes = Rotation.from_quat(splats.quats[rows]).as_matrix()
    reached = np.zeros(len(rows), dtype=bool)
    for place in places:
        local = np.einsum("nij,ni->nj", axes, place - means) / scales
        reached |= (local**2).sum(axis=1) < _RADIUS_SIGMAS**2
    found[rows[reached]] = True
    return found


def _subsample(points: Float64Array, edge: float) -> Float64Array:
    """Return one of the points (N, 3) in each cube of the given edge."""
    _, first = np.unique(np.floor(points / edge).astype(np.int64), axis=0, return_index=True)
    return points[first]
