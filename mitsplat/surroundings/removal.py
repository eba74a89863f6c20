"""Take a thing away that stands on a support, and fill what it hid with what lies around.

What goes is told by points: those that stand on the support fall into things that lie apart, and each Gaussian is of
what the nearest point is of; so does what reaches into its volume. No photo shows what was below, nor what it hid of a
wall close behind it. Both are made of pieces of the same surface (:mod:`.texture_fill`), laid down as sheets of flat
Gaussians.
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
from mitsplat.progress import Progress
from mitsplat.surroundings.coverage import OFF, TALL
from mitsplat.surroundings.depth_views import SurfacePoints, depth_views
from mitsplat.surroundings.ground import CELL, Grid, Ground
from mitsplat.surroundings.supports import Support, find_walls
from mitsplat.surroundings.texture_fill import dilated, fill

_APART = 0.02
"""Edge of the voxels by which things lie apart, as a share of the typical depth."""
_SPARSE = 0.05
"""Points in a voxel, as a share of the usual number, below which it is taken for free."""
_PICKED = 3
"""Voxels from a pick in which the thing must have a point."""
_OVER = 3
"""Voxels that a thing may stick out beyond its support."""
_REACH = 2.0
"""Standard deviations that a Gaussian reaches."""
_ON = 0.5
"""Voxels from another thing's surface from which a Gaussian over the footprint is none of its own."""
_BESIDE = 4
"""Voxels around a thing in which Gaussians are its own if it is nearer to them than all else."""
_BLED = 2
"""Steps around what is hidden, each as high as what is told from the support, in which colours are the thing's, too."""
_FEET = 0.4
"""Half the span of heights at which a thing's feet are, around the middle of those that count as the support's."""
_STRAY = 0.02
"""Share of a thing's points that do not say how near to a wall it is."""


@dataclass(frozen=True, eq=False)
class RemovedThing:
    """What was taken away, in the support's frame.

    Attributes:
        pick: As it was given.
        support: Number of the support that it stood on.
        gaussians: Of the thing.
        low: Least x, y and z of what photos saw of it.
        high: Largest.
        filled: Middles of the cells that were filled in, (N, 2).
        area: Of these.
        behind: Area that was filled in on walls behind it.
        copied: Share of all these that repeats other parts of the same surface; the rest has a plain colour.
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
    def whole(self) -> float:
        """Area of all that was filled in."""
        return self.area + self.behind


def remove_things(
    splats: Splats,
    picks: Sequence[str],
    capture: Capture,
    supports: Sequence[Support],
    points: SurfacePoints,
    scale: float,
    progress: Progress | None = None,
) -> tuple[Splats, list[RemovedThing]]:
    """The splats without things that were picked, one after the other, and with what they hid filled in.

    Args:
        splats: Of the place.
        picks: PHOTO:X,Y [px] on each thing.
        capture: The photos, in the splats' frame.
        supports: That things stand on.
        points: What the training photos see.
        scale: Their typical depth.
        progress: Told after every thing.

    Raises:
        InputError: If there is no such photo, or nothing is seen there that stands on a support.
    """
    walls = find_walls(points, scale)
    surfaces = [*supports, *walls]
    fitted, places, grounds, removed = splats, points.places, dict[int, Ground](), list[RemovedThing]()

    def ground(number: int) -> Ground:
        """A surface as photos show it, and as it was filled in since."""
        if number not in grounds:
            grounds[number] = Ground.of(surfaces[number], fitted, capture, scale)
        return grounds[number]

    for pick in picks:
        number, spot = _picked(splats, pick, capture, supports, scale)
        splats, own, places, thing = _remove(splats, pick, number, spot, ground(number), walls, places, scale)
        for place, wall in enumerate(walls, len(supports)):
            if _stands_close(own, wall, scale):
                splats, area, copied = _fill_behind(splats, own, places, ground(place), scale)
                share = (thing.copied * thing.whole + copied * area) / (thing.whole + area)
                thing = replace(thing, behind=thing.behind + area, copied=share)
        removed.append(thing)
        if progress is not None:
            progress(len(removed), len(picks), "removing things")
    return splats, removed


def _remove(
    splats: Splats,
    pick: str,
    number: int,
    spot: Float64Array,
    ground: Ground,
    walls: Sequence[Support],
    places: Float64Array,
    scale: float,
) -> tuple[Splats, Float64Array, Float64Array, RemovedThing]:
    """Splats without the thing at a place of a support, its points (M, 3), the others (N, 3), and what it was."""
    support, grid = ground.support, ground.grid
    inverse = np.asarray(np.linalg.inv(support.pose))
    # A thing that touches a wall ends there.
    loose = ~np.any([np.zeros(len(places), dtype=bool), *(w.holds(places, OFF * scale) for w in walls)], axis=0)
    thing, others = _apart(support.local(places), loose, spot, support, scale)
    if thing is None:
        raise InputError(f"{pick}: the photos do not show enough of what is there to tell it from the rest")
    standing, footprint, hole = _hidden(ground, thing, others, scale)
    gone = _of_thing(splats.transformed(inverse), thing, others, grid, footprint, hole, scale)
    sheet, copied = _filled(ground, standing, hole)
    removed = RemovedThing(
        pick=pick,
        support=number,
        gaussians=int(gone.sum()),
        low=thing.min(axis=0),
        high=thing.max(axis=0),
        filled=grid.middles[hole],
        area=float(hole.sum()) * grid.cell**2,
        behind=0.0,
        copied=copied,
    )
    left = Splats.concatenate([splats.select(~gone), sheet])
    cells = grid.cells(others[:, :2])
    feet = (cells >= 0).all(axis=1) & footprint[tuple(cells.T)] & (np.abs(others[:, 2] / (OFF * scale) - 0.5) < _FEET)
    parts = np.concatenate([thing, others[feet]]), others[~feet]
    own, rest = (part @ support.pose[:3, :3].T + support.pose[:3, 3] for part in parts)
    return left, own, rest, removed


def _stands_close(thing: Float64Array, wall: Support, scale: float) -> bool:
    """Whether points (N, 3) on a thing are before a wall and nearer to it than they are wide.

    Farther away it hides nothing that cameras all around it do not see past it.
    """
    local = wall.local(thing)
    before = (np.abs(local[:, :2]) <= np.array(wall.size) / 2).all(axis=1)
    if not before.any() or np.median(local[:, 2]) < OFF * scale:
        return False
    return bool(-OFF * scale < np.quantile(local[:, 2], _STRAY) < np.ptp(local[:, :2], axis=0).max())


def _fill_behind(
    splats: Splats, thing: Float64Array, others: Float64Array, ground: Ground, scale: float
) -> tuple[Splats, float, float]:
    """Splats with what a thing that was taken away hid of a wall, the area of that, and the share that is copied."""
    wall = ground.support
    standing, _, hole = _hidden(ground, wall.local(thing), wall.local(others), scale)
    if not hole.any():
        return splats, 0.0, 1.0
    guessed = _guesses(splats.transformed(np.linalg.inv(wall.pose)), ground.grid, hole, scale)
    sheet, copied = _filled(ground, standing, hole)
    area = float(hole.sum()) * ground.grid.cell**2
    return Splats.concatenate([splats.select(~guessed), sheet]), area, copied


def _hidden(
    ground: Ground, thing: Float64Array, others: Float64Array, scale: float
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Cells of a surface that other points stand on, that a thing is over, and that it hid, (X, Y) each.

    Points are in the surface's frame, shape (N, 3).
    """
    height, top, margin = others[:, 2], float(thing[:, 2].max()), round(OFF / CELL)
    standing = ground.grid.covered(others[(height > OFF * scale) & (height < top)])
    footprint = dilated(ground.grid.outline(thing), margin) & ~standing  # points keep off edges
    parts, _ = label(~ground.seen & ~standing)
    hidden = np.isin(parts, np.setdiff1d(parts[footprint], [0]))
    core = binary_fill_holes(hidden & dilated(footprint, 4 * margin))
    return standing, footprint, dilated(np.asarray(core), _BLED * margin) & ~standing


def _filled(ground: Ground, standing: BoolArray, hole: BoolArray) -> tuple[Splats, float]:
    """A sheet for a hole of a surface, which then counts as seen, and the share of it that is copied."""
    margin = round(OFF / CELL)
    ground.texture, copied = fill(ground.texture, ground.seen & ~hole & ~dilated(standing, margin), hole)
    ground.seen = ground.seen | hole
    # Around the hole, too, where what went was reaching to.
    sheet = ground.grid.sheet(ground.texture, ground.seen & dilated(hole, margin))
    return sheet.transformed(ground.support.pose), copied


def _picked(
    splats: Splats, pick: str, capture: Capture, supports: Sequence[Support], scale: float
) -> tuple[int, Float64Array]:
    """The support on which what is seen at a pixel stands, and the place (3,) in its frame."""
    photo, pixel = capture.picked(pick)
    camera = photo.camera
    ray = np.append(camera.ray_slopes([pixel])[0], 1.0)
    (view,) = depth_views(splats, [camera])
    ray = ray @ camera.world_from_camera[:3, :3].T
    depth = float(view.look((camera.centre + scale * ray)[None])[1][0])
    spot = camera.centre + (depth if np.isfinite(depth) else np.nan) * ray  # what is NaN stands on nothing
    found, lowest = -1, np.inf
    for number, support in enumerate(supports):
        local = support.local(spot)
        above = OFF * scale < local[2] < min(lowest, TALL * scale)
        if above and (np.abs(local[:2]) <= np.array(support.size) / 2).all():
            found, lowest = number, float(local[2])
    if found < 0:
        raise InputError(f"{pick}: what is to be removed must stand on a level surface that was found")
    return found, supports[found].local(spot)


def _apart(
    points: Float64Array, loose: BoolArray, spot: Float64Array, support: Support, scale: float
) -> tuple[Float64Array | None, Float64Array]:
    """Points of the thing at a place, None if there are none, and others without stray ones, in the support's frame.

    Only ``loose`` ones (N,) can be of a thing. What sticks out beyond the support by some voxels goes along.
    """
    over = (np.abs(points[:, :2]) <= np.array(support.size) / 2).all(axis=1)
    high = loose & (points[:, 2] > OFF * scale) & (points[:, 2] < TALL * scale)
    standing = np.flatnonzero(over & high)
    if not len(standing):
        return None, points
    edge = _APART * scale
    voxel = np.floor(points[standing] / edge).astype(np.int64)
    low = voxel.min(axis=0) - 1
    voxel -= low
    count: Int64Array = np.zeros(voxel.max(axis=0) + 2, dtype=np.int64)
    np.add.at(count, tuple(voxel.T), 1)
    parts = np.asarray(label(count > _SPARSE * np.median(count[count > 0]), np.ones((3, 3, 3)))[0])
    near = np.argwhere(parts > 0)
    gaps = np.linalg.norm((near + low + 0.5) * edge - spot, axis=1)
    if not len(near) or gaps.min() > _PICKED * edge:
        return None, points
    part = parts[tuple(voxel.T)]
    own = part == parts[tuple(near[gaps.argmin()])]
    thing = points[standing[own]]
    beside = np.flatnonzero(~over & high)
    away = KDTree(_thinned(thing, 0.5 * edge)).query(points[beside], distance_upper_bound=_OVER * edge)[0]
    beside = beside[np.isfinite(away)]
    gone = np.concatenate([standing[own | (part == 0)], beside])
    return np.concatenate([thing, points[beside]]), np.delete(points, gone, axis=0)


def _of_thing(
    splats: Splats,
    thing: Float64Array,
    others: Float64Array,
    grid: Grid,
    footprint: BoolArray,
    hole: BoolArray,
    scale: float,
) -> BoolArray:
    """Which Gaussians (N,) go with a thing: its surface, what is inside of it, and what fills the hole by guess."""
    reach, means = _APART * scale, splats.means.astype(np.float64)
    beside = _BESIDE * reach
    low, high = thing.min(axis=0) - beside, thing.max(axis=0) + beside
    low[2] = -TALL * scale
    rows = np.flatnonzero(((means > low) & (means < high)).all(axis=1))
    around = others[((others > low - beside) & (others < high + beside)).all(axis=1)]
    surface, around = _thinned(thing, 0.25 * reach), _thinned(around, 0.25 * reach)
    both = np.concatenate([surface, around])
    away, nearest = KDTree(both).query(means[rows])
    own, bare = nearest < len(surface), both[nearest, 2] < OFF * scale
    cells = grid.cells(means[rows, :2])
    height = means[rows, 2]
    floor, top = OFF * scale, float(thing[:, 2].max()) + 0.5 * reach
    inside = np.asarray((cells >= 0).all(axis=1))
    cells = np.where(inside[:, None], cells, 0)
    over = inside & footprint[tuple(cells.T)]
    goes = (own | (over & (bare | (away > _ON * reach)) & (height < top))) & (height > floor)
    gone = _reaching(splats, grid.inside(thing, footprint, reach)) | _guesses(splats, grid, hole, scale)
    gone[rows[goes]] = True
    return gone


def _guesses(splats: Splats, grid: Grid, hole: BoolArray, scale: float) -> BoolArray:
    """Which Gaussians (N,) are in the hole of a surface, or below it and reach out of it, in the surface's frame."""
    floor, height, cells = (
        OFF * scale,
        splats.means[:, 2].astype(np.float64),
        grid.cells(splats.means[:, :2].astype(np.float64)),
    )
    near = (cells >= 0).all(axis=1) & (height <= floor) & (height > -TALL * scale)
    rows = np.flatnonzero(near)
    rows = rows[hole[tuple(cells[rows].T)]]
    axes = Rotation.from_quat(splats.quats[rows]).as_matrix()[:, 2]
    tip = height[rows] + _REACH * np.sqrt(((axes * splats.scales[rows]) ** 2).sum(axis=1))
    guessed = np.zeros(len(splats), dtype=bool)
    guessed[rows[(height[rows] >= -floor) | (tip > floor)]] = True
    return guessed


def _reaching(splats: Splats, places: Float64Array) -> BoolArray:
    """Which Gaussians (N,) reach any of some places: as these were hidden, no photo has a say in what is there."""
    found = np.zeros(len(splats), dtype=bool)
    if not len(places):
        return found
    middle = places.mean(axis=0)
    radius = np.linalg.norm(places - middle, axis=1).max()
    away = np.linalg.norm(splats.means - middle, axis=1)
    rows = np.flatnonzero(away < radius + _REACH * splats.scales.max(axis=1))
    means, scales = splats.means[rows].astype(np.float64), splats.scales[rows]
    axes = Rotation.from_quat(splats.quats[rows]).as_matrix()
    reached = np.zeros(len(rows), dtype=bool)
    for place in places:
        local = np.einsum("nij,ni->nj", axes, place - means) / scales
        reached |= (local**2).sum(axis=1) < _REACH**2
    found[rows[reached]] = True
    return found


def _thinned(points: Float64Array, edge: float) -> Float64Array:
    """One of the points (N, 3) in each cube of an edge."""
    _, first = np.unique(np.floor(points / edge).astype(np.int64), axis=0, return_index=True)
    return points[first]
