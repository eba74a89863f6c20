"""Closed surface from splats and masks: the visual hull intersected with the fused depth of the splats.

The hull (Laurentini 1994) is the set of points that every mask shows as object. It closes the surface in unseen areas,
but it has no concavities. Rendered depth of the splats is fused into a truncated signed distance (Curless and Levoy
1996), which adds the concavities to the depth on which the views agree. Both are distances on one grid, positive
inside. Their minimum is the intersection, and marching cubes (Lorensen and Cline 1987) extracts its zero level. The
hull extends below an object on a table, because no camera sees it from below; the table plane limits it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter, label
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from mitsplat.arguments import check_fields, check_least
from mitsplat.arrays import BoolArray, Float32Array, Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.lens import largest_slope
from mitsplat.progress import Progress
from mitsplat.reconstruct.simplification import large_shells, separate_vertices, simplify_surface
from mitsplat.renderer.layers import make_sensor, render_splats
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.runtime.variant import ensure_variant

_OPAQUE = 0.5
"""Least alpha of a pixel that shows the splats' surface."""
_BOUNDS_QUANTILE = 0.002
"""Share of the Gaussians at either end of an axis that are ignored for the bounds of the grid."""
_MARGIN = 0.08
"""Margin around the bulk of the Gaussians, as a share of its longest extent."""
_MIN_VIEW_SHARE = 0.035
"""Least share of the views towards a cell that must see it; a few views look through gaps between Gaussians."""
_MAX_BEHIND = 2.0
"""Largest depth behind the seen surface, in truncations, at which a view votes for inside.

With 1, depth errors move the surface inwards, because all of the space in front counts. Without a limit, concavities
close that some views do not see.
"""
_DEPTH_DEVIATIONS = 0.5
"""Standard deviations between views by which depth must exceed the hull to cut it; masks are more accurate than depths.
"""
_PASSAGE_RADIUS = 2.5
"""Largest radius of a passage into a solid that is closed [cells]."""
_VOID_CLEARANCE = 1.5
"""Least distance from solid cells in a void [cells].

The concave edges and corners that the closing also fills are thinner.
"""
_MIN_CELL_COVER = 0.5
"""Least share of a cell's cross-section that Gaussians must cover to fill it."""
_SAMPLES_PER_GAUSSIAN = 8
"""Random points per Gaussian that distribute its area over cells."""
_MIN_PART_VOLUME = 1e-3
"""Least volume of a separate part, such as a leaf without its stem, as a share of the largest part's."""
_FAR = 1e6


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings of the surface reconstruction.

    Attributes:
        voxels: Grid cells along the longest extent.
        truncation: Depth behind the surface that one view affects, in cells.
        blur: Standard deviation of the smoothing of the distances, in cells.
        dissent: Number of views that may show an inside point as background, because of errors in masks.
        faces: Largest number of faces of the result.
    """

    voxels: int = 192
    truncation: float = 3.0
    blur: float = 0.5
    dissent: int = 2
    faces: int = 10_000

    def __post_init__(self) -> None:
        check_fields(self)
        check_least(self, faces=100)
        if not 16 <= self.voxels <= 512:
            raise InputError(f"voxels must be from 16 to 512 (got {self.voxels})")
        if not 0 <= self.dissent <= 3:
            raise InputError(f"dissent must be from 0 to 3 (got {self.dissent})")


def reconstruct_surface(
    splats: Splats,
    cameras: Sequence[Camera],
    masks: Sequence[Float32Array] | None = None,
    settings: SurfaceSettings = SurfaceSettings(),
    *,
    floor: float | None = None,
    thin: bool = False,
    depth: bool = True,
    progress: Progress | None = None,
) -> trimesh.Trimesh:
    """Reconstruct the surface of splats in their own frame.

    Args:
        splats: One isolated object, or surroundings.
        cameras: Cameras around it.
        masks: Share of each pixel that the object covers, (H, W) each; None disables the hull, as for surroundings.
        settings: Resolution and size.
        floor: Height z of the table below the object, or None.
        thin: True to keep sheets and stems thinner than a cell, such as leaves, as three cells where Gaussians are
            dense. Depths from both sides cancel there.
        depth: True to carve the hull with the splats' depth; otherwise splats only define the bounds of the grid.
        progress: Called after each view.

    Returns:
        The mesh; watertight if there are masks.

    Raises:
        InputError: If there are no cameras or splats, or no point is inside all masks.
    """
    if not cameras or not len(splats):
        raise InputError(f"a surface needs cameras and splats (got {len(cameras)} and {len(splats)})")
    grid = _Grid.around(splats, settings)
    masked = masks is not None
    state = grid.start(settings.dissent + 1 if masked else 0)
    for number, camera in enumerate(cameras):
        if masks is not None:
            grid.carve(state, camera, masks[number])
        if depth:
            grid.fuse(state, splats, camera)
        if progress is not None:
            progress(number + 1, len(cameras), "finding the surface")
    distance, known = grid.combine(state, settings.blur)
    if thin:
        distance = np.where(grid.thin_cells(splats, distance, state), 0.5 * np.float32(grid.cell), distance)
    if floor is not None:
        distance = np.minimum(distance, grid.layer_heights() - np.float32(floor))
    # An outside border closes the surface at the edge of the grid.
    padded, known = np.pad(distance, 1, constant_values=-grid.truncation), np.pad(known, 1, constant_values=masked)
    try:
        vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="ascent", mask=known)  # type: ignore[no-untyped-call]
    except (ValueError, RuntimeError):
        raise InputError(
            "no surface lies inside the masks of all views: do masks, cameras and splats belong together?"
        ) from None
    surface = trimesh.Trimesh(grid.low + (vertices - 0.5) * grid.cell, faces)
    if not masked:
        return simplify_surface(surface, settings.faces)
    least = _MIN_PART_VOLUME if thin else 1.0
    return separate_vertices(large_shells(simplify_surface(large_shells(surface, least), settings.faces), least))


@dataclass(eq=False)
class _State:
    """Values of all cells.

    Attributes:
        hull: Smallest distances to silhouettes so far [m], ascending; empty without masks.
        total: Sum of the truncated distances behind the seen surface [m].
        squares: Sum of their squares [m^2].
        count: Number of views in these sums.
        towards: Number of views that see a surface in the direction of the cell.
    """

    hull: list[mi.Float]
    total: mi.Float
    squares: mi.Float
    count: mi.Float
    towards: mi.Float


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cubic cells; the array's axes are x, y, z.

    Attributes:
        low: Corner of the grid [m], shape (3,).
        cell: Edge of a cell [m].
        shape: Number of cells along x, y, z.
        truncation: Largest absolute distance [m].
    """

    low: Float64Array
    cell: float
    shape: tuple[int, int, int]
    truncation: float

    @property
    def count(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape))

    @classmethod
    def around(cls, splats: Splats, settings: SurfaceSettings) -> _Grid:
        """Return a grid around the bulk of the splats."""
        low, high = np.quantile(splats.means.astype(np.float64), (_BOUNDS_QUANTILE, 1 - _BOUNDS_QUANTILE), axis=0)
        margin = _MARGIN * float((high - low).max()) + 2 * float(np.median(splats.scales.max(axis=1)))
        low, high = low - margin, high + margin
        cell = float((high - low).max()) / settings.voxels
        shape = np.maximum(np.ceil((high - low) / cell).astype(int), 1)
        return cls(low, cell, (int(shape[0]), int(shape[1]), int(shape[2])), settings.truncation * cell)

    def layer_heights(self) -> Float32Array:
        """Return the heights z of the cell centres by layer, shape (cells along z,)."""
        return np.asarray(self.low[2] + self.cell * (np.arange(self.shape[2]) + 0.5), dtype=np.float32)

    def start(self, silhouettes: int) -> _State:
        """Return the initial state, which keeps the smallest ``silhouettes`` distances to silhouettes of a cell."""
        ensure_variant()
        nothing = dr.zeros(mi.Float, self.count)
        return _State([dr.full(mi.Float, _FAR, self.count) for _ in range(silhouettes)], *[nothing] * 4)

    def carve(self, state: _State, camera: Camera, mask: Float32Array) -> None:
        """Add the silhouette distances of one mask."""
        pixel, z, ahead = self._seen_from(camera)
        silhouette = _bilinear(_signed_distance(mask), camera, pixel, ahead)[0]
        away = dr.select(ahead, silhouette * z / view_of(make_sensor(camera))._opaque["fx"], _FAR)
        for k, held in enumerate(state.hull):
            state.hull[k], away = dr.minimum(held, away), dr.maximum(held, away)
        dr.eval(state.hull)

    def fuse(self, state: _State, splats: Splats, camera: Camera) -> None:
        """Add the depth of the splats in one view."""
        layers = render_splats(splats, camera, quality="fast")
        depth = np.where(layers.alpha > _OPAQUE, layers.depth, 0.0).astype(np.float32)
        pixel, z, ahead = self._seen_from(camera)
        span = dr.opaque(mi.Float, self.truncation)
        seen, low, high = _bilinear(depth, camera, pixel, ahead)
        # Depth is not interpolated across a depth edge.
        behind = z - seen
        valid = ahead & (low > 0) & (high - low < span) & (behind < _MAX_BEHIND * span)
        behind = dr.select(valid, dr.clip(behind, -span, span), 0)
        state.total = state.total + behind
        state.squares = state.squares + dr.square(behind)
        state.count = state.count + dr.select(valid, 1, 0)
        state.towards = state.towards + dr.select(ahead & (low > 0), 1, 0)
        dr.eval(state.total, state.squares, state.count, state.towards)

    def _seen_from(self, camera: Camera) -> tuple[mi.Point2f, mi.Float, mi.Bool]:
        """Return image positions of all cell centres [px], their depths [m], and True for those inside the picture."""
        view = view_of(make_sensor(camera))
        x, y, z = self._in_camera(camera)
        ahead = z > view.near_plane
        u, v = x / z, y / z
        if camera.distortion:
            # Beyond this slope, the distortion would fold cells into the picture.
            steepest = dr.opaque(mi.Float, largest_slope(camera.distortion, camera.lens))
            ahead &= dr.hypot(u, v) < steepest
            u, v, _ = view.distort(u, v)
        own = view._opaque
        pixel = mi.Point2f(u * own["fx"] + own["cx"], v * own["fy"] + own["cy"])
        width, height = dr.opaque(mi.Float, camera.width), dr.opaque(mi.Float, camera.height)
        return pixel, z, ahead & (pixel.x >= 0) & (pixel.y >= 0) & (pixel.x < width) & (pixel.y < height)

    def combine(self, state: _State, blur: float) -> tuple[Float32Array, BoolArray]:
        """Return the distance of every cell to the surface [m], positive inside, and True for known cells.

        Both have the shape ``shape``.
        """
        count = np.array(state.count)
        mean, squares = (np.array(sums) / np.maximum(count, 1) for sums in (state.total, state.squares))
        # Unseen cells inside the hull count as inside the object.
        known = count > (_MIN_VIEW_SHARE * np.array(state.towards) if state.hull else 0)
        distance = np.where(known, mean, self.truncation)
        if state.hull:
            distance = distance + _DEPTH_DEVIATIONS * np.sqrt(np.maximum(squares - mean * mean, 0))
            distance = np.minimum(distance, np.clip(np.array(state.hull[-1]), -self.truncation, self.truncation))
            known = np.ones_like(known)
            distance = _close_voids(distance.reshape(self.shape), self.truncation)
        # Marching cubes uses all eight corners, and the blur uses neighbours.
        known = binary_erosion(known.reshape(self.shape), np.ones((3, 3, 3)), border_value=1)
        shaped = distance.reshape(self.shape).astype(np.float32)
        smooth = gaussian_filter(shaped, blur, mode="nearest") if blur > 0 else shaped
        return smooth, known

    def thin_cells(self, splats: Splats, distance: Float32Array, state: _State) -> BoolArray:
        """Return True for cells that Gaussians fill inside all silhouettes but outside any surface.

        Neighbours of these cells are included. A Gaussian of opacity a and standard deviations s, t blocks light on an
        area of 2 pi a s t. Random points distribute this area over cells.
        """
        ordered = np.sort(splats.scales.astype(np.float64), axis=1)
        area = 2 * np.pi * splats.opacities * ordered[:, 1] * ordered[:, 2] / self.cell**2
        offsets = np.random.default_rng(0).normal(size=(_SAMPLES_PER_GAUSSIAN, len(splats), 3)) * splats.scales
        frames = Rotation.from_quat(splats.quats).as_matrix()
        points = (splats.means + np.einsum("nij,snj->sni", frames, offsets)).reshape(-1, 3)
        place = (points - self.low) / self.cell
        inside = ((place >= 0) & (place < self.shape)).all(axis=1)
        index = np.ravel_multi_index(tuple(place[inside].astype(np.int64).T), self.shape)
        cover = np.bincount(
            index, np.tile(area / _SAMPLES_PER_GAUSSIAN, _SAMPLES_PER_GAUSSIAN)[inside], self.count
        ).reshape(self.shape)
        enclosed = binary_dilation(distance > 0, np.ones((3, 3, 3)), iterations=2)
        thin_cells = (cover >= _MIN_CELL_COVER) & ~enclosed
        if state.hull:
            thin_cells &= np.array(state.hull[-1]).reshape(self.shape) > -self.cell
        return np.asarray(binary_dilation(thin_cells))

    def _in_camera(self, camera: Camera) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return the camera coordinates of all cell centres [m]."""
        index = dr.arange(mi.UInt32, self.count)
        nz, nyz = self.shape[2], self.shape[1] * self.shape[2]
        i, rest = index // nyz, index % nyz
        j, k = rest // nz, rest % nz
        pose = camera.camera_from_world
        step = pose[:3, :3] * self.cell
        corner = pose[:3, :3] @ (self.low + 0.5 * self.cell) + pose[:3, 3]
        cells = mi.Float(i), mi.Float(j), mi.Float(k)
        found = []
        for row in range(3):
            value = dr.opaque(mi.Float, float(corner[row]))
            for column in range(3):
                value = dr.fma(dr.opaque(mi.Float, float(step[row, column])), cells[column], value)
            found.append(value)
        return found[0], found[1], found[2]


def _close_voids(distance: Float32Array, inside: float) -> Float32Array:
    """Set distances to ``inside`` in voids that only narrow passages connect with the outside.

    Views that look between Gaussians carve such passages and voids. A void is a part cut off by a closing (Serra 1982)
    of the solid, which no ball of that radius reaches from the outside. Edges of concavities are also out of reach, but
    they are thinner than voids and stay.
    """
    empty = np.pad(distance <= 0, 1 + math.ceil(_PASSAGE_RADIUS), constant_values=True)
    if empty.all():
        return distance
    room = distance_transform_edt(empty)
    wide = label(room > _PASSAGE_RADIUS)[0]
    hidden = empty & (distance_transform_edt(wide != wide[0, 0, 0]) > _PASSAGE_RADIUS)
    void = hidden & (room > _VOID_CLEARANCE)
    if not void.any():
        return distance
    void = hidden & (distance_transform_edt(~void) <= 1 + _VOID_CLEARANCE)
    border = (slice(1 + math.ceil(_PASSAGE_RADIUS), -1 - math.ceil(_PASSAGE_RADIUS)),) * 3
    return np.where(void[border], np.float32(inside), distance)


def _signed_distance(mask: Float32Array) -> Float32Array:
    """Return the distance of every pixel centre to the outline [px], positive inside the mask."""
    inside = (mask >= 0.5).astype(np.uint8)
    if not inside.any():
        return np.full(mask.shape, -_FAR, dtype=np.float32)
    if inside.all():
        return np.full(mask.shape, _FAR, dtype=np.float32)
    within, without = (cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for part in (inside, 1 - inside))
    # The transform measures to pixel centres on the other side, which lie half a pixel beyond the outline.
    return np.where(inside > 0, within - 0.5, 0.5 - without).astype(np.float32)


def _bilinear(
    image: Float32Array, camera: Camera, pixel: mi.Point2f, active: mi.Bool
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return the interpolated values at pixel positions, and the minimum and maximum of the four source pixels."""
    flat = mi.Float(np.ravel(image))
    width = dr.opaque(mi.UInt32, camera.width)
    last_x, last_y = dr.opaque(mi.Float, camera.width - 1), dr.opaque(mi.Float, camera.height - 1)
    x = dr.clip(pixel.x - 0.5, 0, last_x)
    y = dr.clip(pixel.y - 0.5, 0, last_y)
    x0, y0 = dr.floor(x), dr.floor(y)
    x1, y1 = dr.minimum(x0 + 1, last_x), dr.minimum(y0 + 1, last_y)

    def at(column: mi.Float, row: mi.Float) -> mi.Float:
        return dr.gather(mi.Float, flat, mi.UInt32(row) * width + mi.UInt32(column), active)

    a, b, c, d = at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1)
    value = dr.lerp(dr.lerp(a, b, x - x0), dr.lerp(c, d, x - x0), y - y0)
    return value, dr.minimum(dr.minimum(a, b), dr.minimum(c, d)), dr.maximum(dr.maximum(a, b), dr.maximum(c, d))
