"""Cost of the first run on a new machine, which compiles and caches everything.

    python -m benchmarks.scale.first_run [--frames 4] [--size 640x360]

``mitsplat render`` renders the default scene twice, with an empty home and empty caches; the second run uses the caches
of the first one. CPU seconds are those of all threads.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.record import ROOT, figure, recording


def main() -> None:
    """Print the time of both runs, and the files on the disk."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--size", default="640x360")
    options = parser.parse_args()
    with recording("scale.first_run", parser, options), tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        caches = {"HOME": folder, "XDG_CACHE_HOME": f"{folder}/cache", "WARP_CACHE_PATH": f"{folder}/cache/warp"}
        for name in ("first", "second"):
            command = [sys.executable, "-c", "from mitsplat.cli import main; main()", "render"]
            command += [
                "scenes/workcell.yaml",
                "-o",
                f"{folder}/{name}",
                "-n",
                str(options.frames),
                "--size",
                options.size,
            ]
            before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            subprocess.run(command, cwd=ROOT, env={**os.environ, **caches}, check=True, stdout=subprocess.DEVNULL)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            wall = time.perf_counter() - start
            size = sum(path.stat().st_size for path in home.rglob("*") if path.is_file()) / 2**30
            for value, unit, what in ((cpu, "s", "cpu"), (wall, "s", "seconds"), (size, "GiB", "disk")):
                figure(value, unit, name, what)
            print(f"{name} run: {cpu:.0f} CPU s, {wall:.0f} s, {size:.2f} GiB on the disk after it", flush=True)


if __name__ == "__main__":
    main()
