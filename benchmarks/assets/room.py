"""Reconstruction of a furnished room from hand-held photographs, with its table, against the truth.

    python -m benchmarks.assets.room OUT [--views 150] [--width 480] [--gaussians 60000] [--iterations 3000]

A table with objects stands at a wall of a room with wallpaper and a cabinet. A ChArUco board lies on the table, and the
exposure drifts. ``mitsplat asset --kind environment`` makes an environment and a scene of the path-traced images, and
parts are dropped on the detected table. The exit status is 1 if a figure misses its threshold. OUT stores the photos
and the stages of the asset for later runs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from benchmarks.assets import photographing
from benchmarks.assets.clutter import exposures, mottled
from benchmarks.assets.judged import on_truth, tell_wanted
from benchmarks.assets.known import BOARD
from benchmarks.assets.photographing import by_name, paint, photograph
from benchmarks.record import cpu_seconds, figure, recording
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.dataset.write import write_dataset
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.fit.trainer import fit_capture
from mitsplat.geometry.camera import Camera
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE
from mitsplat.reconstruct.pipeline.asset_pipeline import asset_from_photos
from mitsplat.reconstruct.reconstruct import AssetJob
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.loading.scene_loading import load_scene

PARTS = Path(__file__).parents[2] / "scenes" / "assets"

WANTED = {
    "photos registered, %": 95.0,
    "held-out PSNR, dB": 27.0,
    "scale error, %": 0.5,
    "table normal, degrees": 1.0,
    "table height, mm": 3.0,
    "table edge, mm": 20.0,
    "instances on the table": 1,
}
LEAST = {"photos registered, %", "held-out PSNR, dB", "instances on the table"}
"""Figures with a minimum; for all others, less is better."""

TABLE = (1.3, 0.75)
"""Width and depth of the table [m], whose top is z = 0 and centred on the origin."""
FLOOR = -0.72
ROOM = (3.4, 3.0, 2.3)
"""Width, depth and height of the room [m]; the table stands at the wall in +y."""
LAMP = [-0.5, -0.45, FLOOR + ROOM[2] - 0.02]
"""Position of the only lamp [m]."""


def walk(count: int, width: int, seed: int = 17) -> list[Camera]:
    """Return hand-held cameras, 4:3, on the free side of the table: close, at arm's length, and further back."""
    rng = np.random.default_rng(seed)
    cameras = []
    for number in range(count):
        share = number / count
        stride = (3.0 * share) % 1.0
        near, far = ((0.38, 0.55), (0.62, 0.8), (0.95, 1.25))[min(int(3 * share), 2)]
        sweep = stride if int(3 * share) % 2 == 0 else 1 - stride
        turn = np.radians(-90 + 190 * (sweep - 0.5) + rng.normal(0, 2))
        target = np.array([0.42, 0.12, 0.0]) * rng.uniform(-1, 1, 3) + (0, 0, 0.03)
        height = np.radians(rng.uniform(28, 62) if share < 0.67 else rng.uniform(12, 38))
        away = rng.uniform(near, far)
        place = target * (0.8, 0.5, 1) + away * np.array(
            [np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)]
        )
        if share >= 0.67 and number % 3 == 0:  # photos around the room
            target = place + (np.array([np.sin(2 * np.pi * sweep), 1.0, -0.1]) * (1.0, 0.8, 1))
        place = place.clip((-1.5, -1.35, 0.12), (1.5, 0.55, 1.4))
        up = np.array([0, 0, 1]) + rng.normal(0, 0.03, 3)
        cameras.append(Camera.look_at(place, target, up=up, width=width, height=width * 3 // 4, fov_x=64))
    return cameras


def papered(rng: np.random.Generator, colour: tuple[float, float, float], size: int = 512) -> Any:
    """Return a matt material with a faded print of several scales, and pictures on the wall."""
    shade = np.zeros((size, size, 1))
    for sigma, weight in ((1.5, 0.30), (4, 0.45), (14, 0.35)):
        noise = gaussian_filter(rng.normal(size=(size, size)), sigma, mode="wrap")[..., None]
        shade += weight * noise / noise.std()
    picture = np.array(colour) * (1 + 0.35 * shade)
    for _ in range(5):
        across, down = rng.integers(size // 14, size // 6, 2)
        x, y = rng.integers(0, size - across), rng.integers(0, size - down)
        picture[y : y + down, x : x + across] = rng.uniform(0.1, 0.8, 3) * (
            1 + 0.35 * shade[y : y + down, x : x + across]
        )
    return paint(np.clip(picture, 0.03, 0.85).astype(np.float32))


def things() -> list[tuple[trimesh.Trimesh, tuple[float, float], float, tuple[float, float, float]]]:
    """Return the objects on the table: mesh, position, rotation and colour, mostly at the back and the sides."""
    box, ball, can = trimesh.creation.box, trimesh.creation.icosphere, trimesh.creation.cylinder
    return [
        (box((0.30, 0.14, 0.22)), (-0.40, 0.25), 0.1, (0.55, 0.25, 0.18)),
        (box((0.16, 0.11, 0.10)), (-0.02, 0.28), -0.2, (0.25, 0.45, 0.3)),
        (can(0.05, 0.16, sections=48), (0.24, 0.27), 0.0, (0.25, 0.4, 0.65)),
        (can(0.035, 0.09, sections=48), (0.52, 0.10), 0.0, (0.7, 0.55, 0.2)),
        (ball(4, 0.045), (-0.53, -0.12), 0.0, (0.75, 0.65, 0.25)),
        (box((0.12, 0.20, 0.05)), (0.52, -0.18), 0.5, (0.5, 0.3, 0.5)),
    ]


def room() -> dict[str, Any]:
    """Return the room as a Mitsuba scene, with the board on the left of the table."""
    ensure_variant()
    rng = np.random.default_rng(6)
    place = mi.ScalarTransform4f()
    sheet = np.array([BOARD.columns, BOARD.rows]) * BOARD.square / 2
    drawn = BOARD.draw(60).astype(np.float32) / 255
    wide, deep, high = ROOM
    middle = TABLE[1] / 2 + 0.04 - deep / 2
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "lamp": {
            "type": "rectangle",
            "to_world": place.translate(LAMP).rotate([1, 0, 0], 180).scale([0.45, 0.35, 1]),
            "light": {"type": "area", "radiance": {"type": "rgb", "value": 11.0}},
        },
        "ceiling": {
            "type": "rectangle",
            "to_world": place.translate([0, middle, FLOOR + high]).scale([wide / 2, deep / 2, 1]),
            "bsdf": papered(rng, (0.7, 0.7, 0.68)),
        },
        "floor": {
            "type": "rectangle",
            "to_world": place.translate([0, middle, FLOOR]).scale([wide / 2, deep / 2, 1]),
            "bsdf": papered(rng, (0.42, 0.32, 0.22)),
        },
        "top": {
            "type": "cube",
            "to_world": place.translate([0, 0, -0.02]).scale([TABLE[0] / 2, TABLE[1] / 2, 0.02]),
            "bsdf": papered(rng, (0.5, 0.44, 0.36)),
        },
        "board": {
            "type": "rectangle",
            "to_world": place.translate([-0.18, -0.1, 0.0004]).scale([float(sheet[0]), float(sheet[1]), 1]),
            "bsdf": paint(np.repeat(0.05 + 0.75 * drawn[..., None], 3, axis=2)),
        },
        "cabinet": {
            "type": "cube",
            "to_world": place.translate([1.3, 0.1, FLOOR + 0.55]).scale([0.25, 0.3, 0.55]),
            "bsdf": papered(rng, (0.35, 0.4, 0.5), 256),
        },
    }
    for number, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        leg = place.translate([x * (TABLE[0] / 2 - 0.05), y * (TABLE[1] / 2 - 0.05), FLOOR / 2 - 0.02])
        scene[f"leg{number}"] = {
            "type": "cube",
            "to_world": leg.scale([0.025, 0.025, -FLOOR / 2 - 0.02]),
            "bsdf": paint(np.full((2, 2, 3), 0.3, dtype=np.float32)),
        }
    tones = [(0.55, 0.5, 0.42), (0.42, 0.5, 0.55), (0.5, 0.42, 0.45), (0.45, 0.52, 0.42)]
    for number, (x, y, half) in enumerate(((1, 0, deep / 2), (0, 1, wide / 2), (-1, 0, deep / 2), (0, -1, wide / 2))):
        turn = place.translate([x * wide / 2, middle + y * deep / 2, FLOOR + high / 2]).rotate([0, 0, 1], 90 * number)
        scene[f"wall{number}"] = {
            "type": "rectangle",
            "to_world": turn.rotate([0, 1, 0], -90).scale([high / 2, half, 1]),
            "bsdf": papered(rng, tones[number]),
        }
    for number, (mesh, (x, y), turned, colour) in enumerate(things()):
        mesh.apply_transform(trimesh.transformations.rotation_matrix(turned, (0, 0, 1)))
        mesh.apply_translation((x, y, -mesh.bounds[0, 2]))
        scene[f"thing{number}"] = mottled(mesh, colour, 30 + number)
    return scene


def compare(asset: Path, truth: Mapping[str, Camera]) -> dict[str, float]:
    """Compute the errors of an environment whose support is aligned by its cameras."""
    verdict = json.loads((asset / VERDICT_FILE).read_text())
    moved, matrix, residuals = on_truth(asset, truth)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    figures = {
        "photos registered, %": 100 * len(moved.photos) / len(truth),
        "worst camera, mm": 1000 * float(np.linalg.norm(residuals, axis=1).max()),
        "scale error, %": 100 * abs(1 / scale - 1),
        "held-out PSNR, dB": float(verdict["psnr"]),
    }
    for support in verdict.get("supports", [])[:1]:
        pose = matrix @ np.array(support["pose"])
        normal, middle = pose[:3, 2] / scale, pose[:3, 3]
        corners = np.array([[x, y] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * support["size"]
        at = corners @ pose[:3, :2].T + middle
        size = np.array(support["size"]) * scale
        figures |= {
            "table normal, degrees": float(np.degrees(np.arccos(np.clip(normal[2], -1, 1)))),
            "table height, mm": 1000 * float(np.abs(at[:, 2]).max()),
            "table edge, mm": 1000 * float(np.abs(size - TABLE).max() / 2 + np.linalg.norm(middle[:2])),
        }
    return figures


def drop(scene: Path, out: Path, parts: Path) -> int:
    """Return the number of instances in images of the scene with real parts; the scene is stored in ``out``."""
    text = scene.read_text().replace("pool: primitives", f"pool: {parts.resolve()}/*")
    path = scene.with_name("room_with_parts.yaml")
    path.write_text(text)
    loaded = load_scene(path, overrides={"output": {"layouts": 2, "views": 2}}, allow_outside=True)
    written = write_dataset(loaded, out, overwrite=True).path
    records = [json.loads(line) for line in (written / "manifest.jsonl").read_text().splitlines()]
    return min(len(record["labels"]["instances"]) for record in records)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=150)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--samples", type=int, default=24)
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--iterations", type=int, default=3000)
    args = parser.parse_args()
    with recording("assets.room", parser, args, ignore=("out",)):
        missed = measure(args)
    sys.exit(missed > 0)


def measure(args: argparse.Namespace) -> int:
    """Print and keep the figures; how many of them miss what is wanted."""
    views, photos, asset = walk(args.views, args.width), args.out / "photos", args.out / "cell"
    source = hashlib.sha256(b"".join(Path(str(module)).read_bytes() for module in (__file__, photographing.__file__)))
    marker, made = args.out / "photos.json", json.dumps([args.views, args.width, args.samples, source.hexdigest()])
    times = args.out / "cpu_seconds.json"
    spent: dict[str, float] = json.loads(times.read_text()) if times.exists() else {}
    began = cpu_seconds()

    def stage(name: str) -> None:
        """Record the time of a stage; reused stages keep their earlier time."""
        nonlocal began
        spent[name], began = max(cpu_seconds() - began, spent.get(name, 0.0)), cpu_seconds()
        times.write_text(json.dumps(spent))

    if not (marker.exists() and marker.read_text() == made):
        shutil.rmtree(photos, ignore_errors=True)
        gains = exposures(len(views))
        photograph(room(), views, photos, samples=args.samples, noise=0.006, gains=gains)
        marker.write_text(made)
    stage("photographs")
    capture = CaptureSettings(kind="environment", board=BOARD)
    fit = FitSettings(gaussians=args.gaussians, iterations=args.iterations, max_size=args.width, masks="off")
    taken = capture_photos(photos, asset / "capture", capture)
    stage("cameras")
    fit_capture(taken.capture, asset / "fit", fit, overwrite=True)
    stage("fit")
    job = AssetJob(name="room", kind="environment")
    done = asset_from_photos(photos, asset, job, capture=capture, fit=fit)
    stage("environment")
    for sentence in done.verdict.misses():
        print(f"  verdict: {sentence}", file=sys.stderr)
    for what, text in done.verdict.rows.items():
        print(f"  {what}: {text}", file=sys.stderr)
    found = compare(asset, by_name(views))
    if done.scene is not None:
        found["instances on the table"] = drop(done.scene, args.out / "dropped", PARTS)
    stage("parts dropped and rendered")
    for name, seconds in spent.items():
        figure(seconds, "s CPU", name)
        print(f"{name:30} {seconds:8.1f} CPU s")
    return tell_wanted(found, WANTED, LEAST)


if __name__ == "__main__":
    main()
