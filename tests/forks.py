"""Processes that start fast: forks of a process that has imported packages that mitsplat uses, but not Mitsuba.

Such a fork behaves like a new process: its own code imports Mitsuba and the modules of mitsplat, and sets up a variant
and caches.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

PACKAGES = """
import mitsplat
import cv2, mujoco, newton, numpy, PIL.Image, pydantic, ruamel.yaml, scipy.ndimage, scipy.optimize
import scipy.spatial, skimage.measure, trimesh, typer
"""
"""Imports of a process that forks. Mitsuba starts a thread, so that its import before a fork hangs its end."""

SERVER = f"""
import gc, json, os, signal, sys
sys.modules["pxr"] = None  # newton imports OpenUSD if it is installed, which starts threads
{PACKAGES}
del sys.modules["pxr"]
import mitsplat.cli, mitsplat.labels.labels, mitsplat.scene.planning.frame_plan
gc.freeze()
for line in sys.stdin:
    code, arguments, folder, variables, files = json.loads(line)
    child = os.fork()
    if not child:
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
else:
    os._exit(0)
signal.alarm(600)
for number, file in enumerate(files):
    os.dup2(os.open(file, os.O_RDWR | os.O_CREAT), number)
os.chdir(folder)
os.environ.update(variables)
sys.argv[1:] = arguments
exec(compile(code, "<string>", "exec"), {{"__name__": "__main__"}})
"""
"""Program of the process that forks. A fork runs its code at the top level, and ends like any process."""

MITSPLAT = "from mitsplat.cli import main\nmain()"
"""Code of the command ``mitsplat``."""


class Forks:
    """Process that forks. It starts at the first use, with the environment of that time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def run(self, code: str, *arguments: object, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run code like ``python -c CODE ARGUMENTS`` in a folder, with further environment variables."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        words = [str(word) for word in arguments]
        with TemporaryDirectory() as files:
            out, err = Path(files, "out"), Path(files, "err")
            job = code, words, str(folder), variables, [os.devnull, str(out), str(err)]
            self._process.stdin.write(json.dumps(job) + "\n")
            self._process.stdin.flush()
            status = int(self._process.stdout.readline())
            return subprocess.CompletedProcess([code, *words], status, out.read_text(), err.read_text())

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.communicate()
