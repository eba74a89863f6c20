"""Kill real renderings at random times, resume them, and compare every byte with an undisturbed run.

    python -m benchmarks.scale.faults [--kills 50] [--seed 0] [--frames 12] [--synthetic]

Each run has 1 or 2 worker processes, at random. Of three kills (SIGKILL), two hit the whole run and one a worker, whose
frame the run must repeat. Each kill has a new random time, mostly while frames are written, sometimes before.
``--synthetic`` draws frames instead of rendering them (those of ``tests/engine/test_faults.py``): they start and follow
each other faster, so that more kills hit the writing of files.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from benchmarks.record import figure, recording

ROOT = Path(__file__).resolve().parents[2]
SCENE = f"""
name: nuts
objects:
  - {{asset: {ROOT}/scenes/assets/hex_nut_m16, count: [2, 3]}}
shapes:
  - {{name: table, box: {{size: [1, 1, 0.1], position: [0, 0, -0.05]}}, visible: true}}
region: {{min: [-0.1, -0.1, 0.02], max: [0.1, 0.1, 0.1]}}
camera: {{kind: orbit, target: [0, 0, 0], radius: 0.4, height: 0.3}}
lights:
  - {{kind: area, position: [0.5, 0, 1]}}
randomise: {{iso: [100, 800]}}
output: {{width: 64, height: 48, layouts: 3, views: 5, formats: [yolo, coco, exr]}}
"""
"""A small scene, so that most time is spent in the stages to be hit by kills: start, settling, writing."""
FREE = ("timings.jsonl", "runs.jsonl", ".lock")
"""Fields that may differ: times, commands, and the lock's owner."""


def hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file, including partial ones."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in FREE)
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def start(script: list[str], scene: Path, out: Path, frames: int, workers: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, *script, "render", str(scene), "-o", str(out), "-n", str(frames)]
    command += ["--workers", str(workers), "--json", "--allow-outside"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def workers_of(process: int) -> list[int]:
    """Return the worker processes of a run: its children with multiprocessing's mark."""
    found = []
    for text in Path(f"/proc/{process}/task/{process}/children").read_text().split():
        try:
            command = Path("/proc", text, "cmdline").read_bytes()
        except OSError:
            continue
        if b"spawn_main" in command:
            found.append(int(text))
    return found


def lines(out: Path) -> int:
    path = out / "manifest.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def await_moment(process: subprocess.Popen[bytes], out: Path, rng: random.Random) -> bool:
    """Wait for the time of the kill; return False if the run finished before."""
    if rng.random() < 0.2:
        end = time.monotonic() + rng.uniform(0, 6)
    else:
        before, wanted = lines(out), rng.randint(1, 3)
        while process.poll() is None and lines(out) < before + wanted:
            time.sleep(0.005)
        end = time.monotonic() + rng.uniform(0, 0.5)
    while process.poll() is None and time.monotonic() < end:
        time.sleep(0.001)
    return process.poll() is None


def main() -> None:
    """Kill, resume, compare, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--synthetic", action="store_true")
    options = parser.parse_args()
    with recording("scale.faults", parser, options):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Kill until the requested number is reached."""
    rng = random.Random(options.seed)
    counts: Counter[str] = Counter()
    differing: set[str] = set()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        whole, out, scene = (Path(folder) / name for name in ("undisturbed", "out", "scene.yaml"))
        scene.write_text(SCENE)
        script = ["-c", "from mitsplat.cli import main; main()"]
        if options.synthetic:
            sys.path.insert(0, str(ROOT / "tests"))
            from tests.engine.test_faults import CHILD

            (Path(folder) / "child.py").write_text(CHILD.format(tests=str(ROOT / "tests"), seconds=0.02))
            script = [str(Path(folder) / "child.py")]
        if start(script, scene, whole, options.frames, 1).wait():
            sys.exit("the undisturbed run failed")
        expected = hashes(whole)
        while counts["kills"] < options.kills or out.exists():
            process = start(script, scene, out, options.frames, rng.choice((1, 2)))
            counts["runs"] += 1
            while counts["kills"] < options.kills and await_moment(process, out, rng):
                workers = workers_of(process.pid) if rng.random() < 1 / 3 else []
                os.kill(rng.choice(workers) if workers else process.pid, signal.SIGKILL)
                counts["kills"] += 1
                print(f"kill {counts['kills']} at line {lines(out)}", file=sys.stderr)
                counts["kills of a worker" if workers else "kills of the run"] += 1
                if not workers:
                    break
            status = process.wait()
            if status == -signal.SIGKILL:
                counts["partial files left"] += len(list(out.rglob(".*.part")))
                manifest = out / "manifest.jsonl"
                counts["torn lines left"] += manifest.exists() and not manifest.read_bytes().endswith((b"\n", b""))
                continue
            counts[f"runs that ended with status {status}"] += 1
            if status:
                sys.exit(f"a run that was not killed ended with status {status}: {dict(counts)}")
            if status == 0:
                counts["datasets finished"] += 1
                found = hashes(out)
                differing |= {file for file in {*found, *expected} if found.get(file) != expected.get(file)}
                shutil.rmtree(out)
    for name in ("kills", "kills of the run", "kills of a worker", "partial files left", "torn lines left"):
        figure(counts[name], "", name)
    figure(counts["datasets finished"], "", "datasets")
    figure(len(expected), "", "files")
    figure(len(differing), "", "differing")
    for name, count in sorted(counts.items()):
        print(f"{name}: {count}")
    print(f"files of a dataset: {len(expected)}; differing after resumption: {len(differing)} {sorted(differing)[:5]}")
    print(f"minutes: {(time.monotonic() - begun) / 60:.1f}; load: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
