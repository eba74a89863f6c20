"""Simulated photographs of the machine parts, path-traced in other scenes with another camera.

There are no real photographs of these parts.

    python -m benchmarks.detector.workshop WORK [--scenes 10] [--views 5] [--width 960] [--samples 64] [--device cuda]
        [--first 10 --photos development]

Parts of the shipped scenes are dropped or poured, with their original materials, on benches of other workshops under
other lamps, and rendered by Mitsuba's path tracer. The camera is not mitsplat's: its exposure, noise, tone curve,
sharpening and JPEG are implemented here. WORK gets ``photos/``, a COCO folder with the visible masks of each part, and
``assets/``, which ``workshop.yaml`` renders. Existing photographs are not made again.
Scenes 0 to 9 are the test set. Changes of rendered scenes are tried on scenes 10 to 19, in the folder ``development``.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

# isort: off
from mitsplat.runtime.device import use_device  # imports mitsplat, which must be imported before Dr.Jit

import cv2
import mitsuba as mi
import numpy as np
import pycocotools.mask as coco_mask
import trimesh
from ruamel.yaml import YAML
from scipy.ndimage import gaussian_filter

# isort: on
from benchmarks.assets.photographing import Sensors
from benchmarks.light.shadow_scenes import block, nearest_object, placed, shipped, worn
from benchmarks.record import ROOT, figure, recording
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.bake.part_shapes import bake_lights, mitsuba_scene
from mitsplat.capture.lighting.panorama import unit_vector
from mitsplat.geometry.camera import Camera
from mitsplat.physics.settle import settle_layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight
from scenes.build import materials as m

LEAST_SEEN = 0.15
"""Least visible share of a labelled part, as for rendered images."""

WOOD = {"friction": 0.6, "restitution": 0.4}
PLASTIC = {"friction": 0.5, "restitution": 0.4}
"""Contact properties of benches and trays."""


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--photos", default="photos", help="folder of WORK for the photographs")
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    with recording("detector.workshop", parser, options, ignore=("work",), gpu=options.device != "cpu"):
        use_device(options.device)
        photograph_workshops(options)


def photograph_workshops(options: argparse.Namespace) -> None:
    """Render the photographs of all scenes that are missing, and write the labels of all."""
    photos, assets = options.work / options.photos, options.work / "assets"
    photos.mkdir(parents=True, exist_ok=True)
    made = {"made_by": "workshop", "samples": options.samples, "width": options.width}
    check_labels(photos, made)
    if not assets.exists():
        shutil.copytree(ROOT / "scenes/assets", assets)
    names = sorted(path.parent.name for path in assets.glob("*/asset.yaml") if path.parent.name != "workcell")
    shots: list[dict[str, Any]] = []
    for number in range(options.first, options.first + options.scenes):
        stored = photos / f".scene_{number:04d}.json"
        if not stored.exists():
            stored.write_text(json.dumps(photograph_workshop(number, names, options)))
        shots += json.loads(stored.read_text())
    write_labels(photos, names, shots, made)


def check_labels(photos: Path, made: Mapping[str, Any]) -> None:
    """Refuse a folder with photographs that were made in another way.

    Raises:
        SystemExit: If its labels state another maker or another quality than ``made``.
    """
    labels = photos / "labels.json"
    stated = json.loads(labels.read_text()).get("info", made) if labels.exists() else made
    if stated != made:
        raise SystemExit(f"{labels}: its photographs are of {stated}, and not of {dict(made)}: use another folder")


def write_labels(photos: Path, names: Sequence[str], shots: Sequence[dict[str, Any]], made: Mapping[str, Any]) -> None:
    """Write the COCO file of photographs with how they were ``made``, and record the numbers of images and labels."""
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image, shot in enumerate(shots):
        images.append({"id": image, **shot["image"]})
        annotations += [{"id": len(annotations) + k, "image_id": image, **one} for k, one in enumerate(shot["objects"])]
    categories = [{"id": k, "name": name} for k, name in enumerate(names, 1)]
    labels = {"info": dict(made), "images": images, "annotations": annotations, "categories": categories}
    (photos / "labels.json").write_text(json.dumps(labels))
    figure(len(images), "", "photographs")
    figure(len(annotations), "", "labelled parts")
    print(f"{len(images)} photographs of {len(annotations)} parts: {photos}")


def photograph_workshop(number: int, names: Sequence[str], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Render the photographs of one layout in one workshop; return the labels of each."""
    rng = np.random.default_rng([7, number])
    poured = bool(number % 2)
    lying = settled(options.work, number, poured=poured)
    room = workshop(rng, poured=poured)
    things = [placed(shipped(name, pose)) for name, pose in lying]
    scene = mitsuba_scene([*room, *(part for parts in things for part in parts)], lamps(rng))
    integrator = mi.load_dict({"type": "path", "max_depth": 6})
    sensors, shots = Sensors(), []
    for view in range(options.views):
        camera = hand_held(rng, options.width)
        radiance = mi.render(scene, integrator=integrator, sensor=sensors.like(camera), spp=options.samples, seed=view)
        name = f"scene_{number:04d}_{view:04d}.jpg"
        picture = develop(np.nan_to_num(np.array(radiance)[..., :3].astype(np.float64)), rng)
        cv2.imwrite(
            str(options.work / options.photos / name),
            picture[..., ::-1],
            [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(80, 95))],
        )
        image = {"file_name": name, "width": camera.width, "height": camera.height}
        shots.append({"image": image, "objects": labelled(camera, room, lying, things, names)})
        print(name, len(shots[-1]["objects"]), flush=True)
    return shots


def settled(work: Path, number: int, *, poured: bool) -> list[tuple[str, np.ndarray]]:
    """Return names of parts and their poses, shape (4, 4) [m]: dropped on a bench, or poured into a tray."""
    half = 0.12 if poured else 0.2
    shapes: list[dict[str, Any]] = [
        {"name": "bench", **WOOD, "box": {"size": [1.2, 0.9, 0.05], "position": [0, 0, -0.025]}}
    ]
    if poured:
        shapes.append({"name": "tray", **PLASTIC, "bin": {"size": [0.28, 0.22, 0.05], "thickness": 0.004}})
    scene = {
        "name": "workshop",
        "shapes": shapes,
        "objects": [{"pool": "assets/*", "count": [10, 16] if poured else [8, 14]}],
        "region": {"min": [-half, -0.8 * half, 0.03], "max": [half, 0.8 * half, 0.3]},
        "enclosure": {"margin": 0.01 if poured else 0.15, "floor": 0.004 if poured else 0.0},
        "settle": {"arrangement": "pile" if poured else "drop", "attempts": 40},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.6, "height": 0.4},
        "output": {"width": 64, "height": 48, "layouts": 1, "views": 1},
        "seed": 1000 + number,
    }
    return settle_parts(work, scene)


def settle_parts(work: Path, scene: dict[str, Any]) -> list[tuple[str, np.ndarray]]:
    """Return names of the parts of a scene's first layout, and their poses, shape (4, 4) [m]."""
    path = work / "layout.yaml"
    with path.open("w") as file:
        YAML(typ="safe").dump(scene, file)
    loaded = load_scene(path, allow_outside=True)
    layout = settle_layout(loaded, 0)
    return [(loaded.assets[one.asset].name, np.array(one.world_from_object)) for one in layout.instances]


def workshop(rng: np.random.Generator, *, poured: bool) -> tuple[MeshPart, ...]:
    """Return a bench with a wall behind it and other objects on it, and the tray for poured parts."""
    colours = [tuple(int(value) for value in rng.uniform(40, 225, 3)) for _ in range(12)]
    scratched = m.scratched(m.cast(colours[1], rng), rng, count=80, length=(10, 120), gain=0.3)
    tops = (m.concrete(rng, 512), m.beech(rng, 768, 512, 64), m.cast(colours[0], rng), scratched)
    top, wall = tops[rng.integers(len(tops))], m.cast(colours[2], rng, strength=0.08)
    room = {
        "top": _worn(block((-0.6, -0.45, -0.05), (0.6, 0.45, 0)), top, rng),
        "wall": _worn(block((-2, 0.55, -0.8), (2, 0.6, 1.6)), wall, rng),
        "floor": _worn(block((-2, -2, -0.85), (2, 0.6, -0.8)), m.concrete(rng, 256), rng),
    }
    for k in range(int(rng.integers(3, 7))):
        size = rng.uniform((0.03, 0.03, 0.01), (0.14, 0.1, 0.12))
        solid = (
            trimesh.creation.box(size)
            if rng.random() < 0.6
            else trimesh.creation.cylinder(size[0] / 3, size[2], sections=48)
        )
        angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 0.42)
        solid.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(0, np.pi), (0, 0, 1)))
        solid.apply_translation((1.2 * away * np.cos(angle), away * np.sin(angle), size[2] / 2))
        room[f"thing {k}"] = _worn(solid, m.cast(colours[3 + k], rng, size=64), rng)
    if poured:
        outer = block((-0.144, -0.114, 0), (0.144, 0.114, 0.05))
        inner = block((-0.14, -0.11, 0.004), (0.14, 0.11, 0.2))
        tray = trimesh.boolean.difference([outer, inner], engine="manifold")
        room["tray"] = _worn(tray, m.cast(colours[10], rng, size=64), rng)
    return read_model(trimesh.Scene(room)).parts


def _worn(mesh: trimesh.Trimesh, image: m.Pixels, rng: np.random.Generator) -> trimesh.Trimesh:
    return worn(mesh, image, tile=rng.uniform(0.15, 0.4), roughness=rng.uniform(0.4, 0.9))


def lamps(rng: np.random.Generator) -> dict[str, Any]:
    """Return one to three lamps and ambient light."""
    lights: list[Any] = [EnvironmentLight(kind="environment", radiance=float(rng.uniform(0.1, 0.5)))]
    for _ in range(int(rng.integers(1, 4))):
        place = rng.uniform(0.8, 1.6) * unit_vector(rng.uniform(-180, 0), rng.uniform(30, 75))
        side = float(rng.uniform(0.05, 0.6))
        warm = (1.0, float(rng.uniform(0.75, 1.0)), float(rng.uniform(0.5, 1.0)))
        lights.append(
            AreaLight(
                kind="area",
                position=tuple(place),
                target=(0, 0, 0),
                size=(side, side),
                colour=warm,
                radiance=float(rng.uniform(1.5, 5) / side**2),
            )
        )
    return bake_lights(lights)


def hand_held(rng: np.random.Generator, width: int) -> Camera:
    """Return hand-held cameras, 4:3, with a wider angle than the shipped scenes', from the free side of the bench."""
    target = np.array([*rng.uniform(-0.06, 0.06, 2), 0.01])
    place = target + rng.uniform(0.38, 0.7) * unit_vector(rng.uniform(-160, -20), rng.uniform(20, 75))
    up = np.array([0, 0, 1]) + rng.normal(0, 0.04, 3)
    return Camera.look_at(place, target, up=up, width=width, height=width * 3 // 4, fov_x=62)


def develop(radiance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Develop light (H, W, 3) to uint8.

    Exposure is metered by middle tones, white balance is slightly wrong, shot and read noise is correlated between
    neighbours by demosaicing; a filmic curve (Hable 2010) and sharpening follow.
    """
    height, width = radiance.shape[:2]
    light = radiance * 0.3 * 2 ** rng.uniform(-0.6, 0.6) / max(float(np.quantile(radiance.mean(axis=2), 0.5)), 1e-6)
    light *= rng.uniform(0.9, 1.1, 3)
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    light *= (1 - rng.uniform(0, 0.35) * (x**2 + y**2) / 2)[..., None]
    grain = gaussian_filter(rng.normal(size=light.shape), (0.6, 0.6, 0))
    light = np.maximum(light + grain / grain.std() * rng.uniform(0.2, 1) * np.sqrt(2e-4 * light.clip(0, 4) + 1e-5), 0)

    def curve(value: np.ndarray | float) -> Any:
        toe = value * (0.15 * value + 0.05) + 0.004
        return toe / (value * (0.15 * value + 0.5) + 0.06) - 0.004 / 0.06

    tone = (curve(4.0 * light) / curve(11.2)).clip(0, 1) ** (1 / 2.2)
    amount, radius = rng.uniform(0.2, 1.0), rng.uniform(0.7, 1.4)
    sharp = tone + amount * (tone - gaussian_filter(tone, (radius, radius, 0)))
    return np.rint(255 * sharp.clip(0, 1)).astype(np.uint8)


def labelled(
    camera: Camera,
    room: Sequence[MeshPart],
    lying: Sequence[tuple[str, np.ndarray]],
    things: Sequence[Sequence[MeshPart]],
    names: Sequence[str],
) -> list[dict[str, Any]]:
    """Return COCO annotations of the parts that are sufficiently visible, sampled at pixel centres."""
    seen = nearest_object(camera, room, things)
    objects: list[dict[str, Any]] = []
    for number, ((name, _), parts) in enumerate(zip(lying, things, strict=True), 1):
        whole = np.count_nonzero(nearest_object(camera, (), [parts]))
        objects += annotation(seen == number, whole, names.index(name) + 1)
    return objects


def annotation(pixels: np.ndarray, whole: int, category: int) -> list[dict[str, Any]]:
    """Return the COCO annotation of a part's visible pixels (H, W), or nothing if too few of ``whole`` are visible."""
    if whole == 0 or pixels.sum() < max(LEAST_SEEN * whole, 16):
        return []
    outline = coco_mask.encode(np.asfortranarray(pixels.astype(np.uint8)))
    return [
        {
            "category_id": category,
            "segmentation": outline | {"counts": outline["counts"].decode()},
            "bbox": coco_mask.toBbox(outline).tolist(),
            "area": int(pixels.sum()),
            "iscrowd": 0,
            "visible_fraction": round(float(pixels.sum() / whole), 3),
        }
    ]


if __name__ == "__main__":
    main()
