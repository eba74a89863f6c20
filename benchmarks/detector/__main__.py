"""Runs all arms and seeds of the detector experiment in parallel, within a time limit.

    python -m benchmarks.detector WORK --weights coco.pt [--plan workshop.yaml] [--arms real synthetic] [--seeds 0 1 2]
        [--devices cuda:0 cuda:1] [--jobs 4] [--render-devices cpu] [--renders 2] [--minutes 20]
        [--hope ../shared/data/hope]

Whole datasets are rendered first, on all rendering devices. A changed scene is rendered after the unchanged one with
the same layouts, in parallel with trainings; on the CPU, renderings only use the time left by data loaders of
trainings. An arm is trained once its datasets are complete. Arms are trained in the order of their names on the command
line, all of the first seed before the second, and the folds of one arm in parallel. Recorded results are not repeated,
and interrupted runs are resumed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.detector.experiment import PLAN, VIEWS, folds_of, read_arms, result_of, scenes_of, write_scene
from benchmarks.record import read_recorded, refusal
from mitsplat.runtime.cores import usable_cores

IMAGES = 32
"""Least number of images per process: reading the assets takes as long as rendering some of them."""


def main() -> None:
    """Render, train and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--plan", type=Path, default=PLAN)
    parser.add_argument("--arms", nargs="*", help="names of arms; default: all of the plan, in its order")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--devices", nargs="+", default=["cuda:0"])
    parser.add_argument("--render-devices", nargs="+", help="rendering devices, such as cpu; default: --devices")
    parser.add_argument("--jobs", type=int, default=4, help="parallel trainings per device")
    parser.add_argument("--workers", type=int, help="data loaders per training; default: all cores are shared")
    parser.add_argument("--renders", type=int, default=1, help="parallel renderings per device")
    parser.add_argument("--render-workers", type=int, help="maximum number of processes per rendering; default: cores")
    parser.add_argument("--minutes", type=float, default=1e9, help="time limit, after which all jobs are stopped")
    parser.add_argument("--weights", type=Path, required=True, help="initial weights of arms without random weights")
    parser.add_argument("--hope", type=Path, default=Path("../shared/data/hope"), help="folder of the scans")
    options = parser.parse_args()
    options.render_devices = options.render_devices or options.devices
    options.workers = options.workers or max(1, usable_cores() // (options.jobs * len(options.devices)))
    options.render_workers = options.render_workers or usable_cores()
    plan = read_arms(options.plan)
    arms = options.arms or list(plan["arms"])
    if refused := refusal():
        sys.exit(refused)
    recorded = read_recorded()
    todo = [(arm, seed) for seed in options.seeds for arm in arms if result_of(arm, seed, options.plan) not in recorded]
    free = {"render": options.render_devices * options.renders, "train": options.devices * options.jobs}
    run_jobs(all_jobs(todo, plan, options), free, options)


@dataclass(frozen=True)
class Job:
    """A command.

    Attributes:
        name: Name of its log.
        kind: Kind of job, with a limit on the number per device.
        words: The command without the device.
        after: Names of jobs that must have succeeded.
        behind: Names of jobs that must have ended.
        hides: True if all other GPUs are hidden from it, instead of an argument with the GPU's number.
        everywhere: True if it uses all GPUs.
    """

    name: str
    kind: str
    words: Sequence[str]
    after: Sequence[str] = ()
    behind: Sequence[str] = ()
    hides: bool = False
    everywhere: bool = False


def all_jobs(todo: Sequence[tuple[str, int]], plan: Mapping[str, Any], options: argparse.Namespace) -> list[Job]:
    """Return renderings and trainings in order; all wait for the jobs that use all GPUs."""
    jobs = [*renders(todo, plan, options), *trainings(todo, plan, options)]
    whole = [job.name for job in jobs if job.everywhere]
    return [job if job.everywhere else replace(job, behind=whole) for job in jobs]


def renders(todo: Sequence[tuple[str, int]], plan: Mapping[str, Any], options: argparse.Namespace) -> Iterator[Job]:
    """Return the datasets of the arms, unchanged scenes first; whole ones use all GPUs."""
    wanted: dict[str, list[Mapping[str, Any]]] = {}
    for arm, _ in todo:
        for scene in scenes_of(plan["arms"][arm]):
            wanted.setdefault(scene, []).append(plan["arms"][arm])
    for scene in sorted(wanted, key=lambda scene: "+" in scene):
        unchanged, _, change = scene.partition("+")
        frames = None
        if all("first" in one for one in wanted[scene]):
            frames = max(one["first"] * VIEWS // one.get("views", VIEWS) for one in wanted[scene])
        everywhere = False
        if module := plan.get("rendered_by", {}).get(change):
            words = [sys.executable, "-m", f"benchmarks.detector.{module}", str(options.work), scene]
            words += ["--hope", str(options.hope)] if module == "meshes" else []
        else:
            workers = options.render_workers if frames is None else max(1, frames // IMAGES)
            words = [sys.executable, "-c", "from mitsplat.cli import main; main()", "render", "--resume"]
            words += [str(write_scene(options.work, scene, options.plan))]
            words += ["-o", str(options.work / "data" / scene)]
            words += ["--workers", str(min(options.render_workers, workers))]
            words += [] if frames is None else ["--frames", str(frames)]
            everywhere = frames is None and len(options.render_devices) > 1
        after = [f"render-{unchanged}"] if change and unchanged in wanted else []
        yield Job(f"render-{scene}", "render", words, after, hides=not everywhere, everywhere=everywhere)


def trainings(todo: Sequence[tuple[str, int]], plan: Mapping[str, Any], options: argparse.Namespace) -> Iterator[Job]:
    """Return the trainings of arms for each of their folds, and the evaluation of all folds."""
    for arm, seed in todo:
        words = [sys.executable, "-m", "benchmarks.detector.experiment", str(options.work), arm, str(seed)]
        words += ["--plan", str(options.plan), "--workers", str(options.workers)]
        words += ["--weights", str(options.weights)]
        after = [f"render-{scene}" for scene in scenes_of(plan["arms"][arm])]
        folds = [
            Job(f"{arm}-{seed}-{fold}", "train", [*words, "--fold", str(fold)], after)
            for fold in range(len(folds_of(plan, arm)))
        ]
        yield from folds
        yield Job(f"{arm}-{seed}", "train", words, [job.name for job in folds])


def run_jobs(jobs: Sequence[Job], free: Mapping[str, list[str]], options: argparse.Namespace) -> None:
    """Run the jobs that are ready, in order, on devices free for their kind, until all have ended or time is up."""
    begun = time.monotonic()
    ends = begun + 60 * options.minutes
    logs = options.work / "logs"
    logs.mkdir(parents=True, exist_ok=True)

    def run(job: Job, device: str) -> tuple[Job, str, bool]:
        kind, _, number = device.partition(":")
        environment = os.environ | ({"CUDA_VISIBLE_DEVICES": number} if number and job.hides else {})
        words = [*job.words, "--device", "cuda:all" if job.everywhere else kind if job.hides else device]
        if kind == "cpu" and job.kind == "render":
            words = ["nice", "-n", "19", *words]
        log = logs / f"{job.name}.log"
        with log.open("w") as file:
            limit = max(ends - time.monotonic(), 1)
            try:
                status = subprocess.run(words, stdout=file, stderr=file, timeout=limit, env=environment).returncode
            except subprocess.TimeoutExpired:
                status = -1
        last = (log.read_text().strip().splitlines() or [""])[-1]
        print(
            f"{(time.monotonic() - begun) / 60:5.1f} min  {job.name}: {f'status {status}: ' if status else ''}{last}",
            flush=True,
        )
        return job, device, status == 0

    left, running, over, well = list(jobs), set[Future[tuple[Job, str, bool]]](), set[str](), set[str]()
    with ThreadPoolExecutor(sum(map(len, free.values())) or 1) as pool:
        while running or left:
            for job in list(left):
                ready = well.issuperset(job.after) and over.issuperset(job.behind)
                if time.monotonic() < ends and free[job.kind] and ready:
                    left.remove(job)
                    running.add(pool.submit(run, job, free[job.kind].pop(0)))
            if not running:
                names = ", ".join(job.name for job in left)
                print(f"not run because of the time limit or missing inputs: {names}", flush=True)
                break
            ended, running = wait(running, return_when=FIRST_COMPLETED)
            for job, device, is_well in (future.result() for future in ended):
                free[job.kind].append(device)
                over.add(job.name)
                if is_well:
                    well.add(job.name)


if __name__ == "__main__":
    main()
