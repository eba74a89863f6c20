"""Memory of worker processes, compared with the budget that determines their number.

    python -m benchmarks.scale.workers workers [--gaussians 2e6] [--size 160x120] [--workers 1 2 3]
    python -m benchmarks.scale.workers budget

``workers`` adds up the proportional set size (PSS, ``/proc/PID/smaps_rollup``) of all workers while they render; PSS
divides shared memory among the processes. ``budget`` renders scenes that differ in one property at a time, each in its
own process, and compares the peak with :func:`mitsplat.frames.budget.worker_memory`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from benchmarks.record import figure, recording
from benchmarks.scale.faults import ROOT, workers_of
from mitsplat.asset import Asset
from mitsplat.dataset.write import write_dataset
from mitsplat.frames.budget import worker_memory
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.scene.loading.scene_loading import load_scene

MIB = 2**20
WORKCELL = ROOT / "scenes/workcell.yaml"
CASES = {
    "default scene": None,
    "small": {},
    "2 M Gaussians": {"gaussians": 2e6},
    "2 M Gaussians of SH degree 0": {"gaussians": 2e6, "sh": 1},
    "1280x720": {"size": "1280x720"},
    "640x480, 2x2 samples": {"size": "640x480", "samples": 2},
    "50 objects, 640x480": {"objects": 50, "size": "640x480"},
    "2 M Gaussians, 1280x720, 20 objects": {"gaussians": 2e6, "size": "1280x720", "objects": 20},
}


def write_room(
    folder: Path, gaussians: float = 1e4, size: str = "160x120", *, objects: int = 2, samples: int = 1, sh: int = 16
) -> Path:
    """Write a scene file of nuts on a floor of Gaussians that just cover it, with ``sh`` coefficients each."""
    rng, count = np.random.default_rng(0), int(gaussians)
    splats = Splats(
        means=rng.uniform((-1, -1, -0.05), (1, 1, 0), (count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.4, 1.4, (count, 3)) / np.sqrt(count),
        opacities=rng.uniform(0.3, 1, count),
        sh=rng.normal(0, 0.2, (count, sh, 3)),
    )
    room = Asset(name="room", class_name="room", splats=splats, kind="environment", capture_light="scene")
    room.save(folder / "room")
    width, height = map(int, size.split("x"))
    data = {
        "name": "room",
        "environment": "room",
        "objects": [{"asset": f"{ROOT}/scenes/assets/hex_nut_m16", "count": objects}],
        "shapes": [{"name": "table", "box": {"size": [2, 2, 0.1], "position": [0, 0, -0.05]}, "proxy": True}],
        "region": {"min": [-0.3, -0.3, 0.02], "max": [0.3, 0.3, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
        "lights": [{"kind": "area", "position": [0.5, 0, 1]}],
        "rendering": {"samples": samples},
        "output": {"width": width, "height": height, "layouts": 4, "views": 3},
    }
    YAML(typ="safe", pure=True).dump(data, folder / "scene.yaml")
    return folder / "scene.yaml"


def of_process(process: int | str, file: str, key: str) -> int:
    """Return a size from a file of ``/proc`` [bytes]."""
    lines = Path(f"/proc/{process}/{file}").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:")) * 1024


def measure_workers(counts: list[int], **options: float | str) -> None:
    """Measure the PSS of all workers together, and the increase per worker."""
    print(f"{options}: workers, PSS of all of them [MiB], of the driver [MiB]")
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(write_room(Path(folder), **options), allow_outside=True)  # type: ignore[arg-type]
        largest = 0
        for count in counts:
            sizes: list[tuple[int, int]] = []

            def hear(done: int, total: int, text: str) -> None:
                workers = workers_of(multiprocessing.current_process().pid or 0)
                if text.startswith("frame ") and done >= total // 2:
                    found = [of_process(worker, "smaps_rollup", "Pss") for worker in workers]
                    sizes.append((sum(found), of_process("self", "smaps_rollup", "Pss")))  # noqa: B023

            write_dataset(scene, Path(folder) / f"out{count}", workers=count, progress=hear)
            before, (largest, driver) = largest, max(sizes)
            figure((largest - before) / MIB, "MiB", f"{count} workers", "added")
            figure(largest / MIB, "MiB", f"{count} workers", "pss")
            figure(driver / MIB, "MiB", f"{count} workers", "driver")
            print(f"{count:3d} {largest / MIB:8.0f} {driver / MIB:8.0f}", flush=True)


def measure_budget() -> None:
    """Compare the peak memory of a process that renders frames with the budget."""
    print("peak [MiB]  budget [MiB]")
    for name, options in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            path = write_room(Path(folder), **options) if options is not None else WORKCELL  # type: ignore[arg-type]
            command = [sys.executable, "-m", "benchmarks.scale.workers", "frames", "--scene", str(path)]
            output = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
        peak, budget = map(float, output.split())
        figure(peak, "MiB", name, "peak")
        figure(budget, "MiB", name, "budget")
        print(f"{output.strip()}  {name}", flush=True)


def make_frames(path: Path) -> None:
    """Render a few frames in this process; print its peak and its budget."""
    scene = load_scene(path, allow_outside=True)
    with tempfile.TemporaryDirectory() as folder:
        write_dataset(scene, Path(folder) / "out", frames=3)
    need = worker_memory(scene)
    print(f"{of_process('self', 'status', 'VmHWM') / MIB:10.0f}  {(need.own + need.shared) / MIB:12.0f}")


def main() -> None:
    """Run one measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("workers", "budget", "frames"))
    parser.add_argument("--gaussians", type=float, default=2e6)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--scene", type=Path)
    options = parser.parse_args()
    if options.what == "frames":
        make_frames(options.scene)
        return
    with recording("scale.workers", parser, options):
        if options.what == "workers":
            measure_workers(options.workers, gaussians=options.gaussians, size=options.size)
        else:
            measure_budget()


if __name__ == "__main__":
    main()
