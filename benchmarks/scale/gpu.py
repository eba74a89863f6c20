"""Labelled images per second of a GPU, including files on the disk, and their equality with the CPU's.

    python -m benchmarks.scale.gpu [--device cuda:all] [--frames 600] [--workers 14] [--size 1280x720]
                                   [--compare 12] [--unsettled] [--turns] [--out FOLDER]

Layouts are settled first, on all cores, unless ``--unsettled`` includes them in the measurement; layouts in mitsplat's
cache are used. Then ``mitsplat render`` writes the default scene in YOLO and COCO. The rate excludes start and end: it
is the median of eight equal parts of the middle half of the frames. ``--turns`` disables NVIDIA's Multi-Process
Service. GPU utilisation is measured by ``nvidia-smi``. Finally the dataset is audited, and some frames are rendered on
both devices as PNG with their ids.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
from ruamel.yaml import YAML

from benchmarks.record import ROOT, figure, recording
from mitsplat.audit.audit import audit_dataset
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.physics.settle import settle_layouts
from mitsplat.scene.loading.scene_loading import load_scene

WORKCELL = ROOT / "scenes/workcell.yaml"
PARTS = 8
"""Number of parts of the middle half of the frames, whose median rate is recorded."""


def write_scene(folder: Path, frames: int, size: str, **output: object) -> Path:
    """Write the default scene with as many layouts as the frames need."""
    data = YAML(typ="safe", pure=True).load(WORKCELL)
    width, height = map(int, size.split("x"))
    layouts = -(-frames // data["output"]["views"])
    data["output"] |= {"width": width, "height": height, "layouts": layouts, **output}
    for entry in data["objects"]:
        entry["pool"] = str(WORKCELL.parent / entry["pool"])
    data["environment"] = str(WORKCELL.parent / data["environment"])
    path = folder / "workcell.yaml"
    folder.mkdir(parents=True, exist_ok=True)
    YAML(typ="safe", pure=True).dump(data, path)
    return path


def settle(scene: Path) -> None:
    """Settle all layouts into the cache."""
    loaded, start = load_scene(scene, allow_outside=True), time.perf_counter()
    count = sum(1 for _ in settle_layouts(loaded, range(loaded.spec.output.layouts), workers=os.cpu_count() or 1))
    seconds = time.perf_counter() - start
    figure(seconds, "s", "settle", "seconds")
    print(f"{count} layouts settled or found in {seconds:.1f} s", flush=True)


def render(
    scene: Path, out: Path, frames: int, device: str, workers: int | None, turns: bool = False
) -> list[tuple[float, int]]:
    """Run ``mitsplat render``; return numbers of finished frames with their times [s]."""
    start_up = "import mitsplat.engine.mps as mps; mps.CONTROL = 'nothing'; " if turns else ""
    command = [sys.executable, "-c", f"{start_up}from mitsplat.cli import main; main()", "render", str(scene)]
    command += ["-o", str(out), "-n", str(frames), "--device", device, "--allow-outside"]
    if workers is not None:
        command += ["--workers", str(workers)]
    finished, timings, seen = 0, out / "timings.jsonl", []
    with tempfile.TemporaryFile("w+") as output:
        start = time.monotonic()
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
        seen.append((start, 0))
        while True:
            running = process.poll() is None
            finished = timings.read_bytes().count(b"\n") if timings.exists() else 0
            if finished != seen[-1][1]:
                seen.append((time.monotonic(), finished))
            if not running:
                break
            time.sleep(0.02)
        seen.append((time.monotonic(), finished))
        if process.returncode or finished != frames:
            output.seek(0)
            raise SystemExit(
                f"{finished} of {frames} frames, exit status {process.returncode}: {output.read()[-4000:]}"
            )
    return seen


def rates(seen: Sequence[tuple[float, int]], frames: int) -> tuple[list[float], float, float]:
    """Return images per second in each part of the middle half of the frames, and its start and end [s]."""
    counts, first = np.unique([count for _, count in seen], return_index=True)
    marks = np.linspace(0.25, 0.75, PARTS + 1) * frames
    at = np.interp(marks, counts, np.array([moment for moment, _ in seen])[first])
    return list(np.diff(marks) / np.diff(at)), float(at[0]), float(at[-1])


@contextmanager
def watched_gpus() -> Iterator[list[tuple[float, int, float, float]]]:
    """Yield time [s], number of the GPU, its utilisation [%] and its memory in use [MiB], as they are reported."""
    samples: list[tuple[float, int, float, float]] = []
    program = shutil.which("nvidia-smi")
    if program is None:
        yield samples
        return
    query = "--query-gpu=index,utilization.gpu,memory.used"
    command = [program, query, "--format=csv,noheader,nounits", "--loop-ms=200"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:

        def listen() -> None:
            for line in process.stdout or ():
                words = line.split(",")
                if all(word.strip().isdigit() for word in words):
                    number, busy, memory = map(int, words)
                    samples.append((time.monotonic(), number, busy, memory))

        thread = Thread(target=listen)
        thread.start()
        try:
            yield samples
        finally:
            process.terminate()
            thread.join()


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Print and record all figures."""
    scene = write_scene(folder / "measured", options.frames, options.size, formats=["yolo", "coco"])
    if not options.unsettled:
        settle(scene)
    out = folder / "measured/out"
    with watched_gpus() as samples:
        seen = render(scene, out, options.frames, options.device, options.workers, options.turns)
    speeds, begin, end = rates(seen, options.frames)
    start, stop = seen[0][0], seen[-1][0]
    first = next(moment for moment, count in seen if count) - start
    figure(statistics.median(speeds), "1/s", "images")
    figure([min(speeds), max(speeds)], "1/s", "images", "parts")
    figure(options.frames / (stop - start), "1/s", "images", "whole run")
    figure(stop - start, "s", "whole run")
    figure(first, "s", "first frame")
    print(f"{statistics.median(speeds):.1f} images/s (parts {min(speeds):.1f} to {max(speeds):.1f}); whole run of "
          f"{options.frames}: {stop - start:.1f} s, first frame after {first:.1f} s", flush=True)  # fmt: skip
    for number in sorted({sample[1] for sample in samples}):
        own = [sample for sample in samples if sample[1] == number]
        busy = [share for moment, _, share, _ in own if begin <= moment <= end]
        memory = max(used for *_, used in own) - own[0][3]
        if busy:
            figure(statistics.mean(busy), "%", f"gpu {number}", "busy")
        figure(memory, "MiB", f"gpu {number}", "memory")
        print(f"GPU {number}: busy {statistics.mean(busy) if busy else float('nan'):.0f} % of {len(busy)} samples, "
              f"{memory:.0f} MiB at most beside what was in use before", flush=True)  # fmt: skip
    tell_stages(out)
    if options.compare:
        compare(options, folder)
    start = time.perf_counter()
    audit = audit_dataset(out)
    figure(len(audit.violations), "", "audit", "violations")
    print(f"audit of {audit.frames} frames in {time.perf_counter() - start:.0f} s: {len(audit.violations)} violations")
    for file, sentence in audit.violations[:5]:
        print(f"  {file}: {sentence}")


def tell_stages(out: Path) -> None:
    """Print medians of the stages over the middle half of the frames, where workers are warm."""
    rows = [json.loads(line) for line in (out / "timings.jsonl").read_text().splitlines()]
    stages: dict[str, list[float]] = defaultdict(list)
    for row in rows[len(rows) // 4 : 3 * len(rows) // 4]:
        for name, seconds in row.items():
            if name != "index":
                stages[name].append(1e3 * seconds)
    for name, values in stages.items():
        figure(statistics.median(values), "ms", "stage", name)
    medians = ", ".join(f"{name} {statistics.median(values):.1f}" for name, values in stages.items())
    print(f"stages of a frame in its worker [ms]: {medians}", flush=True)


def compare(options: argparse.Namespace, folder: Path) -> None:
    """Return the PSNR of images and the pixels with different ids, on the measured device against the CPU."""
    made = {}
    for name, device in (("gpu", options.device), ("cpu", "cpu")):
        scene = write_scene(folder / name, options.compare, options.size, formats=["yolo", "instances"], image="png")
        made[name] = folder / name / "out"
        render(scene, made[name], options.compare, device, options.workers)

    def errors(pattern: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for path in sorted(made["cpu"].glob(pattern)):
            paths = path, made["gpu"] / path.relative_to(made["cpu"])
            cpu, gpu = (cv2.imread(str(each), cv2.IMREAD_UNCHANGED).astype(np.float64) for each in paths)
            yield cpu, gpu

    decibels = [psnr_of(float(np.mean(np.square((cpu - gpu) / 255)))) for cpu, gpu in errors("images/**/*.png")]
    ids = [float(np.mean(cpu != gpu)) for cpu, gpu in errors("instances/**/*.png")]
    labels = sorted(path.relative_to(made["cpu"]) for path in made["cpu"].glob("labels/**/*.txt"))
    same = [(made["cpu"] / path).read_bytes() == (made["gpu"] / path).read_bytes() for path in labels]
    if not len(decibels) == len(ids) == len(same) == options.compare:
        raise SystemExit(f"{len(decibels)} pictures, {len(ids)} maps, {len(same)} labels of {options.compare} frames")
    figure(min(decibels), "dB", "against cpu", "least psnr")
    figure(100 * max(ids), "%", "against cpu", "most other ids")
    figure(statistics.mean(same), "", "against cpu", "equal labels")
    print(f"against the CPU, {options.compare} frames: PSNR {min(decibels):.1f} dB at least, ids differ in "
          f"{100 * max(ids):.3f} % of the pixels at most, {sum(same)} label files are equal", flush=True)  # fmt: skip


def main() -> None:
    """Measure one run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--compare", type=int, default=12, help="number of frames also rendered on the CPU")
    parser.add_argument("--unsettled", action="store_true", help="settle layouts within the measured run")
    parser.add_argument("--turns", action="store_true", help="without NVIDIA's Multi-Process Service")
    parser.add_argument("--out", type=Path, help="folder of the datasets; default: temporary")
    options = parser.parse_args()
    with recording("scale.gpu", parser, options, ignore=("out", "compare"), gpu=True):
        if options.out:
            measure(options, options.out)
            return
        with tempfile.TemporaryDirectory() as folder:
            measure(options, Path(folder))


if __name__ == "__main__":
    main()
