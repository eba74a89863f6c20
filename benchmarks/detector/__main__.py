"""All arms and seeds of the experiment on detectors, side by side, as far as time allows.

    python -m benchmarks.detector WORK [--arms real synthetic] [--seeds 0 1 2] [--devices cuda:0 cuda:1] [--jobs 4]
        [--minutes 20] [--plan workshop.yaml] [--hope ../shared/data/hope]

Datasets are rendered one after the other, and what learns from one starts when it is there. What was recorded is not
done again; what was interrupted goes on.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

from benchmarks.detector.experiment import PLAN, VIEWS, read_arms, result_of, scenes_of, write_scene
from benchmarks.record import RESULTS


def main() -> None:
    """Render, train, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--plan", type=Path, default=PLAN)
    parser.add_argument("--arms", nargs="*", help="all of the plan, in its order, if absent")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--devices", nargs="+", default=["cuda:0"])
    parser.add_argument("--jobs", type=int, default=4, help="trainings at once on each device")
    parser.add_argument("--workers", type=int, default=4, help="processes of each training that read images")
    parser.add_argument("--render-workers", type=int, default=8)
    parser.add_argument("--render-device", default="auto")
    parser.add_argument("--minutes", type=float, default=1e9, help="after which nothing is begun")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--hope", type=Path, default=Path("../shared/data/hope"), help="where scans are")
    options = parser.parse_args()
    said = read_arms(options.plan)
    arms = said["arms"]
    chosen = options.arms or list(arms)
    ends = time.monotonic() + 60 * options.minutes
    logs = options.work / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    free: Queue[str] = Queue()
    for device in options.devices * options.jobs:
        free.put(device)

    def say(text: str) -> None:
        print(f"{(time.monotonic() - ends) / 60 + options.minutes:5.1f} min  {text}", flush=True)

    def command(name: str, words: list[str]) -> bool:
        with (logs / f"{name}.log").open("w") as log:
            limit = max(ends - time.monotonic(), 1)
            try:
                status = subprocess.run(words, stdout=log, stderr=log, timeout=limit).returncode
            except subprocess.TimeoutExpired:
                status = -1
        last = (logs / f"{name}.log").read_text().strip().splitlines()[-1:] or [""]
        say(f"{name}: {last[0] if status == 0 else f'status {status}: {last[0]}'}")
        return status == 0

    def train(arm: str, seed: int) -> None:
        if (RESULTS / f"{result_of(arm, seed, options.plan)}.json").exists() or time.monotonic() > ends:
            return
        device = free.get()
        try:
            words = [sys.executable, "-m", "benchmarks.detector.experiment", str(options.work), arm, str(seed)]
            words += ["--plan", str(options.plan), "--device", device, "--workers", str(options.workers)]
            command(f"{arm}-{seed}", words + (["--weights", str(options.weights)] if options.weights else []))
        finally:
            free.put(device)

    rendered: set[str] = set()
    with ThreadPoolExecutor(len(options.devices) * options.jobs) as pool:
        for arm in sorted(chosen, key=lambda arm: "scenes" in arms[arm]):
            for scene in scenes_of(arms[arm]):
                if scene in rendered or time.monotonic() > ends:
                    continue
                rendered.add(scene)
                words = ["mitsplat", "render", str(write_scene(options.work, scene, options.plan))]
                words += ["-o", str(options.work / "data" / scene), "--resume"]
                words += ["--workers", str(options.render_workers)]
                learning = [arms[name] for name in chosen if scene in scenes_of(arms[name])]
                if all("first" in one for one in learning):
                    count = max(one["first"] * VIEWS // one.get("views", VIEWS) for one in learning)
                    words += ["--frames", str(count)]
                if module := said.get("rendered_by", {}).get(arms[arm].get("change")):
                    words = [sys.executable, "-m", f"benchmarks.detector.{module}", str(options.work), scene]
                    words += ["--hope", str(options.hope)] if module == "meshes" else []
                command(f"render-{scene}", [*words, "--device", options.render_device])
            for seed in options.seeds:
                pool.submit(train, arm, seed)


main()
