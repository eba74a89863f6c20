"""All variations at once: audit, bytewise comparison between numbers of workers and shards, and cost.

    python -m benchmarks.scale.everything [--frames 1000] [--compare 64] [--workers 1 2 7] [--cost 24] [--device cuda]

The scene is ``everything.yaml`` beside this file. Objects are those that the scene draws, at random poses about the
mat, without physics. Unlike in settled layouts, they intersect, occlude each other and leave the image. Audited frames
use 7 points of a lens, because labels are those of its centre. Cost is the mean time of an image with its files,
without the first third of the frames, beside the same scene without variations. A thin lens, which takes 7 to 37
images, and metal, which is path traced, are counted separately.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import mitsplat as ms
from benchmarks.record import figure, recording
from mitsplat.asset import Asset
from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.formats.registry import Catalogue, write_frame
from mitsplat.runtime.device import current_device
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.planning.contents import draw_objects
from mitsplat.scene.spec.scene_spec import FORMATS
from mitsplat.scene.streams import random_stream

ROOT = Path(__file__).resolve().parents[2]
SKIPPED = ("yolo-pose", "exr")
"""Formats that need keypoints, or that hold nothing that an audit reads."""
UNLIKE = ("runs.jsonl", "timings.jsonl", ".lock")
"""Files of a dataset that state when and where it was made."""
PLAIN: dict[str, Any] = {
    "environment": "assets/workcell",
    "backdrop": None,
    "background": None,
    "empty": 0.0,
    "hold_out": {},
    "objects": [{"pool": "assets/*", "count": [7, 13]}],
    "lights": [
        {"kind": "area", "position": [-0.75, -0.55, 1.45], "size": [0.7, 0.5], "radiance": 14},
        {"kind": "area", "position": [0.95, -0.25, 1.35], "size": [0.5, 0.35], "radiance": 7},
        {"kind": "environment", "radiance": 0.32},
    ],
    "randomise": {},
}
"""Changes that disable all variations but poses, with the same mean number of objects and lights."""


def make_folder(folder: Path) -> Path:
    """Write the scene file with images of noise, skies of one sun each, and the workcell in other colours."""
    rng = np.random.default_rng(0)
    (folder / "assets").symlink_to(ROOT / "scenes/assets")
    for name in ("textures", "photos", "skies"):
        (folder / name).mkdir()
        for number in range(3):
            coarse = rng.random((8, 12, 3)).astype(np.float32)
            image = cv2.resize(coarse, (384, 256), interpolation=cv2.INTER_CUBIC)
            if name == "skies":
                sky = 0.5 * np.clip(image, 0.05, 1)
                sky[40 + 10 * number : 46 + 10 * number, 90 * number : 90 * number + 8] = 200
                cv2.imwrite(str(folder / name / f"{number}.hdr"), sky)
            else:
                cv2.imwrite(str(folder / name / f"{number}.png"), np.uint8(255 * np.clip(image, 0, 1)))
    cell = Asset.load(ROOT / "scenes/assets/workcell")
    splats = replace(cell.splats, sh=np.ascontiguousarray(cell.splats.sh[..., ::-1]))
    replace(cell, splats=splats).save(folder / "red_cell")
    path = folder / "everything.yaml"
    path.write_bytes(Path(__file__).with_suffix(".yaml").read_bytes())
    return path


def scatter(scene: ms.Scene, index: int, *, progress: Any = None) -> Layout:
    """Return a layout of the drawn objects at random poses about the mat."""
    rng = random_stream(scene.spec.seed, "scattered layout", index)
    assets, _ = draw_objects(scene, index)
    instances = []
    for number, asset in enumerate(assets, start=1):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.normal((0, -0.08, 0.03), (0.07, 0.07, 0.02))
        instances.append(Instance(number, asset, scene.class_index(asset), pose))
    return Layout(index, tuple(instances), NO_PHYSICS)


def differing(one: Path, other: Path) -> list[str]:
    """Return the files that differ between two datasets."""
    found = [
        {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()} for root in (one, other)
    ]
    names = sorted(name for name in found[0].keys() | found[1].keys() if Path(name).name not in UNLIKE)
    return [
        name
        for name in names
        if not all(name in files for files in found) or found[0][name].read_bytes() != found[1][name].read_bytes()
    ]


def audited(scene: ms.Scene, out: Path, options: argparse.Namespace) -> None:
    """Render frames, and audit them."""
    start = time.perf_counter()
    summary = ms.write_dataset(scene, out, frames=options.frames, settle=scatter, workers=None, device=options.device)
    found = audit_dataset(out)
    figure(summary.frames, "", "frames")
    figure(found.instances, "", "instances")
    figure(len(found.violations), "", "violations")
    print(f"{summary.frames} frames, {found.instances} instances in {found.files} files", end=" ")
    print(f"in {time.perf_counter() - start:.0f} s; not labelled: {found.dropped}; marked: {found.marked}")
    print(f"violations: {len(found.violations)}")
    for file, text in found.violations[:20]:
        print(f"  {file}: {text}")


def compared(scene: ms.Scene, folder: Path, options: argparse.Namespace) -> None:
    """Compare the same frames from several numbers of workers, and from two shards."""
    given: dict[str, Any] = {"frames": options.compare, "settle": scatter, "device": options.device}
    made = []
    for workers in options.workers:
        made.append(folder / f"workers_{workers}")
        ms.write_dataset(scene, made[-1], workers=workers, **given)
    shards = [folder / f"shard_{number}" for number in (1, 2)]
    for number, shard in enumerate(shards, start=1):
        ms.write_dataset(scene, shard, shard=Shard(number, 2), workers=1, **given)
    made.append(folder / "merged")
    merge_shards(shards, made[-1])
    for one in made[1:]:
        names = differing(made[0], one)
        figure(len(names), "", "differing files", one.name)
        print(f"{one.name}: {len(names)} files differ from those of {made[0].name} {names[:5]}")


def cost_of(path: Path, overrides: dict[str, Any], frames: int, folder: Path) -> float:
    """Return the seconds of an image and its files: CPU time, or wall-clock time on a GPU.

    The first layouts are excluded.
    """
    scene = ms.load_scene(path, overrides={**overrides, "output.width": 1280, "output.height": 720}, allow_outside=True)
    catalogue, clock = Catalogue.of(scene), time.process_time if current_device().kind == "cpu" else time.perf_counter
    taken = []
    with ms.Renderer(scene) as renderer:
        for index in range(frames):
            layout = scatter(scene, index // scene.spec.output.views)
            start = clock()
            frame = renderer.render(index, layout=layout)
            write_frame(frame, folder, scene.spec, catalogue)
            taken.append(clock() - start)
    return float(np.mean(taken[len(taken) // 3 :]))


def cost(path: Path, spec: Any, frames: int, folder: Path) -> None:
    """Measure the cost of an image without and with all variations."""
    table, tray = (shape.model_dump(mode="json") for shape in spec.shapes[:2])
    camera = spec.camera.model_dump(mode="json")
    plain = {key: camera[key] for key in ("kind", "target", "radius", "elevation", "azimuth", "intrinsics")}
    formats = {"output.formats": ["yolo", "depth"]}
    measured = {"output.formats": ["yolo", "depth", "depth-sensor"]}
    runs = {
        "nothing": {**PLAIN, **formats, "shapes": [table, {**tray, "materials": []}], "camera": plain},
        "everything": measured,
    }
    seconds = {name: cost_of(path, overrides, frames, folder / name) for name, overrides in runs.items()}
    for name, value in seconds.items():
        share = value / seconds["nothing"]
        figure(value, "s", "an image", name)
        figure(share, "", "share", name)
        print(f"{name}: {value:.2f} s an image of 1280x720, {share:.2f} of that with nothing varied")


def main() -> None:
    """Print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1000, help="number of audited frames; 0 for none")
    parser.add_argument("--compare", type=int, default=64, help="number of compared frames; 0 for none")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 7])
    parser.add_argument("--cost", type=int, default=24, help="number of frames for the cost; 0 for none")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    ms.use_device(options.device)
    with recording("scale.everything", parser, options), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = make_folder(folder)
        formats = [name for name in FORMATS if name not in SKIPPED]
        scene = ms.load_scene(path, overrides={"output.formats": formats}, allow_outside=True)
        if options.frames:
            few = {"output.formats": formats, "rendering.lens_rings": 1}
            audited(ms.load_scene(path, overrides=few, allow_outside=True), folder / "audited", options)
        if options.compare:
            compared(scene, folder, options)
        if options.cost:
            cost(path, scene.spec, options.cost, folder / "cost")


if __name__ == "__main__":
    main()
