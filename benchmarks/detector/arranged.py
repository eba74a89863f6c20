"""Rendering of the same objects without physics: upright at random positions, or floating.

    python -m benchmarks.detector.arranged WORK SCENE [--frames 128] [--plan arms.yaml] [--device cuda]

SCENE is one of a plan with the change ``scattered`` or ``floating``. Objects, appearances, lights and surroundings of
every layout are those that the scene draws. ``scattered`` objects have the orientation of their files, a random
rotation about the vertical, and random positions on the surface below their region; they do not overlap.
``floating`` objects have random poses above it; their bounding spheres do not overlap. On a table, the area is larger
than the drop region. Objects without a free position in 500 tries are omitted. WORK/data/SCENE gets the images and
their labels.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# isort: off
import mitsplat as ms  # which must be imported before Dr.Jit

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from shapely import MultiPoint, affinity
from shapely.geometry.base import BaseGeometry

# isort: on
from benchmarks.detector.experiment import PLAN, VIEWS, write_scene
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.planning.contents import draw_objects, draw_regions
from mitsplat.scene.scene import Scene

TRIES = 500
WIDER = 1.5
"""Size relative to the drop region, in scenes without walls around it."""
HIGH = 0.6
"""Maximum height of floating objects [m]."""


def main() -> None:
    """Render."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("scene")
    parser.add_argument("--frames", type=int, default=128)
    parser.add_argument("--plan", type=Path, default=PLAN)
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    ms.use_device(options.device)
    scene = ms.load_scene(write_scene(options.work, options.scene, options.plan))
    floating = options.scene.endswith("floating")
    out = options.work / "data" / options.scene
    print(ms.write_frames(scene, out, frames(scene, options.frames, floating=floating), overwrite=True))


def frames(scene: Scene, count: int, *, floating: bool) -> Iterator[ms.Frame]:
    """Yield the first frames of a scene without physics."""
    with ms.Renderer(scene) as renderer:
        layout = None
        for index in range(count):
            if index % VIEWS == 0:
                layout = arranged(scene, index // VIEWS, floating=floating)
            yield renderer.render(index, layout=layout)


def arranged(scene: Scene, index: int, *, floating: bool) -> Layout:
    """Return a layout of the drawn objects in poses without physics."""
    rng = np.random.default_rng([scene.spec.seed, index, floating])
    assets, _ = draw_objects(scene, index)
    regions = draw_regions(scene.spec, index)
    place = _float if floating else _stand
    taken: list[Any] = []
    instances = []
    for number, (asset, region) in enumerate(zip(assets, regions, strict=True), 1):
        pose = place(scene, scene.assets[asset].mesh, region, taken, rng)
        if pose is not None:
            instances.append(Instance(number, asset, scene.class_index(asset), pose))
    return Layout(index, tuple(instances), NO_PHYSICS)


def _room(scene: Scene, region: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2,) of the area for the objects of a region [m]; the floor is at 0 in all scenes."""
    box, _ = scene.spec.all_regions[region]
    low, high = np.array(box.min)[:2], np.array(box.max)[:2]
    half = (high - low) / 2 * (1 if any(shape.bin for shape in scene.spec.shapes) else WIDER)
    return (low + high) / 2 - half, (low + high) / 2 + half


def _stand(
    scene: Scene, mesh: trimesh.Trimesh, region: int, taken: list[BaseGeometry], rng: np.random.Generator
) -> np.ndarray | None:
    """Return a pose (4, 4) on the floor beside the standing objects, or None."""
    low, high = _room(scene, region)
    outline = MultiPoint(mesh.vertices[:, :2]).convex_hull
    for _ in range(TRIES):
        x, y = rng.uniform(low, high)
        yaw = rng.uniform(0, 360)
        here = affinity.translate(affinity.rotate(outline, yaw, origin=(0, 0)), x, y)
        if any(here.intersects(other) for other in taken):
            continue
        taken.append(here)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
        pose[:3, 3] = x, y, -mesh.bounds[0, 2]
        return pose
    return None


def _float(
    scene: Scene,
    mesh: trimesh.Trimesh,
    region: int,
    taken: list[tuple[np.ndarray, float]],
    rng: np.random.Generator,
) -> np.ndarray | None:
    """Return a pose (4, 4) above the floor apart from the floating objects, or None."""
    low, high = _room(scene, region)
    middle = mesh.bounds.mean(axis=0)
    radius = float(np.linalg.norm(mesh.vertices - middle, axis=1).max())
    for _ in range(TRIES):
        place = rng.uniform([*low, radius], [*high, max(HIGH, 2 * radius)])
        if any(np.linalg.norm(place - other) < radius + reach for other, reach in taken):
            continue
        taken.append((place, radius))
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = place - pose[:3, :3] @ middle
        return pose
    return None


if __name__ == "__main__":
    main()
