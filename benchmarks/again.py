"""Repeats recorded benchmarks: runs the commands of results, one after the other.

    python -m benchmarks.again NAME...      # results whose names start with NAME: render.frame
    python -m benchmarks.again --idle       # timings, on an otherwise idle machine
    python -m benchmarks.again --all        # all that run on this machine from a checkout alone
    python -m benchmarks.again ... --list   # lists the commands and their recorded durations

Commands that name CAPTURE, PHOTOS, DATASET, Blender or other input that a checkout lacks, or a GPU, are run by hand. So
is ``python -m scenes.build --out FOLDER``, which without a folder replaces the shipped assets.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

from benchmarks.figures import present_command, read_results
from benchmarks.record import ROOT, refusal

IDLE = (
    "render.frame",
    "render.frame-ten",
    "render.chart-workcell",
    "physics.settle-rate-count_6",
    "physics.settle-share",
)
"""Wall-clock timings, or figures that other programs affect most."""
ELSEWHERE = re.compile(r"\b[A-Z]{3,}\b|\.splat\b|cuda|\.\./shared|--blender|--gausscam")
"""Input that a checkout lacks."""


def command_of(result: Mapping[str, Any]) -> list[str]:
    """Return the command that records a result."""
    program, *words = shlex.split(present_command(result))
    return [sys.executable if program == "python" else program, *words]


def recordable(result: Mapping[str, Any]) -> bool:
    """Return True if a checkout on this machine is enough."""
    command = result["command"]
    own = command.startswith("python -m benchmarks.")
    return own and not ELSEWHERE.search(command) and not result["machine"]["gpu"]


def main() -> None:
    """Run the commands; continue after a failure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--idle", action="store_true")
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    results = {name: result for name, result in read_results().items() if "command" in result}
    for name in options.names:
        if not any(known.startswith(name) for known in results):
            parser.error(f"no result begins with {name}")
    chosen = {
        name: result
        for name, result in results.items()
        if any(name.startswith(given) for given in options.names)
        or (options.idle and name in IDLE)
        or (options.all and recordable(result))
    }
    if not options.list and (refused := refusal()):
        sys.exit(refused)
    failed = []
    for command, seconds in {shlex.join(command_of(one)): one["seconds"] for one in chosen.values()}.items():
        print(f"{command}  ({f'{seconds:.0f} s the last time' if seconds else 'time unknown'})", flush=True)
        if not options.list and subprocess.run(shlex.split(command), cwd=ROOT, check=False).returncode:
            failed.append(command)
    if failed:
        sys.exit("failed: " + "; ".join(failed))
    if not options.list:
        subprocess.run([sys.executable, "-m", "benchmarks.figures"], cwd=ROOT, check=False)


if __name__ == "__main__":
    main()
