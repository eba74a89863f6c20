"""Top-down map of a support: covered cells, free cells, and cells that few photos show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_closing, binary_dilation, binary_erosion, label

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import direction
from mitsplat.surroundings.depth_views import DepthView, SurfacePoints, depth_views
from mitsplat.surroundings.supports import Support

CELLS = 80
"""Number of cells along the longer side."""
MIN_PHOTOS = 3
"""Least number of photos that must show a cell."""
SUPPORT_TOLERANCE = 0.012
"""Largest height above the support that still counts as the support, as a share of the typical depth."""
MAX_THING_HEIGHT = 0.6
"""Largest height of objects that stand on a support, as a share of the typical depth."""
_MIN_HOLE_AREA = 0.005
"""Least area of a hole in the report, as a share of the support's area."""
_MAX_HOLES = 3
_AZIMUTHS, _ELEVATIONS = 8, (35.0, 65.0)
_VIEW_SIZE = 120
"""Longest edge of the pictures that test views of a hole [px]."""


@dataclass(frozen=True, eq=False)
class Hole:
    """A part of a support that too few photos show.

    Attributes:
        centre: Centre in the support's frame, x and y.
        area: Area of the hole.
        nearest_photo: Name of the photo whose camera is nearest to the best viewpoint; None if no viewpoint sees the
            hole.
        elevation: Elevation of the best viewpoint above the hole [degrees].
        visible_share: Share of the hole that is visible from there.
    """

    centre: tuple[float, float]
    area: float
    nearest_photo: str | None
    elevation: float
    visible_share: float


@dataclass(frozen=True, eq=False)
class Coverage:
    """Cells of a support, first axis x.

    Attributes:
        cell: Edges along x and y, shape (2,).
        photos: Number of photos that show each cell, (X, Y).
        covered: True if something stands on the cell, (X, Y).
    """

    cell: Float64Array
    photos: Int64Array
    covered: BoolArray

    @property
    def hidden(self) -> BoolArray:
        """True for uncovered cells that fewer than :data:`MIN_PHOTOS` photos show, (X, Y)."""
        return (self.photos < MIN_PHOTOS) & ~self.covered

    @property
    def free(self) -> BoolArray:
        """True for visible cells that are neither covered, nor next to covered cells, nor at the edge, (X, Y)."""
        good = (self.photos >= MIN_PHOTOS) & ~binary_dilation(self.covered, np.ones((3, 3)))
        return np.asarray(binary_erosion(good))

    def cell_centres(self, cells: npt.ArrayLike) -> Float64Array:
        """Return the centres of cells (N, 2) in the support's frame, (N, 2)."""
        return np.asarray(
            (np.asarray(cells, dtype=np.float64) + 0.5) * self.cell - np.array(self.photos.shape) * self.cell / 2
        )

    def cells_with(self, flat: Float64Array) -> BoolArray:
        """Return True for cells that contain points (N, 2) of the support's frame, (X, Y)."""
        shape = self.photos.shape
        index = np.floor(flat / self.cell + np.array(shape) / 2).astype(np.int64)
        held = np.zeros(shape, dtype=bool)
        held[tuple(index[((index >= 0) & (index < shape)).all(axis=1)].T)] = True
        return held


def find_coverage(support: Support, views: Sequence[DepthView], points: SurfacePoints, scale: float) -> Coverage:
    """Compute the coverage of a support from all photos.

    Args:
        support: The support.
        views: Depth views of the photos.
        points: Surface points of the photos.
        scale: Typical depth of the photos.
    """
    longer = max(support.size)
    shape = np.maximum(np.rint(np.array(support.size) / longer * CELLS), 1).astype(int)
    cell = np.array(support.size) / shape
    photos: Int64Array = np.zeros(shape, dtype=np.int64)
    empty = Coverage(cell, photos, np.zeros(shape, dtype=bool))
    flat = empty.cell_centres(np.argwhere(np.ones(shape)))
    world = _to_scene(support, flat)
    for view in views:
        height = float((view.camera.centre - support.pose[:3, 3]) @ support.pose[:3, 2])
        if height <= 0:  # it shows the lower side, at the same depth if the support is thin
            continue
        depth, surface = view.depths_at(world)
        # Height above the support of the surface point that the ray to a cell hits.
        above = height * (1 - surface / depth)
        photos += (np.abs(above) < SUPPORT_TOLERANCE * scale).reshape(shape)
    local = support.local(points.places)
    standing = (local[:, 2] > SUPPORT_TOLERANCE * scale) & (local[:, 2] < MAX_THING_HEIGHT * scale)
    covered = empty.cells_with(local[standing, :2])
    return Coverage(
        cell, photos, np.asarray(binary_closing(np.pad(covered, 3), np.ones((3, 3)), iterations=2)[3:-3, 3:-3])
    )


def _to_scene(support: Support, flat: Float64Array) -> Float64Array:
    """Transform points (N, 2) from a support's frame to the scene, (N, 3)."""
    return np.asarray(flat @ support.pose[:3, :2].T + support.pose[:3, 3])


def free_rectangle(free: BoolArray) -> tuple[int, int, int, int] | None:
    """Return the largest rectangle of True cells (H, W): first row, end row, first column and end column, or None.

    The ends are exclusive.
    """
    best, area = None, 0
    run = np.zeros(free.shape[1], dtype=np.int64)
    for row in range(free.shape[0]):
        run = np.where(free[row], run + 1, 0)
        for first in range(free.shape[1]):
            depth = np.minimum.accumulate(run[first:])
            sizes = depth * np.arange(1, len(depth) + 1)
            last = int(sizes.argmax())
            if sizes[last] > area:
                area = int(sizes[last])
                best = (row + 1 - int(depth[last]), row + 1, first, first + last + 1)
    return best


def find_holes(
    support: Support, coverage: Coverage, splats: Splats, cameras: Sequence[tuple[str, Camera]]
) -> list[Hole]:
    """Find the largest holes of a support, and the best viewpoint of each.

    Args:
        support: The support.
        coverage: Coverage of the support.
        splats: Splats of the scene.
        cameras: Names and cameras of the photos.
    """
    parts, count = label(coverage.hidden)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    least = _MIN_HOLE_AREA * coverage.hidden.size
    found = []
    for number in np.argsort(-sizes, kind="stable")[:_MAX_HOLES]:
        if sizes[number] < least:
            break
        flat = coverage.cell_centres(np.argwhere(parts == number + 1))
        found.append(_hole(support, flat, float(sizes[number] * coverage.cell.prod()), splats, cameras))
    return found


def _hole(
    support: Support, flat: Float64Array, area: float, splats: Splats, cameras: Sequence[tuple[str, Camera]]
) -> Hole:
    """Search for the viewpoint that shows most of a hole, among directions around it.

    Args:
        support: The support.
        flat: Centres of the cells of the hole in its frame, shape (N, 2).
        area: Area of the hole.
        splats: Splats of the scene.
        cameras: Names and cameras of the photos.
    """
    cells, middle = _to_scene(support, flat), _to_scene(support, flat.mean(axis=0)[None])[0]
    centres = np.array([camera.centre for _, camera in cameras])
    distance = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    first = cameras[0][1]
    edge = max(first.width, first.height)
    best, best_centre, height = 0.0, None, 0.0
    tried, degrees = [], []
    for elevation in _ELEVATIONS:
        for turn in range(_AZIMUTHS):
            outward = support.pose[:3, :3] @ direction(
                2 * np.pi * turn / _AZIMUTHS, float(np.sin(np.radians(elevation)))
            )
            pose = Camera.look_at(
                middle + distance * outward, middle, width=_VIEW_SIZE, height=_VIEW_SIZE, fov_x=60, near=0.05 * distance
            )
            tried.append(pose)
            degrees.append(elevation)
    for view, elevation in zip(depth_views(splats, tried, min(_VIEW_SIZE, edge)), degrees, strict=True):
        depth, surface = view.depths_at(cells)
        # A hole may have no splats, so the test is that no surface lies in front of it.
        shown = float(np.nanmean(surface > 0.97 * depth)) if np.isfinite(depth).any() else 0.0
        if shown > best + 0.05:
            best, best_centre, height = shown, view.camera.centre, elevation
    near = None
    if best_centre is not None:
        near = cameras[int(np.linalg.norm(centres - best_centre, axis=1).argmin())][0]
    return Hole((float(flat[:, 0].mean()), float(flat[:, 1].mean())), area, near, height, best)
