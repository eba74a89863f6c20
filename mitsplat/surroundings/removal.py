"""Take a thing away that stands on a support, and fill what it hid with what lies around.

What goes is told by points: those that stand on the support fall into things that lie apart, and each Gaussian is of
what the nearest point is of; so does what reaches into its volume. No photo shows what was below. It is made of pieces
of the support (:mod:`.texture_fill`), and laid down as a sheet of flat Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_fill_holes, label
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.capture.capture import Capture
from mitsplat.errors import InputError
from mitsplat.progress import Progress
from mitsplat.splats import Splats
from mitsplat.surroundings.coverage import OFF, TALL
from mitsplat.surroundings.depth_views import SurfacePoints, depth_views
from mitsplat.surroundings.ground import CELL, Grid, Ground
from mitsplat.surroundings.supports import Support
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
        copied: Share of them that repeats other parts of the support; the rest has a plain colour.
    """

    pick: str
    support: int
    gaussians: int
    low: Float64Array
    high: Float64Array
    filled: Float64Array
    area: float
    copied: float


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
    places, grounds, removed = points.places, dict[int, Ground](), list[RemovedThing]()
    for pick in picks:
        number, spot = _picked(splats, pick, capture, supports, scale)
        if number not in grounds:
            grounds[number] = Ground.of(supports[number], splats, capture, scale)
        splats, places, thing = _remove(splats, pick, number, spot, grounds[number], places, scale)
        removed.append(thing)
        if progress is not None:
            progress(len(removed), len(picks), "removing things")
    return splats, removed


def _remove(
    splats: Splats, pick: str, number: int, spot: Float64Array, ground: Ground, places: Float64Array, scale: float
) -> tuple[Splats, Float64Array, RemovedThing]:
    """Splats and points (N, 3) without the thing at a place of a support, and what it was."""
    support, grid = ground.support, ground.grid
    inverse = np.asarray(np.linalg.inv(support.pose))
    thing, others = _apart(places @ inverse[:3, :3].T + inverse[:3, 3], spot, support, scale)
    if thing is None:
        raise InputError(f"{pick}: the photos do not show enough of what is there to tell it from the rest")
    height, top, margin = others[:, 2], float(thing[:, 2].max()), round(OFF / CELL)
    standing = grid.covered(others[(height > OFF * scale) & (height < top)])
    footprint = dilated(grid.outline(thing), margin) & ~standing  # points keep off edges
    parts, _ = label(~ground.seen & ~standing)
    hidden = np.isin(parts, np.setdiff1d(parts[footprint], [0]))
    core = binary_fill_holes(hidden & dilated(footprint, 4 * margin))
    hole = dilated(np.asarray(core), _BLED * margin) & ~standing
    gone = _of_thing(splats.transformed(inverse), thing, others, grid, footprint, hole, scale)
    ground.texture, copied = fill(ground.texture, ground.seen & ~hole & ~dilated(standing, margin), hole)
    ground.seen = ground.seen | hole
    # Around the hole, too, where what went was reaching to.
    sheet = grid.sheet(ground.texture, ground.seen & dilated(hole, margin)).transformed(support.pose)
    removed = RemovedThing(
        pick=pick,
        support=number,
        gaussians=int(gone.sum()),
        low=thing.min(axis=0),
        high=thing.max(axis=0),
        filled=grid.middles[hole],
        area=float(hole.sum()) * grid.cell**2,
        copied=copied,
    )
    left = others @ support.pose[:3, :3].T + support.pose[:3, 3]
    return Splats.concatenate([splats.select(~gone), sheet]), left, removed


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
        local = (spot - support.pose[:3, 3]) @ support.pose[:3, :3]
        above = OFF * scale < local[2] < min(lowest, TALL * scale)
        if above and (np.abs(local[:2]) <= np.array(support.size) / 2).all():
            found, lowest = number, float(local[2])
    if found < 0:
        raise InputError(f"{pick}: what is to be removed must stand on a level surface that was found")
    support = supports[found]
    return found, np.asarray((spot - support.pose[:3, 3]) @ support.pose[:3, :3])


def _apart(
    points: Float64Array, spot: Float64Array, support: Support, scale: float
) -> tuple[Float64Array | None, Float64Array]:
    """Points of the thing at a place, None if there are none, and others without stray ones, in the support's frame.

    What sticks out beyond the support by some voxels goes along.
    """
    over = (np.abs(points[:, :2]) <= np.array(support.size) / 2).all(axis=1)
    high = (points[:, 2] > OFF * scale) & (points[:, 2] < TALL * scale)
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
    over, in_hole = (inside & part[tuple(cells.T)] for part in (footprint, hole))
    goes = (own | (over & (bare | (away > _ON * reach)) & (height < top))) & (height > floor)
    axes = Rotation.from_quat(splats.quats[rows]).as_matrix()[:, 2]
    tip = height + _REACH * np.sqrt(((axes * splats.scales[rows]) ** 2).sum(axis=1))
    goes |= in_hole & (height <= floor) & ((height >= -floor) | (tip > floor))
    gone = _reaching(splats, grid.inside(thing, footprint, reach))
    gone[rows[goes]] = True
    return gone


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
