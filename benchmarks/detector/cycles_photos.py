"""Simulated photographs of the machine parts by Blender Cycles, a test set that shares no renderer with mitsplat.

    python -m venv /tmp/blender && /tmp/blender/bin/pip install bpy==4.5.15     # needs Python 3.11
    python -m benchmarks.detector.cycles_photos WORK --blender /tmp/blender/bin/python [--scenes 12] [--views 8]
        [--width 960] [--samples 64] [--processes 1] [--blender-device CUDA]

Parts of the shipped scenes are dropped on a bench, poured into a bin or laid out by hand, among tools, cables, cloth
and packaging, in rooms with windows, fluorescent tubes and desk lamps. Only the shapes, the prints and the physics are
mitsplat's. Materials, light, lens (depth of field, motion blur), denoiser and tone curve are Blender's
(``blender_photos.py``).

WORK/cycles_inputs gets the scenes; ``blender_photos.py`` reads nothing else, and may run on another machine.
WORK/cycles becomes a COCO folder, which ``cycles_96.yaml`` evaluates; results of fewer photographs are recorded as
``cycles.yaml``. Existing scenes and photographs are not made again. Without ``--blender``, only scenes and labels are
written.

Masks are the object index at pixel centres, without depth of field and motion blur. A part is labelled if it shows at
least ``LEAST_SEEN`` of the pixels that it covers alone. The whole set is for testing only.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

# isort: off
from benchmarks.light.shadow_scenes import Thing, nearest_object, placed, shipped

import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import binary_dilation
from shapely.geometry import MultiPoint

# isort: on
from benchmarks.detector.clutter import STEEL, Material, matt, metal
from benchmarks.detector.interiors import Interior, interior
from benchmarks.detector.workshop import PLASTIC, WOOD, annotation, check_labels, settle_parts, write_labels
from benchmarks.record import ROOT, recording
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.capture.lighting.panorama import unit_vector
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_normals import corner_normals
from mitsplat.runtime.variant import ensure_variant
from scenes.build.parts import PARTS

SCRIPT = Path(__file__).with_name("blender_photos.py")
SEED = 530000
"""First seed of the layouts, unlike those of training scenes and ``workshop.py``."""
KINDS = ("drop", "pile", "placed")

RING = metal((0.62, 0.61, 0.60), 0.14)
ZINC = metal((0.70, 0.72, 0.75), 0.26)
PRINTED = matt((1, 1, 1), 0.4)
FINISHES: dict[str, dict[str, Material]] = {
    "hex_nut_m16": {"body": ZINC},
    "hex_nut_m20": {"body": ZINC},
    "hex_bolt": {"body": metal((0.075, 0.075, 0.08), 0.36), "mark": matt((1, 1, 1), 0.45)},
    "washer": {"body": metal((0.72, 0.62, 0.38), 0.28)},
    "l_bracket": {"body": metal((0.035, 0.12, 0.42), 0.33)},
    "spur_gear": {"body": metal(STEEL, 0.3)},
    "bearing_6204": {"outer": RING, "inner": RING, "seal": PRINTED},
    "bearing_6206": {"outer": RING, "inner": RING, "seal": PRINTED},
    "cable_clip": {"body": matt((0.45, 0.03, 0.02), 0.38)},
    "relay_box": {
        "cover": matt((0.60, 0.60, 0.56), 0.32), "socket": matt((0.02, 0.02, 0.022), 0.45),
        "pins": metal((0.80, 0.62, 0.30), 0.25), "button": matt((0.75, 0.18, 0.015), 0.35),
        "front_label": PRINTED, "back_label": PRINTED, "top_label": PRINTED,
    },
    "brass_fitting": {"body": metal((0.84, 0.66, 0.32), 0.24)},
    "proximity_sensor": {
        "barrel": metal((0.66, 0.62, 0.56), 0.2), "nut": metal((0.66, 0.62, 0.56), 0.24),
        "gland": matt((0.018, 0.018, 0.02), 0.5), "face": matt((0.012, 0.14, 0.42), 0.35),
    },
}  # fmt: skip
"""Materials of the parts; only prints keep their texture."""


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--blender", help="Python of an environment with bpy")
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--processes", type=int, default=1, help="Blender processes, which share the cores")
    parser.add_argument("--blender-device", default="CPU", help="CPU, or the kind of GPU of Cycles: CUDA, OPTIX")
    options = parser.parse_args()
    ensure_variant()
    with recording(
        "detector.cycles_photos", parser, options, ignore=("work", "blender", "blender_device", "processes")
    ):
        photograph_benches(options)


def photograph_benches(options: argparse.Namespace) -> None:
    """Write the scenes that are missing, render the photographs that are missing, and label all."""
    inputs, photos = options.work / "cycles_inputs", options.work / "cycles"
    inputs.mkdir(parents=True, exist_ok=True)
    photos.mkdir(exist_ok=True)
    made = {"made_by": "cycles_photos", "samples": options.samples, "width": options.width}
    check_labels(photos, made)
    write_parts(inputs)
    for number in range(options.scenes):
        if not (inputs / f"scene_{number:04d}.json").exists():
            write_scene(number, options)
    if options.blender:
        threads = max(1, len(os.sched_getaffinity(0)) // options.processes)
        # -P: modules of this folder must not hide those of Blender.
        command = [options.blender, "-P", str(SCRIPT), str(inputs), str(photos), str(options.processes), str(threads)]
        words = [[*command, str(k), options.blender_device] for k in range(options.processes)]
        jobs = [subprocess.Popen(one, stdout=subprocess.DEVNULL) for one in words]
        if failed := [k for k, job in enumerate(jobs) if job.wait()]:
            raise SystemExit(f"Blender failed in processes {failed} of {options.processes}")
    shots = [shot for path in sorted(inputs.glob("scene_*.json")) for shot in label_scene(path, photos)]
    write_labels(photos, sorted(PARTS), shots, made)


def write_parts(inputs: Path, names: Iterable[str] = PARTS) -> None:
    """Write the meshes and the prints of parts."""
    for name in names:
        for part in read_model(unplaced(name).mesh).parts:
            write_mesh(inputs / f"{name}-{part.name}.npz", part.mesh, None if part.texture is None else part.texture.uv)
            if is_printed(FINISHES[name][part.name]) and part.texture is not None:
                Image.fromarray(np.asarray(part.texture.pixels, np.uint8)).save(inputs / f"{name}-{part.name}.png")


@cache
def unplaced(name: str) -> Thing:
    """Return a part at the origin; building its mesh takes long."""
    return shipped(name, np.eye(4))


def meshes_at(name: str, pose: np.ndarray) -> tuple[MeshPart, ...]:
    """Return the components of a part at a pose (4, 4) [m]."""
    return placed(replace(unplaced(name), pose=pose))


def is_printed(finish: Material) -> bool:
    """Return True if the colour is that of a texture."""
    return tuple(finish["colour"]) == (1, 1, 1)


def write_mesh(path: Path, mesh: trimesh.Trimesh, uv: np.ndarray | None = None) -> None:
    """Write separate triangles with normals at corners, smooth except across creases."""
    arrays = {"triangles": mesh.triangles, "normals": corner_normals(mesh)} | ({} if uv is None else {"uv": uv})
    np.savez_compressed(path, **{key: np.asarray(value, np.float32) for key, value in arrays.items()})


def write_scene(number: int, options: argparse.Namespace) -> None:
    """Write the meshes of one workshop, its parts, and its views."""
    rng, inputs = np.random.default_rng([SEED, number]), options.work / "cycles_inputs"
    lying, bin_size = settled(options.work, number, rng)
    vertices = [np.concatenate([part.mesh.vertices for part in meshes_at(name, pose)]) for name, pose in lying]
    room = interior(number, rng, [points[:, :2] for points in vertices], bin_size)
    objects = []
    for k, (mesh, material, pose) in enumerate(room.objects):
        path = inputs / f"thing_{number:04d}_{k:04d}.npz"
        write_mesh(path, trimesh.Trimesh(mesh.vertices, mesh.faces))
        objects.append({"mesh": path.name, "material": material, "pose": pose.tolist(), "index": 0})
    wear, shine = float(rng.uniform(0.1, 1.0)), float(rng.uniform(0.8, 1.5))
    for index, (name, pose) in enumerate(lying, 1):
        for part, finish in FINISHES[name].items():
            material = finish | {"wear": wear, "roughness": min(1.0, shine * finish["roughness"])}
            material |= {"texture": f"{name}-{part}.png"} if is_printed(finish) else {}
            objects.append({"mesh": f"{name}-{part}.npz", "material": material, "pose": pose.tolist(), "index": index})
    centres = np.array([pose[:3, 3] for _, pose in lying])
    scene = {
        "objects": objects,
        "parts": [{"name": name, "pose": pose.tolist()} for name, pose in lying],
        "world": float(rng.uniform(0.02, 0.1)),
        "samples": options.samples,
        "views": [view_of(rng, room, centres, options.width, 40 if bin_size else 22) for _ in range(options.views)],
    }
    (inputs / f"scene_{number:04d}.json").write_text(json.dumps(scene))


def settled(
    work: Path, number: int, rng: np.random.Generator
) -> tuple[list[tuple[str, np.ndarray]], tuple[float, ...] | None]:
    """Return names and poses (4, 4) [m] of parts, and the inner size of their bin if they are poured."""
    kind = KINDS[number % 3]
    shapes: list[dict[str, Any]] = [
        {"name": "bench", **WOOD, "box": {"size": [1.3, 0.76, 0.05], "position": [0, 0, -0.025]}}
    ]
    bin_size, half = None, np.array([0.2, 0.15])
    if kind == "pile":
        bin_size = tuple(float(value) for value in rng.uniform((0.21, 0.16, 0.045), (0.29, 0.22, 0.07)).round(3))
        half = np.array(bin_size[:2]) / 2 - 0.02
        shapes.append({"name": "bin", **PLASTIC, "bin": {"size": list(bin_size), "thickness": 0.004}})
    upright = {"arrangement": "upright", "turned_over": 0.4} if number % 2 else {"arrangement": "scatter"}
    scene = {
        "name": "bench",
        "shapes": shapes,
        "objects": [{"pool": str(ROOT / "scenes/assets/*"), "count": [11, 16] if kind == "pile" else [9, 15]}],
        "region": {"min": [*(-half).tolist(), 0.03], "max": [*half.tolist(), 0.3]},
        "enclosure": {"margin": 0.01, "floor": 0.004} if bin_size else {"margin": 0.12},
        "settle": (upright if kind == "placed" else {"arrangement": kind}) | {"attempts": 4},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.6, "height": 0.4},
        "output": {"width": 64, "height": 48, "layouts": 1, "views": 1},
        "seed": SEED + number,
    }
    lying = settle_parts(work, scene)
    return (laid_out(lying, rng) if kind == "placed" else lying), bin_size


def laid_out(lying: Sequence[tuple[str, np.ndarray]], rng: np.random.Generator) -> list[tuple[str, np.ndarray]]:
    """Return parts in slightly inexact rows, with their longer side along or across the bench."""
    cells = [(x, y) for y in (-0.13, -0.045, 0.04, 0.125) for x in (-0.18, -0.09, 0, 0.09, 0.18)]
    moved = []
    for (name, pose), cell in zip(lying, rng.permutation(cells), strict=False):
        points = MultiPoint(np.concatenate([part.mesh.vertices for part in meshes_at(name, pose)])[:, :2])
        corners = np.array(points.minimum_rotated_rectangle.exterior.coords)
        edges = np.diff(corners[:3], axis=0)
        x, y = edges[np.linalg.norm(edges, axis=1).argmax()]
        turn = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.07) - np.arctan2(y, x)
        centre = np.append(points.centroid.coords[0], 0)
        place = np.append(cell + rng.normal(0, 0.004, 2), 0)
        turned = trimesh.transformations.rotation_matrix(turn, (0, 0, 1))
        shift = trimesh.transformations.translation_matrix
        moved.append((name, shift(place) @ turned @ shift(-centre) @ pose))
    return moved


def view_of(rng: np.random.Generator, room: Interior, centres: np.ndarray, width: int, lowest: float) -> dict[str, Any]:
    """Return the camera, ``lowest`` [degrees] or higher, lens and development of a photograph from 0.35 to 0.85 m."""
    for _ in range(200):
        target = centres[rng.integers(len(centres))] * (0.7, 0.7, 0.5) + np.append(rng.normal(0, 0.03, 2), 0)
        distance = rng.uniform(0.35, 0.85)
        eye = target + distance * unit_vector(rng.uniform(-165, -15), rng.uniform(lowest, 80))
        up = np.array([0, 0, 1]) + rng.normal(0, 0.06, 3)
        fov = rng.uniform(48, 64)
        camera = Camera.look_at(eye, target, up=up, width=width, height=width * 2 // 3, fov_x=fov)
        pixels, _ = camera.project(centres)
        inside = ((pixels > 0.04 * width) & (pixels < (0.96 * width, 0.96 * camera.height))).all(axis=1)
        way = eye + np.linspace(0, 0.7, 30)[:, None] * (target - eye)
        blocked = any(((way > low - 0.02) & (way < high + 0.02)).all(axis=1).any() for low, high in room.tall)
        if inside.sum() >= min(4, len(centres)) and not blocked:
            break
    sensor, fstop = ((9.8, 1.8), (13.2, rng.uniform(2.8, 4)), (23.5, rng.uniform(4, 8)))[rng.integers(3)]
    shake = None
    if rng.random() < 0.25:
        # Turn and shift during the exposure: 2 to 6 px at the target.
        turn = rng.uniform(2, 6) / camera.fx / 2
        axis = rng.normal(size=3) * (1, 1, 0.3)
        half = trimesh.transformations.rotation_matrix(turn, axis)
        half[:3, 3] = rng.normal(0, 2e-4, 3)
        shake = [(camera.world_from_camera @ end).tolist() for end in (np.linalg.inv(half), half)]
    look = ("AgX", "Filmic", "Standard")[rng.choice(3, p=(0.45, 0.35, 0.2))]
    contrast = ("Medium High Contrast", "High Contrast", "Medium Low Contrast", "None")[rng.integers(4)]
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "world_from_camera": camera.world_from_camera.tolist(),
        "sensor": sensor,
        "fstop": float(fstop),
        "focus": float(distance * rng.uniform(0.93, 1.07)),
        "shake": shake,
        "tone": look,
        "look": f"AgX - {contrast}" if look == "AgX" and contrast != "None" else contrast,
        "exposure": float(rng.uniform(-0.6, 0.7)),
        "white_balance": rng.uniform((0.9, 0.97, 0.88), (1.12, 1.03, 1.14)).tolist(),
        "adapted": float(rng.uniform(0.5, 1)),
        "vignette": float(rng.uniform(0, 0.35)),
        "blur": float(rng.uniform(0.3, 0.8)),
        "noise": float(rng.uniform(0.2, 1.2)),
        "quality": int(rng.integers(70, 96)),
        "seed": int(rng.integers(2**31)),
    }


def label_scene(path: Path, photos: Path) -> list[dict[str, Any]]:
    """Return the labels of the photographs of a scene that exist.

    Raises:
        ValueError: If a mask lies outside of the part that it belongs to.
    """
    scene, shots = json.loads(path.read_text()), []
    if not any(photos.glob(f"{path.stem}_*.jpg")):
        return []
    things: list[tuple[MeshPart, ...]] = [meshes_at(one["name"], np.array(one["pose"])) for one in scene["parts"]]
    for view, spec in enumerate(scene["views"]):
        name = f"{path.stem}_{view:04d}"
        if not (photos / f"{name}.jpg").exists():
            continue
        camera = Camera(
            width=spec["width"], height=spec["height"], fx=spec["fx"], fy=spec["fx"],
            cx=spec["width"] / 2, cy=spec["height"] / 2, world_from_camera=np.array(spec["world_from_camera"]),
        )  # fmt: skip
        index = np.load(photos / f".{name}.npz")["index"]
        objects = []
        for number, (part, one) in enumerate(zip(things, scene["parts"], strict=True), 1):
            seen, whole = index == number, nearest_object(camera, (), [part]) > 0
            if (seen & ~binary_dilation(whole, iterations=2)).any():
                raise ValueError(f"the mask of part {number} ({one['name']}) of {name} lies outside of its silhouette")
            objects += annotation(seen, np.count_nonzero(whole), sorted(PARTS).index(one["name"]) + 1)
        image = {"file_name": f"{name}.jpg", "width": camera.width, "height": camera.height}
        shots.append({"image": image, "objects": objects})
    return shots


if __name__ == "__main__":
    main()
