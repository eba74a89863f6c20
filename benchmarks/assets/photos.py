"""Time of ``mitsplat asset`` from photographs to an asset, stage by stage, and its verdict.

    python -m benchmarks.assets.photos PHOTOS OUT [--size METRES] [--refine] [--device cuda]
    python -m benchmarks.assets.photos clutter OUT --device cuda    # which also leaves the photographs in OUT
    taskset -c 0,1 python -m benchmarks.assets.photos clutter OUT

PHOTOS is a folder, or ``clutter``: 97 photographs of 12 megapixels of the scene of ``benchmarks.assets.clutter``. These
are path-traced on a GPU if OUT lacks them. The command runs in a new process, and its log gives the stages. CPU seconds
of COLMAP are counted with its last stage, when it ends. With ``--refine``, ``mitsplat mesh --refine`` runs afterwards
and is not part of the time. The exit status is 1 if ``clutter`` takes more time than its threshold: CPU time, or
wall-clock time with a GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

# isort: off
import mitsplat  # noqa: F401, which must come before Dr.Jit

import drjit as dr

# isort: on
from benchmarks.assets.clutter import exposures, room, walk
from benchmarks.assets.judged import tell_wanted
from benchmarks.assets.known import solid, speckled
from benchmarks.assets.photographing import photograph
from benchmarks.record import cpu_seconds, figure, recording
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE
from mitsplat.runtime.device import use_device

WANTED = {"cpu": {"CPU minutes": 30.0}, "cuda": {"minutes": 4.0}}
JUDGED = "photos", "psnr", "psnr_object", "splat_iou", "mesh_iou", "gaussians", "faces"
"""Recorded figures of the verdict."""


def take_photos(args: argparse.Namespace) -> tuple[Path, float]:
    """Return the folder of the clutter's photographs, taken if absent, and the solid's longest edge [m]."""
    photos, marker, mesh = args.out / "photos", args.out / "photos.json", solid()
    made = json.dumps([args.views, args.width, args.samples])
    if not (marker.exists() and marker.read_text() == made):
        shutil.rmtree(photos, ignore_errors=True)
        views, began = walk(args.views, args.width), time.monotonic()
        scene = room() | {"solid": speckled(mesh)}
        gains = exposures(len(views))
        photograph(scene, views, photos, samples=args.samples, noise=0.008, gains=gains, suffix=".jpg")
        print(f"photographs: {time.monotonic() - began:.1f} s", flush=True)
        dr.flush_malloc_cache()  # frees the GPU for the command
        marker.write_text(made)
    return photos, float(mesh.extents.max())


def processor_seconds(process: int) -> float:
    """Return the CPU seconds of a running process and of its ended children."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def run(log: Path, words: Sequence[str | Path]) -> dict[str, tuple[float, float]]:
    """Run a command of ``mitsplat``; return its stages with wall-clock and CPU seconds.

    Raises:
        RuntimeError: If it fails; a missed threshold is no failure.
    """
    began, used = time.monotonic(), cpu_seconds()
    times: list[tuple[str, float, float]] = [("starting", 0.0, 0.0)]
    command = [sys.executable, "-c", "from mitsplat.cli import main; main()", *map(str, words)]
    with log.open("w") as kept, subprocess.Popen(command, stdout=kept, stderr=subprocess.PIPE, text=True) as child:
        for line in child.stderr or ():
            kept.write(line)
            kept.flush()
            print(f"{time.monotonic() - began:8.1f} s  {line}", end="", flush=True)
            told = re.match(r" *\d+ %: ([^:,\n]+)", line)
            if told is not None and told[1] != times[-1][0]:
                times.append((told[1], time.monotonic() - began, processor_seconds(child.pid)))
    if child.returncode not in (0, 4):
        raise RuntimeError(f"mitsplat {words[0]} ended with status {child.returncode}; see {log}")
    times.append(("", time.monotonic() - began, cpu_seconds() - used))
    stages: dict[str, tuple[float, float]] = {}
    for (stage, start, spent), (_, end, all_spent) in pairwise(times):
        wall, cpu = stages.get(stage, (0.0, 0.0))
        stages[stage] = wall + end - start, cpu + all_spent - spent
    return stages


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", help="folder of photographs, or clutter")
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=97, help="number of photographs of clutter")
    parser.add_argument("--width", type=int, default=4000)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--size", type=float, help="longest edge of the object [m]; known for clutter")
    parser.add_argument("--refine", action="store_true", help="refine the mesh as well")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    device = use_device(args.device)
    args.out.mkdir(parents=True, exist_ok=True)
    with recording("assets.photos", parser, args, ignore=("out",), gpu=device.kind == "cuda"):
        missed = measure(args, device.kind)
    sys.exit(missed > 0)


def measure(args: argparse.Namespace, kind: str) -> int:
    """Print and record the figures; return the number of missed thresholds."""
    ours = args.photos == "clutter"
    photos, size = take_photos(args) if ours else (Path(args.photos), args.size)
    asset = args.out / f"asset-{kind}"
    shutil.rmtree(asset, ignore_errors=True)
    words = ["-o", asset, "--device", args.device] + ([] if size is None else ["--size", str(size)])
    stages = run(args.out / f"{kind}.log", ["asset", photos, *words])
    for stage, (wall, cpu) in stages.items():
        print(f"{stage:45} {wall:8.1f} s {cpu:8.1f} CPU s")
        figure(wall, "s", "stages", stage)
        figure(cpu, "s", "cpu", stage)
    minutes, used = (sum(times) / 60 for times in zip(*stages.values(), strict=True))
    figure(minutes, "min", "minutes")
    figure(used, "min", "cpu minutes")
    verdict = json.loads((asset / VERDICT_FILE).read_text())
    for name in JUDGED:
        print(f"{name:45} {verdict[name]}")
        figure(float("nan") if verdict[name] is None else verdict[name], "dB" if "psnr" in name else "", name)
    if args.refine:
        refined = run(args.out / f"{kind}-refined.log", ["mesh", asset / "capture", asset / "fit", *words, "--refine"])
        iou = json.loads((asset / VERDICT_FILE).read_text())["mesh_iou"]
        seconds = sum(cpu for _, cpu in refined.values())
        print(f"{'refined mesh_iou':45} {iou}, in {seconds:.1f} CPU s")
        figure(iou, "", "refined mesh_iou")
        figure(seconds, "s", "cpu", "with refining")
    print(f"{'minutes':45} {minutes:8.2f}\n{'CPU minutes':45} {used:8.2f}")
    found = {"CPU minutes": used, "minutes": minutes}
    return tell_wanted(found, WANTED[kind], ()) if ours else 0


if __name__ == "__main__":
    main()
