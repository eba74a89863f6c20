"""Time of the tutorial ``docs/bin_picking.md``, with an empty home and empty caches.

    python -m benchmarks.scale.tutorial

The commands of the page run in their order, in a folder that holds only the files that the page makes. CPU seconds are
those of all threads.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.record import ROOT, figure, recording

PAGE = ROOT / "docs/bin_picking.md"


def main() -> None:
    """Print and record the time of each command, and of all together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options = parser.parse_args()
    text = PAGE.read_text()
    blocks = {
        name: re.findall(rf"^```{name}\n(.*?)^```", text, re.DOTALL | re.MULTILINE) for name in ("python", "yaml", "sh")
    }
    commands = [shlex.split(line, comments=True) for block in blocks["sh"] for line in block.splitlines()]
    with recording("scale.tutorial", parser, options), tempfile.TemporaryDirectory() as folder:
        caches = {"HOME": folder, "XDG_CACHE_HOME": f"{folder}/cache", "WARP_CACHE_PATH": f"{folder}/cache/warp"}
        desk = Path(folder) / "desk"
        desk.mkdir()
        (desk / "bin.yaml").write_text(blocks["yaml"][0])
        runs = [("files", ["-c", blocks["python"][0]])]
        runs += [(words[1], ["-c", "from mitsplat.cli import main; main()", *words[1:]]) for words in commands]
        total = 0.0
        for name, arguments in runs:
            before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            environment = {**os.environ, **caches}
            subprocess.run([sys.executable, *arguments], cwd=desk, env=environment, check=True)
            after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - start
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            total += cpu
            figure(cpu, "s", name, "cpu")
            figure(wall, "s", name, "seconds")
            print(f"{name}: {cpu:.0f} CPU s, {wall:.0f} s", flush=True)
        figure(total, "s", "all", "cpu")


if __name__ == "__main__":
    main()
