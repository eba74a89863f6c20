"""Preflight checks: reasons why a run would produce no labels or exceed this machine.

Each function yields the faults that it finds, as :class:`mitsplat.findings.Finding`. ``mitsplat check`` prints all of
them; other commands refuse the scene for the first one (:func:`refuse`). Only certain failures are faults, and
:mod:`mitsplat.checks.scene_warnings` finds probable mistakes. All bounds are generous, because a scene that is refused
by mistake cannot be rendered at all.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import trimesh

from mitsplat.arrays import Float64Array, evenly_spaced
from mitsplat.dataset.dataset_files import MANIFEST
from mitsplat.engine.resources import unused_memory
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.findings import Finding
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh import check_size
from mitsplat.geometry.mesh_points import points_inside
from mitsplat.scene.planning.frame_plan import FramePlan, plan_frame
from mitsplat.scene.planning.view_diagnosis import FAR, distance_to_box, pose_cause, sees
from mitsplat.scene.planning.visibility_prediction import enclosing_shape
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.scene.spec.shape_spec import Region
from mitsplat.scene.walls import ENCLOSURE, PILE_HEIGHT, enclosed_bounds, walls_beside

MAX_FRAMES = 2**31 - 1
MAX_TIME = 2000.0
"""Maximum simulated time of a layout [s]; 0.5 to 2 s of 30 objects take one second."""
VIEWS = 48
"""Maximum number of views that are tested, spread evenly over the run."""
MIN_VIEW_WIDTH = 0.01
"""Minimum width of the field of view at the largest depth, as a fraction of the extent of the smallest object."""
MIN_PIXEL_BYTES, MIN_PROCESS_GIB = 500, 0.5
"""Minimum peak memory per pixel of a frame [bytes], and of a process in addition [GiB].

Measured with the workcell scene: 1.0 GiB at 640x360, 2.6 GiB at 2000x2000, 8.4 GiB at 4000x4000, and 0.7 GiB for a
process that settles layouts. Other scenes need more, up to :func:`mitsplat.frames.budget.worker_memory`.
"""
MIN_FRAME_BYTES = 8192
"""Minimum disk space of a frame [bytes]: one block for the image, one for the label."""
_MAX_CELLS = 24  # per axis of a region, in the search for free volume


def fault(name: str, text: str, remedy: str) -> Finding:
    """Return a finding that is a problem."""
    return Finding(name, False, text, remedy)


def refuse(scene: Scene, faults: Iterable[Finding]) -> None:
    """Raise an error for the first fault of a scene, if there is one.

    Raises:
        InputError: If there is a fault.
        MissingResourceError: If the first fault is a lack of memory or disk space.
    """
    for found in faults:
        kind = MissingResourceError if found.name in ("memory", "disk") else InputError
        raise kind(f"{scene.path}: {found.text}; {found.remedy}")


def run_faults(
    scene: Scene,
    frames: Sequence[int] | None = None,
    *,
    out: Path | None = None,
    workers: int | None = None,
    elsewhere: bool = False,
) -> Iterator[Finding]:
    """Find all faults that prevent the rendering of a dataset.

    Args:
        scene: Scene to render.
        frames: Indices of the frames to render; all frames if None.
        out: Output folder; the current folder if None.
        workers: Number of processes that render frames.
        elsewhere: True if frames are rendered on other machines, whose memory is not checked.
    """
    frames = range(min(scene.num_frames, MAX_FRAMES)) if frames is None else frames
    yield from count_faults(scene)
    yield from layout_faults(scene)
    if not elsewhere:
        yield from image_faults(scene, workers, len(frames))
    yield from label_faults(scene, frames)
    yield from disk_faults(len(frames), out)


def count_faults(scene: Scene) -> Iterator[Finding]:
    """Check that the number of images does not exceed the range of their indices."""
    if scene.num_frames > MAX_FRAMES:
        text = f"output: layouts x views must be at most {MAX_FRAMES} images (got {scene.num_frames})"
        yield fault("frames", text, "lower output.layouts or output.views")


def layout_faults(scene: Scene) -> Iterator[Finding]:
    """Find reasons why no layout can come to rest."""
    settle = scene.spec.settle
    if settle.max_time > MAX_TIME:
        text = f"settle: max_time must be at most {MAX_TIME:g} s (got {settle.max_time:g} s)"
        yield fault("time", text, "lower settle.max_time")
    dropped = [i for i, entry in enumerate(scene.spec.objects) if not entry.poses]
    if not dropped:
        return
    for number, (shape, mesh) in enumerate(zip(scene.spec.shapes, scene.shape_meshes, strict=True)):
        if shape.collider:
            try:
                check_size(mesh, f"shapes[{number}]")
            except InputError as error:
                wrong = "the mesh" if shape.mesh else "its size, in metres"
                yield fault("shape", str(error), f"correct {wrong}, or set collider: false")
                return
    for number, pool in enumerate(scene.pools):
        for asset in (scene.assets[position] for position in pool):
            try:
                if asset.mesh is not None:
                    check_size(asset.mesh, f"objects[{number}]: {asset.name}")
            except InputError as error:
                remedy = f"correct objects[{number}].scale or size, or units in its asset.yaml"
                yield fault("size", str(error), remedy)
                return
    for number, (region, arrangements) in enumerate(scene.spec.all_regions):
        where = f"regions[{number - 1}]" if number else "region"
        here = [i for i in dropped if scene.spec.regions_of(scene.spec.objects[i]) == (number,)]
        if here or not scene.spec.regions:
            yield from _region_faults(scene, where, here, region, arrangements)


def _region_faults(
    scene: Scene, where: str, dropped: Sequence[int], region: Region, arrangements: Sequence[Arrangement]
) -> Iterator[Finding]:
    """Find reasons why the entries ``dropped``, which use only this region, cannot come to rest in it."""
    low, high = np.array(region.min), np.array(region.max)
    supports = [mesh.bounds for name, mesh in _colliders(scene) if not name.startswith(ENCLOSURE)]
    if supports and not any(
        (box[0, :2] < high[:2]).all() and (box[1, :2] > low[:2]).all() and box[0, 2] < high[2] for box in supports
    ):
        text = f"{where}: no collider is below it, so all objects fall forever"
        yield fault("support", text, "move region above the table, or the table below it")
        return
    if "pile" in arrangements:
        high[2] += PILE_HEIGHT
    yield from _room_faults(scene, where, dropped, low, high)


def _room_faults(
    scene: Scene, where: str, dropped: Sequence[int], low: Float64Array, high: Float64Array
) -> Iterator[Finding]:
    """Check that a region has enough volume outside of colliders for the objects dropped into it."""
    pools = [[mesh for asset in scene.pools[i] if (mesh := scene.assets[asset].mesh) is not None] for i in dropped]
    meshes = [mesh for pool in pools for mesh in pool]
    finest = min(float(mesh.extents.min()) for mesh in meshes) / 2
    cells = np.clip(np.ceil((high - low) / finest), 5, _MAX_CELLS).astype(int)
    axes = [start + (end - start) * (np.arange(n) + 0.5) / n for start, end, n in zip(low, high, cells, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    taken = np.zeros(len(points), dtype=bool)
    in_way = []
    for name, mesh in _colliders(scene):
        inside = points_inside(mesh, points)
        if inside.any():
            in_way.append(repr(name))
        taken |= inside
    if taken.all():
        text = f"{where}: lies inside of colliders, {' and '.join(in_way)}"
        yield fault("region", text, "move region above it")
        return
    volume = float(np.prod(high - low)) * float((~taken).mean())
    hulls = {id(mesh): float(mesh.convex_hull.volume) for mesh in meshes}
    numbers = [scene.spec.objects[i].count[1] for i in dropped]
    need = float(np.dot(numbers, [min(hulls[id(mesh)] for mesh in pool) for pool in pools]))
    if need > volume:
        objects = f"{sum(numbers)} objects of {1e3 * need:.3g} l"
        text = f"{where}: at most {objects} start in it at once (its free volume is {1e3 * volume:.3g} l)"
        yield fault("room", text, "lower objects[].count or make region larger")


def image_faults(scene: Scene, workers: int | None = None, frames: int = MAX_FRAMES) -> Iterator[Finding]:
    """Check that this machine has enough memory for one image, and for one image per worker.

    Args:
        scene: Scene to render.
        workers: Number of processes that render frames.
        frames: Number of frames, which is the maximum number of processes that are started.
    """
    output, free = scene.spec.output, unused_memory()
    need = MIN_PROCESS_GIB + output.width * output.height * MIN_PIXEL_BYTES / 2**30
    size = f"an image of {output.width}x{output.height} px"
    if need > free:
        text = f"output: {size} takes at least {need:.1f} GiB of memory ({free:.1f} GiB are unused)"
        yield fault("memory", text, "lower output.width and height")
    elif workers is not None:
        remedy = "without a number, cores and memory determine it"
        yield from worker_faults(workers, frames, need, f" for {size}", remedy)


def worker_faults(
    workers: int, jobs: int, need: float = MIN_PROCESS_GIB, work: str = "", remedy: str = "use fewer workers"
) -> Iterator[Finding]:
    """Check that this machine has enough memory for the processes of some jobs, of which each needs ``need`` GiB."""
    free = unused_memory()
    fitting = max(1, int(free / need))
    if min(workers, jobs) > fitting:
        text = f"workers must be at most {fitting}, because each takes at least {need:.1f} GiB of memory{work}"
        yield fault("memory", f"{text} ({free:.1f} GiB are unused; got {workers})", remedy)


def disk_faults(frames: int, out: Path | None) -> Iterator[Finding]:
    """Check that the disk has space for the images that are not there yet."""
    folder = (out or Path.cwd()).absolute()
    while not folder.is_dir():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if frames * MIN_FRAME_BYTES > free and out is not None and (out / MANIFEST).is_file():
        with (out / MANIFEST).open("rb") as lines:
            frames -= sum(1 for _ in lines)
    need = frames * MIN_FRAME_BYTES
    if need > free:
        sizes = f"{_format_bytes(need)} ({_format_bytes(free)} are free at {folder})"
        text = f"output: {frames} images take at least {sizes}"
        yield fault("disk", text, "lower output.layouts or views, give --frames, or write to another disk")


def _format_bytes(size: int) -> str:
    """Format a number of bytes as MiB or GiB."""
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 else f"{size / 2**20:.3g} MiB"


def label_faults(scene: Scene, frames: Sequence[int]) -> Iterator[Finding]:
    """Find reasons why no image can have a label.

    Either no camera sees the region that objects can reach, or objects appear smaller than ``labels.min_pixels``.
    """
    spec, least = scene.spec, scene.spec.labels.min_pixels
    labelled = [scene.assets[i] for i in range(len(scene.assets)) if scene.class_index(i) is not None]
    meshes = [asset.mesh for asset in labelled if asset.mesh is not None]
    if not meshes or not len(frames):
        return
    pixels = spec.output.width * spec.output.height
    if pixels < least:
        text = f"output: an image of {pixels} px cannot show labels.min_pixels = {least}"
        yield fault("labels", text, "make output.width and height larger")
        return
    cameras = [plan.camera for plan in sampled_plans(scene, frames)]
    hidden = [name for camera in cameras if (name := enclosing_shape(scene, camera.centre))]
    if len(hidden) == len(cameras):
        text = f"camera: every view is from inside of shape {hidden[0]!r}, which hides all objects"
        yield fault("visibility", text, "move camera out of it")
        return
    low, high = reachable_box(scene)
    nearest = min(cameras, key=lambda camera: distance_to_box(camera.centre, low, high))
    away = distance_to_box(nearest.centre, low, high)
    if not any(sees(camera, low, high) for camera in cameras):
        text = (
            f"camera: no view shows any place that objects can reach ({len(cameras)} views tested; the nearest such "
            f"place is {away:.3g} m from the camera)"
        )
        remedy = pose_cause(nearest, low, high) or "turn camera to region: `mitsplat preview` shows where it looks"
        yield fault("visibility", text, remedy)
        return
    depths = [_depth_range(camera, low, high) for camera in cameras]
    across = [far * c.width / c.fx for c, (_, far) in zip(cameras, depths, strict=True)]
    smallest = min(float(mesh.extents.max()) for mesh in meshes)
    if max(across) < MIN_VIEW_WIDTH * smallest:
        view = f"{max(across):.2g} m (the smallest object is {smallest:.2g} m long)"
        text = f"camera.intrinsics: an image shows at most {view}"
        yield fault("lens", text, "fx and fy are focal lengths in pixels")
    largest = max(float(np.linalg.norm(mesh.extents)) for mesh in meshes)
    shown = max(_max_pixels(c, largest, near) for c, (near, _) in zip(cameras, depths, strict=True))
    if shown < least:
        text = f"camera: no object covers more than {shown:.2g} px in any view (labels.min_pixels is {least})"
        remedy = "move camera nearer, or make fx or the image larger"
        if away > FAR:
            text += f"; the nearest place of objects is {away:.3g} m away"
            remedy = "is its position in millimetres? Otherwise move camera nearer, or make fx larger"
        yield fault("labels", text, remedy)


def sampled_plans(scene: Scene, frames: Sequence[int]) -> list[FramePlan]:
    """Plan up to :data:`VIEWS` of the frames, evenly spread."""
    return [plan_frame(scene, frames[position]) for position in evenly_spaced(len(frames), VIEWS)]


def _colliders(scene: Scene) -> Iterator[tuple[str, trimesh.Trimesh]]:
    for shape, mesh in zip(scene.spec.shapes, scene.shape_meshes, strict=True):
        if shape.collider:
            yield shape.name, mesh
    if scene.spec.environment_collides:
        yield from ((around.name, around.mesh) for around in scene.environments if around.mesh is not None)


def reachable_box(scene: Scene) -> tuple[Float64Array, Float64Array]:
    """Return the corners, (3,) each, of a box [m] that contains every point that objects can reach.

    An object that leaves the box causes its layout to be drawn again.
    """
    region = scene.spec.region
    colliders = list(_colliders(scene))
    boxes = [np.asarray(mesh.bounds) for _, mesh in colliders] or [np.array([region.min, region.max])]
    shapes = [shape for shape in scene.spec.shapes if shape.collider]
    walls = [position for position, shape in enumerate(shapes) if not (shape.visible or shape.proxy)]
    names = [name for name, _ in colliders]
    lows, highs = [], []
    for number, (place, arrangements) in enumerate(scene.spec.all_regions):
        beside = walls_beside(scene.spec, number, names, walls)
        low, high = enclosed_bounds(place, arrangements, boxes, beside)
        lows.append(low)
        highs.append(high)
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    beyond = max(
        (float(np.linalg.norm(asset.mesh.extents)) for asset in scene.assets if asset.mesh is not None), default=0.0
    )
    return low - beyond, high + beyond


def _depth_range(camera: Camera, low: Float64Array, high: Float64Array) -> tuple[float, float]:
    """Return the smallest and largest depth of a box in a camera [m], limited by the near plane."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    depth = (corners - camera.centre) @ camera.world_from_camera[:3, 2]
    return max(camera.near, float(depth.min())), max(camera.near, float(depth.max()))


def _max_pixels(camera: Camera, size: float, depth: float) -> float:
    """Return an upper bound of the pixels that an object of a size [m] covers at a depth [m] or beyond.

    Perspective stretches the disc of a small sphere by 1 / cos^3 of its angle to the optical axis, which is largest in
    the corners of the image. Lens distortion may stretch it further.
    """
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], dtype=np.float64)
    steepest = float(np.linalg.norm(camera.ray_slopes(corners), axis=1).max())
    stretch = (1 + steepest**2) ** 1.5 * (4.0 if camera.distortion else 1.0)
    return float(stretch * np.pi / 4 * camera.fx * camera.fy * (size / depth) ** 2)
