"""Warnings of probable mistakes in a scene that do not stop a run.

Examples are views or lights inside of solids, bins that are too small, and high cost in memory or time. Mistakes that
stop a run are in :mod:`mitsplat.dataset.preflight`.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence, Set

import numpy as np

from mitsplat.dataset.preflight import MAX_FRAMES, fault, reachable_box, sampled_plans
from mitsplat.engine.resources import unused_memory
from mitsplat.findings import Finding
from mitsplat.frames.budget import worker_memory
from mitsplat.geometry.camera import Camera
from mitsplat.scene.planning.frame_lights import expand_rooms
from mitsplat.scene.planning.frame_plan import FramePlan, plan_frame
from mitsplat.scene.planning.lens_warnings import lens_warnings
from mitsplat.scene.planning.unit_warnings import unit_warnings
from mitsplat.scene.planning.view_diagnosis import FAR, distance_to_box, sees
from mitsplat.scene.planning.visibility_prediction import enclosing_shape
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import LocalLight
from mitsplat.scene.walls import backdrop_walls, pose_matrix

MIN_SHARE_IN_BIN = 0.5
"""Share of the region above a bin below which objects probably fall beside it by mistake."""
SLOW_OBJECTS = 40
"""Number of objects per layout above which settling takes minutes on two cores; 25 took 27 s, 50 took 212 s."""


def scene_warnings(scene: Scene) -> Iterator[Finding]:
    """Find probable mistakes of a scene."""
    spec = scene.spec
    plans = sampled_plans(scene, range(min(scene.num_frames, MAX_FRAMES)))
    cameras = [plan.camera for plan in plans]
    inside = [name for camera in cameras if (name := enclosing_shape(scene, camera.centre))]
    low, high = reachable_box(scene)
    blind = [camera for camera in cameras if not sees(camera, low, high)]
    remedy = "move camera, its keys or its ranges: such images have no labels"
    if blind and distance_to_box(blind[0].centre, low, high) > FAR:
        remedy += "; is a position in millimetres?"
    yield Finding(
        "views",
        not inside and not blind,
        f"of {len(cameras)} views, {len(inside)} lie inside a shape and {len(blind)} show no place where objects can "
        "be",
        remedy,
    )
    if spec.output.views > 1 and spec.background is None and _is_repeated(scene, plans[0]):
        text = "output.views: the images of a layout show the same view in the same light, and differ in noise alone"
        yield fault("views", text, "set it to 1 with more layouts, or state camera.jitter or randomise")
    yield from lens_warnings(spec)
    yield from unit_warnings(spec)
    yield from _cost_warnings(scene)
    drawn = {light for plan in plans for light in plan.lights if isinstance(light, LocalLight)}
    yield from _backdrop_warnings(scene, cameras, drawn)
    yield from _light_warnings(scene, drawn)
    yield from _bin_warnings(scene)
    yield from _class_warnings(scene)


def _is_repeated(scene: Scene, one: FramePlan) -> bool:
    """Return True if the second image has the view, the light and the random values of the first one."""
    other = plan_frame(scene, 1)
    values = [{**plan.draws, "motion_angle": 0.0} for plan in (one, other)]
    same_view = np.array_equal(one.camera.world_from_camera, other.camera.world_from_camera)
    return same_view and one.lights == other.lights and one.belt == other.belt and values[0] == values[1]


def _light_warnings(scene: Scene, drawn: Set[LocalLight]) -> Iterator[Finding]:
    """Warn of lights inside of shapes; ``drawn`` are the lights of the examined frames."""
    local = {i: light for i, light in enumerate(scene.spec.lights) if isinstance(light, LocalLight)}
    for number, light in local.items():
        if not light.has_drawn_position and (name := enclosing_shape(scene, np.array(light.position))):
            text = f"lights[{number}] is inside of shape {name!r}"
            yield fault("lights", text, "move it out: it lights nothing")
    if any(isinstance(light, LocalLight) and light.has_drawn_position for light in expand_rooms(scene.spec)):
        names = [name for light in drawn if (name := enclosing_shape(scene, np.array(light.position)))]
        if names:
            text = f"{len(names)} of {len(drawn)} drawn lights lie inside a shape, such as {names[0]!r}"
            yield fault("lights", text, "narrow lights[].draw: they light nothing")


def _bin_warnings(scene: Scene) -> Iterator[Finding]:
    """Warn of bins that are too small for an object, and of bins beside which objects fall."""
    regions = scene.spec.all_regions
    for number, shape in enumerate(scene.spec.shapes):
        if shape.bin is None:
            continue
        opening = np.sort(shape.bin.size[:2])
        too_large = [
            asset.name
            for asset in {asset.name: asset for asset in scene.assets}.values()
            if asset.mesh is not None and (np.sort(asset.mesh.extents)[:2] > opening).any()
        ]
        for name in too_large:
            text = f"shapes[{number}]: {name!r} does not fit into {shape.name!r}"
            yield fault("bin", text, "make the bin larger, or the object smaller by scale")
        # Beside a bin that some layouts lack, objects are meant to fall.
        if too_large or not shape.collider or shape.share < 1 or all(entry.poses for entry in scene.spec.objects):
            continue
        centre, half = np.array(shape.bin.position[:2]), np.array(shape.bin.size[:2]) / 2
        shares = []
        for region, _ in regions:
            low, high = np.array(region.min[:2]), np.array(region.max[:2])
            common = np.minimum(high, centre + half) - np.maximum(low, centre - half)
            share = float(np.prod(np.maximum(common, 0)) / np.prod(high - low))
            shares.append(share if region.max[2] > shape.bin.position[2] else 0.0)
        where = "the region is" if len(regions) == 1 else "all regions are"
        if max(shares) == 0:
            text = f"shapes[{number}]: {where} beside the bin {shape.name!r}, so no object falls into it"
            yield fault("bin", text, "move region above it, or the bin below it (metres?)")
        elif len(regions) == 1 and shares[0] < MIN_SHARE_IN_BIN:
            text = f"region: only {shares[0]:.0%} of it is above the bin {shape.name!r}"
            yield fault("bin", text, "make region smaller than the bin, or objects fall beside it")


def _class_warnings(scene: Scene) -> Iterator[Finding]:
    """Warn of class names that are probably one class: they differ in case, separators, or the encoding of accents."""
    spellings: dict[str, list[str]] = {}
    for name in scene.class_names:
        plain = re.sub(r"[\s_-]+", "_", unicodedata.normalize("NFKC", name).casefold()).strip("_")
        spellings.setdefault(plain, []).append(name)
    for names in spellings.values():
        if len(names) > 1:
            spelt = " and ".join(map(repr, names))
            text = f"objects: classes {spelt} differ only in case, separators or accents' encoding"
            yield fault("classes", text, "if they are one class, write one name: class_name, or class of asset.yaml")


def _cost_warnings(scene: Scene) -> Iterator[Finding]:
    """Warn of frames that may exceed the memory, and of layouts that take minutes to settle."""
    output, free = scene.spec.output, unused_memory()
    need = worker_memory(scene).own / 2**30
    if need > free:
        size = f"{output.width}x{output.height} px"
        text = f"an image of {size} may take {need:.1f} GiB of memory ({free:.1f} GiB are unused)"
        yield fault("memory", text, "lower output.width and height: it may be refused after the first layout")
    most = sum(entry.max_count for entry in scene.spec.objects if not entry.poses)
    if most > SLOW_OBJECTS:
        text = f"a layout of up to {most} objects takes minutes to settle"
        yield fault("settling", text, "lower objects[].count, or add views to each layout by output.views")


def _backdrop_warnings(scene: Scene, cameras: Sequence[Camera], lights: Set[LocalLight]) -> Iterator[Finding]:
    """Warn of views and lights behind a wall of the backdrop."""
    walls = backdrop_walls(scene.spec)
    middle = (np.array(scene.spec.region.min) + scene.spec.region.max) / 2

    def behind(point: Iterable[float]) -> bool:
        """Return True if the middle plane of a wall separates a point from the centre of the region."""
        for box in walls:
            axis = int(np.argmin(box.size))
            turn = pose_matrix(box)[:3, :3].T
            here, there = (turn @ np.subtract(tuple(place), box.position) for place in (point, middle))
            if here[axis] * there[axis] < 0:
                return True
        return False

    if hidden := sum(behind(camera.centre) for camera in cameras):
        text = f"of {len(cameras)} views {hidden} are from behind a wall of the backdrop, which hides everything"
        yield fault("backdrop", text, "make backdrop.size larger")
    if hidden := sum(behind(light.position) for light in lights):
        text = f"{hidden} of {len(lights)} lights are behind a wall of the backdrop"
        yield fault("backdrop", text, "move lights into the room")
