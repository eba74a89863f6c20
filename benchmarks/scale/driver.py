"""Process that writes records, over many frames: time and memory of every record, and of the end of a run.

    python -m benchmarks.scale.driver [--frames 100000] [--begun 0] [--formats yolo coco bop] [--folder FOLDER]

Runs :func:`mitsplat.dataset.write.write_dataset` completely, and then again with everything finished, but without
rendering. Frames are supplied at full speed, in pairs in the wrong order, as from two workers; their images are hard
links to a few files. ``--begun`` frames exist before, as after an earlier run. They are written at once, not appended
one by one, so that the time of a record after a million can be measured in minutes.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pycocotools import mask as coco_mask

from benchmarks.record import figure, recording
from benchmarks.scale.faults import SCENE
from mitsplat.dataset import write as dataset
from mitsplat.dataset.records.manifest import encode_line
from mitsplat.scene.loading.scene_loading import load_scene

LINKS = 60_000
"""Hard links per file: ext4 allows 65,000."""
VIEWS = 10
POSE = [
    [0.36, 0.48, -0.8, 0.0123456789],
    [-0.8, 0.6, 0.0, -0.0987654321],
    [0.48, 0.64, 0.6, 0.456],
    [0.0, 0.0, 0.0, 1.0],
]
SIZE = 64, 48


def split_of(index: int) -> str:
    """Return the split of a layout: every fifth one is for validation."""
    return "val" if index // VIEWS % 5 == 1 else "train"


class Frames:
    """Replacement of :class:`mitsplat.dataset.frame_job.FrameJob` for frames with existing files."""

    seconds, cpu = 0.0, 0.0
    """Total time that workers would have spent."""
    instances = 3

    def __init__(self, scene: Any, catalogue: Any, out: Path, *functions: Any) -> None:
        self._out = out
        picture = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
        self._picture = cv2.imencode(".png", picture)[1].tobytes()
        self._source: Path | None = None
        for split in ("train", "val"):
            (out / "images" / split).mkdir(parents=True, exist_ok=True)
        covered = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8, order="F")
        for number in range(3):
            layer = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8)
            cv2.circle(layer, (15 + 17 * number, 24), 8, 1, cv2.FILLED)
            covered[..., number] = layer
        codes = coco_mask.encode(covered)
        self._boxes = [[int(x), int(y), int(x + w), int(y + h)] for x, y, w, h in coco_mask.toBbox(codes)]
        self._codes = [code["counts"].decode() for code in codes]
        self._areas = [int(area) for area in coco_mask.area(codes)]

    def file(self, index: int, split: str) -> str:
        """Create the frame's image file; return its path."""
        file = f"images/{split}/{index:06d}.png"
        if index % LINKS < 2 or self._source is None:
            self._source = self._out / file
            self._source.write_bytes(self._picture)
        else:
            os.link(self._source, self._out / file)
        return file

    def __call__(self, index: int, note: Any, /) -> tuple[dict[str, Any], dict[str, float]]:
        """Return the record of frame ``index``'s neighbour."""
        start, begun = time.perf_counter(), time.process_time()
        index ^= 1
        split = split_of(index)
        files = {self.file(index, split): f"{index:064x}"}
        labels = [
            {
                **{"id": number + 1, "asset": 0, "class_index": 0, "class": "nut", "box": box, "area": area},
                **{"amodal_box": box, "amodal_area": area, "silhouette_box": box, "silhouette_area": area},
                **{
                    "depth_area": area,
                    "visible_fraction": 1.0,
                    "truncation": 0.0,
                    "polygon_iou": 1.0,
                    "agreement": 0.98,
                },
                **{"boundary_f1": 1.0, "marks": [], "keypoints": [], "world_from_object": POSE},
                **{"rle": code, "amodal_rle": code},
            }
            for number, (box, area, code) in enumerate(
                (self._boxes[i % 3], self._areas[i % 3], self._codes[i % 3]) for i in range(self.instances)
            )
        ]
        camera = {
            **{"width": SIZE[0], "height": SIZE[1], "distortion": [], "lens": "opencv", "aperture_radius": 0.0},
            **{"intrinsics": [[55.4, 0.0, 32.0], [0.0, 55.4, 24.0], [0.0, 0.0, 1.0]], "focus_distance": 1.0},
            **{"near": 0.01, "world_from_camera": POSE},
        }
        record = {
            **{"index": index, "layout": index // VIEWS, "view": index % VIEWS, "split": split, "seed": index},
            **{"files": files, "draws": {"iso": 123.4}, "lights": [], "camera": camera, "depth_scale": 0.1, "rest": {}},
            "labels": {"size": list(SIZE), "instances": labels, "dropped": {"fragments": 0, "small": 0}},
        }
        Frames.seconds += time.perf_counter() - start
        Frames.cpu += time.process_time() - begun
        return record, {"march": 0.4, "light": 0.5, "settle": 0.0, "write": 0.01}


def begin(scene: Any, out: Path, frames: int) -> None:
    """Write the first frames into a dataset, in the order and bytes of a run."""
    dataset.write_dataset(scene, out, frames=2)
    make = Frames(scene, None, out)
    like = encode_line(make(3, None)[0]).decode()
    tail = like[like.index('"draws"') : like.index(',"check"')] + "}"
    with (out / "manifest.jsonl").open("ab") as manifest:
        manifest.write(like.encode())
        for place in range(3, frames):
            index = place if place == 3 else place ^ 1
            split = split_of(index)
            file = make.file(index, split)
            head = f'"index":{index},"layout":{index // VIEWS},"view":{index % VIEWS},"split":"{split}","seed":{index}'
            text = f'{{{head},"files":{{"{file}":"{index:064x}"}},{tail}'.encode()
            manifest.write(text[:-1] + f',"check":"{hashlib.sha256(text).hexdigest()[:16]}"}}\n'.encode())


class Syncs:
    """Counter and timer of fsync; only one of ``every`` calls is executed."""

    def __init__(self, every: int) -> None:
        self.calls, self.done, self.seconds, self._every, self._real = 0, 0, 0.0, every, os.fsync

    def __call__(self, file: int) -> None:
        """Replace :func:`os.fsync`."""
        self.calls += 1
        if self.calls % self._every == 0:
            start = time.perf_counter()
            self._real(file)
            self.seconds += time.perf_counter() - start
            self.done += 1

    def told(self) -> str:
        """Return the number and the time of the calls."""
        each = 1e3 * self.seconds / max(1, self.done)
        return f"fsync: {self.calls} calls, of which {self.done} were done, {each:.2f} ms each"


def resident() -> float:
    """Return the current memory of this process [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def run(scene: Any, out: Path, frames: int, syncs: Syncs, name: str) -> None:
    """Run one call, and measure each tenth of the frames."""
    walls: list[float] = []
    cpus: list[float] = []
    sizes: list[float] = []

    def clocks() -> list[float]:
        return [time.perf_counter() - Frames.seconds - syncs.seconds, time.process_time() - Frames.cpu, syncs.seconds]

    begun, step, last = time.perf_counter(), 1, clocks()

    def hear(done: int, total: int, text: str) -> None:
        nonlocal step
        if text == "starting":
            step = max(1, (frames - done) // 10)
            figure(time.perf_counter() - begun, "s", name, "opened")
            figure(resident(), "MiB", name, "opened memory")
            print(f"opened in {time.perf_counter() - begun:.1f} s, {done} frames, {resident():.0f} MiB", flush=True)
        elif done % step == 0:
            wall, cpu, synced = (1e3 * (b - a) / step for a, b in zip(last, clocks(), strict=True))
            walls.append(wall)
            cpus.append(cpu)
            sizes.append(resident())
            print(
                f"to frame {done:8d}: {wall:.3f} ms a record ({cpu:.3f} ms CPU) and {synced:.3f} ms in fsync; "
                f"{resident():.0f} MiB",
                flush=True,
            )
        if text == "starting" or done % step == 0:
            last[:] = clocks()

    summary = dataset.write_dataset(scene, out, frames=frames, progress=hear)
    wall, cpu, synced = (b - a for a, b in zip(last, clocks(), strict=True))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for rows, unit, what in ((walls, "ms", "record"), (cpus, "ms", "record cpu"), (sizes, "MiB", "memory")):
        if rows:
            figure((min(rows), max(rows)), unit, name, what)
    figure(wall + synced, "s", name, "end")
    figure(cpu, "s", name, "end cpu")
    figure(peak, "MiB", name, "peak")
    print(
        f"ended in {wall + synced:.1f} s ({cpu:.1f} s CPU; fsync {synced:.1f} s), {summary.frames} frames; "
        f"{resident():.0f} MiB, at most {peak:.0f} MiB so far",
        flush=True,
    )


def main() -> None:
    """Print time and memory of both runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--begun", type=int, default=0)
    parser.add_argument("--formats", nargs="+", default=["yolo", "coco", "bop"])
    parser.add_argument("--instances", type=int, default=3)
    parser.add_argument("--sync-every", type=int, default=1, help="execute only every Nth fsync, to time the rest")
    parser.add_argument("--folder", type=Path, help="parent of the temporary folder")
    options = parser.parse_args()
    if options.frames % (2 * VIEWS):
        parser.error(f"--frames must be a multiple of {2 * VIEWS}")
    with recording("scale.driver", parser, options, ignore=("folder",)):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Measure both runs."""
    Frames.instances = options.instances
    dataset.FrameJob = Frames  # type: ignore[attr-defined, misc, assignment]
    os.fsync = syncs = Syncs(options.sync_every)  # type: ignore[assignment]
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path, out = Path(folder) / "scene.yaml", Path(folder) / "out"
        layouts = f"layouts: {options.frames // VIEWS}, views: {VIEWS}"
        formats = ", ".join(options.formats)
        path.write_text(SCENE.replace("layouts: 3, views: 5", layouts).replace("yolo, coco, exr", formats))
        scene = load_scene(path, allow_outside=True)
        if options.begun:
            begin(scene, out, options.begun)
            print(f"begun with {options.begun} frames", flush=True)
        for name in ("run", "again"):
            run(scene, out, options.frames, syncs, name)
        print(syncs.told())
        sizes = {name: (out / name).stat().st_size for name in ("manifest.jsonl", "annotations/instances_train.json")}
        print({name: f"{size / 1e6:.0f} MB" for name, size in sizes.items()})


if __name__ == "__main__":
    main()
