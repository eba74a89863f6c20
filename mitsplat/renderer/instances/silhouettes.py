"""Complete (amodal) silhouettes of instances, without occluders, on a canvas larger than the image.

A pixel belongs to the silhouette of an instance if the instance alone transmits less than half of the light behind it.
This is the rule of the instance image (:class:`mitsplat.renderer.splatting.march.Image`), where remaining transmittance
counts as environment. Opacity does not depend on the order of Gaussians, so tile lists are sorted by instance instead
of by depth. One packet of lanes walks the entries of one instance in a tile, and stops when all its pixels are decided.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import Float64Array, Int64Array, UInt32Array
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.lens import FISHEYE_MAX, Lens, lens_fault
from mitsplat.images.masks import Silhouette
from mitsplat.quality import Quality
from mitsplat.renderer.projection.clouds import CloudSet, Placement
from mitsplat.renderer.projection.records import GaussianRecord
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH, CameraView
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, wrapped
from mitsplat.renderer.splatting.pairs import CrowdedError
from mitsplat.renderer.splatting.response import exp2, min_log_opacity, respond_along
from mitsplat.renderer.splatting.tile_depths import DEPTH_BITS
from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians
from mitsplat.renderer.splatting.walk import max_of

MARGINS = (1.0, 0.5, 0.25, 0.125, 0.0)
"""Candidate margins of the canvas around the image, in image sizes. BOP uses one image on each side. Where lens
distortion cannot be inverted that far out, the largest margin with an inverse is used.
"""

_ROWS_OF_COLUMN = (np.arange(1 << TILE_HEIGHT)[:, None] >> np.arange(TILE_HEIGHT) & 1).astype(bool)
"""Pixels of a tile column, from the top, that the bits of a number cover."""

PlacedMesh = tuple[trimesh.Trimesh, Float64Array]
"""Mesh, and its pose ``world_from_mesh``, shape (4, 4)."""

_MAX_SLOPE = math.tan(FISHEYE_MAX)
_SAMPLES_BEYOND = 512
"""Range of slopes in which silhouettes beyond the canvas are sampled, and number of samples along each axis."""


def splat_silhouettes(
    clouds: CloudSet, placements: Sequence[Placement], view: CameraView, quality: Quality
) -> dict[int, Silhouette]:
    """Return the silhouettes of instances above 0 from their splats; instances without pixels are omitted."""
    objects = [placement for placement in placements if placement.instance > 0]
    if not objects:
        return {}
    canvas, left, top = _canvas(view)
    ids = np.unique([placement.instance for placement in objects])
    quality = replace(quality, tolerance=math.inf, sh_degree=0)
    covered = _cover(clouds, objects, canvas.sampled(quality.rays_per_axis), quality, ids)
    return _assemble(*covered, ids, canvas, left, top)


def _cover(
    clouds: CloudSet, objects: Sequence[Placement], canvas: CameraView, quality: Quality, ids: Int64Array
) -> tuple[UInt32Array, UInt32Array, UInt32Array]:
    """Return tile, instance (as position in ``ids``) and covered pixels of every run, see :func:`_covered`.

    A canvas with too many pairs for the memory is processed in parts.
    """
    slots = np.zeros(int(ids[-1]) + 1, dtype=np.uint32)
    slots[ids] = np.arange(len(ids), dtype=np.uint32)
    if len(ids) > 1 << DEPTH_BITS:
        raise CrowdedError
    try:
        lists = bin_gaussians(clouds, objects, canvas, quality, fitted=True, groups=wrapped(mi.UInt32, slots))
    except CrowdedError:
        if canvas.tiles_y == 1:
            raise
        middle = canvas.tiles_y // 2
        upper, lower = canvas.rows(0, middle * TILE_HEIGHT), canvas.rows(middle * TILE_HEIGHT, canvas.height)
        (above, *rest), (below, *more) = (_cover(clouds, objects, part, quality, ids) for part in (upper, lower))
        tile = np.concatenate([above, below + middle * canvas.tiles_x])
        slot, bits = (np.concatenate(parts) for parts in zip(rest, more, strict=True))
        return tile, slot, bits
    if lists.pairs == 0:
        return (np.zeros(0, dtype=np.uint32),) * 3
    runs = _runs(lists)
    tile = dr.gather(mi.UInt32, lists.tiles, runs.place)
    return np.array(tile), np.array(runs.slot), np.array(_covered(lists, canvas, quality, runs))


def proxy_silhouettes(proxies: Mapping[int, Sequence[PlacedMesh]], view: CameraView) -> dict[int, Silhouette]:
    """Return the silhouettes of instances from proxy meshes.

    ``proxies`` holds (mesh, world_from_mesh) of every part of an instance, by instance id.
    """
    canvas, left, top = _canvas(view)
    found = {}
    for instance, parts in proxies.items():
        window = _window(canvas, parts)
        if window is None:
            continue
        x0, y0, x1, y1 = window
        shape = y1 - y0, x1 - x0
        hit = np.zeros(shape, dtype=bool)
        for mesh, world_from_mesh in parts:
            hit |= np.array(_trace_alone(canvas, window, mesh, world_from_mesh)).reshape(shape)
        if hit.any():
            found[instance] = Silhouette.cropped(hit, x0 - left, y0 - top)
    return found


def with_area_beyond(
    found: Mapping[int, Silhouette], proxies: Mapping[int, Sequence[PlacedMesh]], view: CameraView
) -> dict[int, Silhouette]:
    """Return silhouettes with the area of their proxies beyond the canvas, where they reach it and the image."""
    canvas, left, top = _canvas(view)
    result = dict(found)
    for instance, silhouette in found.items():
        x0, y0, x1, y1 = silhouette.box
        reaches = x0 == -left or y0 == -top or x1 == canvas.width - left or y1 == canvas.height - top
        if reaches and instance in proxies and silhouette.clipped(view.width, view.height) is not None:
            result[instance] = replace(silhouette, beyond=_area_beyond(canvas, proxies[instance]))
    return result


def _area_beyond(canvas: CameraView, parts: Sequence[PlacedMesh]) -> float:
    """Return the area that meshes cover outside of a canvas [px], up to 85 degrees beside the optical axis.

    The area is sampled in the plane of slopes, in which pixels have their size at the centre of the lens.
    """
    camera_from_world = canvas.camera.camera_from_world
    points = np.concatenate([trimesh.transform_points(mesh.vertices, camera_from_world @ pose) for mesh, pose in parts])
    low, high = np.full(2, -_MAX_SLOPE), np.full(2, _MAX_SLOPE)
    if (points[:, 2] > canvas.near).all():
        slopes = points[:, :2] / points[:, 2:]
        low, high = np.maximum(slopes.min(axis=0), low), np.minimum(slopes.max(axis=0), high)
    step = (high - low) / _SAMPLES_BEYOND
    if not (step > 0).all():
        return 0.0
    count = _SAMPLES_BEYOND
    (fx, fy), (cx, cy) = 1 / step, -low / step
    wide = CameraView(count, count, float(fx), float(fy), float(cx), float(cy), canvas.world_from_camera)
    window, hit = (0, 0, count, count), np.zeros(count**2, dtype=bool)
    for mesh, pose in parts:
        hit |= np.array(_trace_alone(wide, window, mesh, pose))
    row, column = np.divmod(np.flatnonzero(hit), count)
    rays = np.column_stack([low + (np.column_stack([column, row]) + 0.5) * step, np.ones(len(row))])
    pixels, _ = replace(canvas.camera, world_from_camera=np.eye(4)).project(rays)
    inside = ((pixels >= 0) & (pixels < (canvas.width, canvas.height))).all(axis=1)
    return float(np.count_nonzero(~inside) * step.prod() * canvas.fx * canvas.fy)


def _canvas(view: CameraView) -> tuple[CameraView, int, int]:
    """Return the view on a larger canvas, and the position of the image on it (left, top)."""
    share = canvas_margin(view)
    left, top = int(share * view.width), int(share * view.height)
    width, height = view.width + 2 * left, view.height + 2 * top
    return replace(view, width=width, height=height, cx=view.cx + left, cy=view.cy + top), left, top


def canvas_margin(view: CameraView | Camera) -> float:
    """Return the margin of the canvas of silhouettes on each side of the image, in image sizes."""
    return _margin(view.width, view.height, view.fx, view.fy, view.cx, view.cy, view.distortion, view.lens)


@lru_cache(maxsize=8)
def _margin(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: tuple[float, ...], lens: Lens
) -> float:
    if not distortion:
        return MARGINS[0]
    for share in MARGINS[:-1]:
        left, top = int(share * width), int(share * height)
        size, centre = (width + 2 * left, height + 2 * top), (cx + left, cy + top)
        if not lens_fault(size, (fx, fy), centre, distortion, lens):
            return share
    return MARGINS[-1]


@dataclass(frozen=True, eq=False)
class _Runs:
    """Runs of entries of one instance in one tile.

    Attributes:
        place: Index of the tile among those with lists.
        slot: Index of the instance in the ids.
        start, stop: Range of the entries.
    """

    place: mi.UInt32
    slot: mi.UInt32
    start: mi.UInt32
    stop: mi.UInt32


def _runs(lists: TileLists) -> _Runs:
    """Return the runs of non-empty lists that are sorted by instance."""
    entry, tile = dr.arange(mi.UInt32, lists.pairs), dr.arange(mi.UInt32, dr.width(lists.start))
    slot, filled = lists.levels, lists.stop > lists.start
    first = dr.zeros(mi.UInt32, lists.pairs)
    dr.scatter(first, mi.UInt32(1), lists.start, filled, mode=dr.ReduceMode.Permute)
    dr.eval(slot, first)
    begins = (first > 0) | (slot != dr.gather(mi.UInt32, slot, entry - 1, entry > 0))
    before, start = dr.prefix_sum(dr.select(begins, mi.UInt32(1), 0)), dr.compress(begins)
    run, runs, end = dr.arange(mi.UInt32, dr.width(start)), dr.width(start), dr.opaque(mi.UInt32, lists.pairs)
    count, last = dr.opaque(mi.UInt32, runs), run + 1
    stop = dr.select(last < count, dr.gather(mi.UInt32, start, last, last < count), end)
    inside, place = lists.stop < end, dr.empty(mi.UInt32, runs)
    own = dr.gather(mi.UInt32, before, lists.start, filled)
    after = dr.select(inside, dr.gather(mi.UInt32, before, lists.stop, inside), count)

    def name(k: mi.UInt32) -> tuple[mi.UInt32]:
        dr.scatter(place, tile, k, mode=dr.ReduceMode.Permute)
        return (k + 1,)

    dr.while_loop((mi.UInt32(own),), lambda k: filled & (k < after), name, label="tiles of runs")
    slot = dr.gather(mi.UInt32, slot, start)
    dr.eval(place, slot, start, stop)
    return _Runs(place, slot, start, stop)


def _covered(lists: TileLists, view: CameraView, quality: Quality, runs: _Runs) -> mi.UInt32:
    """Return the covered pixels of every run, for each column of its tile, as bits from the top."""
    lane = dr.arange(mi.UInt32, dr.width(runs.place) * TILE_WIDTH)
    run, column = lane // TILE_WIDTH, lane % TILE_WIDTH
    tile = dr.gather(mi.UInt32, lists.tiles, dr.gather(mi.UInt32, runs.place, run))
    row = tile // view.tiles_x
    x = mi.Float((tile - row * view.tiles_x) * TILE_WIDTH + column)
    y = mi.Float(row * TILE_HEIGHT)
    centre = dr.opaque(mi.Float, 0.5)  # as in the instance image, whatever the number of samples
    slopes = [view.slopes(x + centre, y + k + centre) for k in range(TILE_HEIGHT)]
    us, vs = [u for u, _ in slopes], [v for _, v in slopes]
    start, stop = dr.gather(mi.UInt32, runs.start, run), dr.gather(mi.UInt32, runs.stop, run)
    cut, near, shared_column = min_log_opacity(quality), view.near_plane, not view.distortion

    def body(i: mi.UInt32, through: list[mi.Float]) -> tuple[mi.UInt32, list[mi.Float]]:
        record = GaussianRecord.fetch(lists.records, dr.gather(mi.UInt32, lists.entries, i))
        responses = respond_along(record, lists.plane_records, us, vs, shared_column, cap=None)
        return i + 1, [
            dr.select((log_alpha > cut) & (z > near), t * (1 - exp2(log_alpha)), t)
            for t, (log_alpha, z) in zip(through, responses, strict=True)
        ]

    def undecided(i: mi.UInt32, through: list[mi.Float]) -> mi.Bool:
        return (i < stop) & (max_of(through) >= 0.5)

    ones = [mi.Float(1.0) for _ in range(TILE_HEIGHT)]
    _, through = dr.while_loop((mi.UInt32(start), ones), undecided, body, label="silhouettes")
    bits = mi.UInt32(0)
    for k, t in enumerate(through):
        bits |= dr.select(t < 0.5, mi.UInt32(1 << k), 0)
    dr.eval(bits)
    return bits


def _assemble(
    tile: UInt32Array, slot: UInt32Array, bits: UInt32Array, ids: Int64Array, canvas: CameraView, left: int, top: int
) -> dict[int, Silhouette]:
    """Assemble the masks of instances from those of their tiles."""
    columns = bits.astype(np.uint8).reshape(len(tile), TILE_WIDTH)
    filled = np.flatnonzero(columns.any(axis=1))
    filled = filled[np.argsort(slot[filled], kind="stable")]
    tile, columns = tile[filled], columns[filled]
    blocks = _ROWS_OF_COLUMN[columns].swapaxes(1, 2)  # pair, row, column
    rows, cols = tile // canvas.tiles_x, tile % canvas.tiles_x
    found = {}
    ends = np.searchsorted(slot[filled], np.arange(len(ids) + 1))
    for instance, start, stop in zip(ids.tolist(), ends[:-1], ends[1:], strict=True):
        if start == stop:
            continue
        y, x = rows[start:stop], cols[start:stop]
        y0, x0 = int(y.min()), int(x.min())
        grid = np.zeros((int(y.max()) - y0 + 1, TILE_HEIGHT, int(x.max()) - x0 + 1, TILE_WIDTH), dtype=bool)
        grid[y - y0, :, x - x0] = blocks[start:stop]
        mask = grid.reshape(grid.shape[0] * TILE_HEIGHT, grid.shape[2] * TILE_WIDTH)
        mask = mask[: canvas.height - y0 * TILE_HEIGHT, : canvas.width - x0 * TILE_WIDTH]
        if mask.any():
            found[instance] = Silhouette.cropped(mask, x0 * TILE_WIDTH - left, y0 * TILE_HEIGHT - top)
    return found


def _window(view: CameraView, parts: Sequence[PlacedMesh]) -> tuple[int, int, int, int] | None:
    """Return the box of canvas pixels that meshes may cover, or None."""
    camera = view.camera
    points = np.concatenate([trimesh.transform_points(mesh.vertices, pose) for mesh, pose in parts])
    pixels, depth = camera.project(points)
    if (depth <= view.near).any() or np.isnan(pixels).any():  # NaN: beyond the turn of the lens distortion
        return (0, 0, view.width, view.height) if (depth > view.near).any() else None
    low = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, (view.width, view.height)).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, (view.width, view.height)).astype(int)
    return (int(low[0]), int(low[1]), int(high[0]), int(high[1])) if (high > low).all() else None


def _trace_alone(
    view: CameraView, window: tuple[int, int, int, int], mesh: trimesh.Trimesh, pose: Float64Array
) -> mi.Bool:
    """Return True for the pixels of a window whose rays hit a mesh."""
    x0, y0, x1, y1 = window
    lane = dr.arange(mi.UInt32, (x1 - x0) * (y1 - y0))
    width = dr.opaque(mi.UInt32, x1 - x0)
    row = lane // width
    u, v = view.slopes(
        mi.Float(lane - row * width) + dr.opaque(mi.Float, x0 + 0.5), mi.Float(row) + dr.opaque(mi.Float, y0 + 0.5)
    )
    mesh_from_camera = np.linalg.inv(pose) @ view.world_from_camera
    axes = [[dr.opaque(mi.Float, float(value)) for value in column] for column in mesh_from_camera[:3].T]
    right, down, forward, centre = axes
    direction = mi.Vector3f(*[right[i] * u + down[i] * v + forward[i] for i in range(3)])
    ray = dr.zeros(mi.Ray3f, dr.width(lane))
    ray.o = mi.Point3f(*centre)
    ray.d = dr.normalize(direction)
    ray.maxt = dr.inf
    return _scene_of(mesh, str(mi.variant())).ray_test(ray)


@lru_cache(maxsize=128)
def _scene_of(mesh: trimesh.Trimesh, _variant: str) -> mi.Scene:
    return ray_scene({"mesh": plain_mesh(mesh)})
