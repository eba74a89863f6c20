"""Images per second by workers and size of the scene, memory over many frames, and the cost of 10^6 images.

    python -m benchmarks.scale.growth workers [--scene FILE] [--workers 1 2 3] [--frames 12] [--size 320x180]
    python -m benchmarks.scale.growth scene [--frames 6] [--size 320x180]
    python -m benchmarks.scale.growth memory [--frames 2000] [--views 50]
    python -m benchmarks.scale.growth project [--seconds 0.6] [--bytes 2.5e5] [--settle 3] [--views 12]

``workers`` also compares the manifests' SHA-256. ``project`` prints the table of ``docs/reliability.md``, which
describes its model, from recorded results or from the given figures.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.figures import read_results
from benchmarks.record import figure, recording
from benchmarks.scale import projection
from benchmarks.scale.faults import SCENE
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import write_dataset
from mitsplat.engine.ray import Cluster
from mitsplat.scene.loading.scene_loading import load_scene

ROOT = Path(__file__).resolve().parents[2]
WORKCELL = ROOT / "scenes/workcell.yaml"


def overrides(size: str, **further: object) -> dict[str, object]:
    width, _, height = size.partition("x")
    return {"output.width": int(width), "output.height": int(height), **further}


def manifest_hash(folder: Path) -> str:
    return hashlib.sha256((folder / "manifest.jsonl").read_bytes()).hexdigest()


class Clock:
    """Progress callback that measures the speed after every worker's first frame."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self.times: list[float] = []

    def __call__(self, done: int, total: int, text: str) -> None:
        """Record the time of a finished frame."""
        if text.startswith("frame "):
            self.times.append(time.monotonic())

    @property
    def speed(self) -> float:
        """Return images per second, NaN for too few frames."""
        kept = self.times[2 * self.workers - 1 :]
        return (len(kept) - 1) / (kept[-1] - kept[0]) if len(kept) > 1 else float("nan")


def measure_workers(path: Path, counts: list[int], frames: int, size: str) -> None:
    """Measure local workers, Ray and shards: speed, and equality of bytes."""
    changes = overrides(size, **{"output.formats": ["yolo", "coco"]})
    scene = load_scene(path, overrides=changes, allow_outside=True)
    print(f"{len(scene.assets)} assets, {size}, {frames} frames; load before: {os.getloadavg()[0]:.1f}")
    found, alone = set(), float("nan")
    with tempfile.TemporaryDirectory() as folder:
        for count in counts:
            out, clock = Path(folder) / f"local{count}", Clock(count)
            write_dataset(scene, out, frames=frames, workers=count, progress=clock)
            found.add(manifest_hash(out))
            alone = clock.speed if count == 1 else alone
            figure(clock.speed, "1/s", f"{count} workers", "speed")
            figure(clock.speed / alone, "", f"{count} workers", "ratio")
            print(f"{count} local workers: {clock.speed:.2f} images/s; manifest {manifest_hash(out)[:16]}", flush=True)
        shards = [Path(folder) / f"shard{number}" for number in (1, 2)]
        for number, shard in enumerate(shards, start=1):
            write_dataset(scene, shard, frames=frames, shard=Shard(number, 2))
        merge_shards(shards, Path(folder) / "merged")
        found.add(manifest_hash(Path(folder) / "merged"))
        print(f"2 shards merged: manifest {manifest_hash(Path(folder) / 'merged')[:16]}", flush=True)
        try:
            import ray  # noqa: F401
        except ImportError:
            print("Ray is not installed")
        else:
            out, clock = Path(folder) / "ray", Clock(1)
            write_dataset(scene, out, frames=frames, workers=None, cluster=Cluster(), progress=clock)
            found.add(manifest_hash(out))
            print(f"Ray, CPU=2 a worker: {clock.speed:.2f} images/s; manifest {manifest_hash(out)[:16]}")
    figure(frames, "", "frames")
    figure(len(found), "", "manifests")
    figure(min(found)[:16], "", "manifest")
    print(f"different manifests: {len(found)}; load after: {os.getloadavg()[0]:.1f}")


def measure_scene(frames: int, size: str) -> None:
    """Measure one process with growing numbers of objects."""
    print("objects  Gaussians  images/s (median)")
    for count in (1, 4, 8, 16):
        text = SCENE.replace("count: [2, 3]", f"count: [{count}, {count}]").replace(
            "64, height: 48", size.replace("x", ", height: ")
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.yaml"
            path.write_text(text)
            scene, times = load_scene(path, allow_outside=True), Clock(1)
            write_dataset(scene, Path(folder) / "out", frames=frames, progress=times)
        gaps = np.diff(times.times)[1:]
        figure(count * len(scene.assets[0].splats), "", f"{count} objects", "gaussians")
        figure(1 / statistics.median(gaps), "1/s", f"{count} objects", "speed")
        print(f"{count:7d}  {count * len(scene.assets[0].splats):9d}  {1 / statistics.median(gaps):.2f}", flush=True)


def measure_memory(frames: int, views: int) -> None:
    """Measure resident memory of one process over many small frames.

    The slope is a least-squares fit without the first quarter of them.
    """
    layouts = -(-frames // views)
    text = SCENE.replace("layouts: 3, views: 5", f"layouts: {layouts}, views: {views}").replace(
        "yolo, coco, exr", "yolo"
    )
    page = os.sysconf("SC_PAGE_SIZE") / 2**20
    rows: list[tuple[int, float]] = []

    def hear(done: int, total: int, text: str) -> None:
        if text.startswith("frame ") and done % 10 == 0:
            rows.append((done, int(Path("/proc/self/statm").read_text().split()[1]) * page))

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(text)
        write_dataset(load_scene(path, allow_outside=True), Path(folder) / "out", frames=frames, progress=hear)
    kept = np.array(rows[len(rows) // 4 :])
    slope = float(np.polyfit(kept[:, 0], kept[:, 1], 1)[0])
    print(
        f"{frames} frames of 64x48, {layouts} layouts: {1024 * slope:.1f} KiB a frame, from frame {kept[0, 0]:.0f} on"
    )
    figure(frames, "", "frames")
    figure(layouts, "", "layouts")
    figure(1024 * slope, "KiB", "slope")
    figure(kept[0, 0], "", "slope from")
    shown = rows[:: max(1, len(rows) // 20)]
    for done, size in shown:
        figure(round(size), "MiB", "at frame", done)
    print("MiB at frame:")
    print(json.dumps([(done, round(size)) for done, size in shown]))


def project(seconds: float, size: float, settle: float, views: int) -> None:
    """Print the cost of 10^6 images by number of workers, and the number at which more workers no longer help."""
    found = projection.project(seconds, size, settle, views)
    settling = f"{settle:g} s of settling over {views} views"
    print(f"a frame takes a worker {found.each:.2f} s ({settling}) and {size / 1e6:.2f} MB")
    print("workers  images/s    days  worker-hours   TB")
    for row in found.rows:
        mark = " saturated" if row.saturated else ""
        print(f"{row.workers:7d}  {row.speed:8.2f}  {row.days:6.2f}  {row.hours:12.0f}  {row.terabytes:.2f}{mark}")
    print(f"one writer saturates at {found.limit:.0f} images/s, {found.most:.0f} workers; shards have a writer each")


def main() -> None:
    """Run one measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("workers", "scene", "memory", "project"))
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--frames", type=int)
    parser.add_argument("--scene", type=Path, default=WORKCELL)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--bytes", type=float)
    parser.add_argument("--settle", type=float)
    parser.add_argument("--views", type=int)
    options = parser.parse_args()
    if options.what == "project":
        known = {name: value for name, (value, _) in read_results()["projection"]["figures"].items()}
        project(
            options.seconds or known["rendering"] + known["writing"],
            options.bytes or 1e6 * known["megabytes"],
            options.settle or known["settle"],
            options.views or known["views"],
        )
        return
    with recording("scale.growth", parser, options):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Run the measurements that take time."""
    if options.what == "workers":
        measure_workers(options.scene, options.workers, options.frames or 12, options.size)
    elif options.what == "scene":
        measure_scene(options.frames or 6, options.size)
    else:
        measure_memory(options.frames or 2000, options.views or 50)


if __name__ == "__main__":
    main()
