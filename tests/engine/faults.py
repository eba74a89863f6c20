"""Renderers that fail. Workers import this module, which imports no test so that they start fast."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from tests.synthetic import render


def slow(seconds, stop, scene, index, *, layout):
    """Draw a frame after a delay.

    Block once the folder in ``stop`` holds the given number of frames, because the process that sends the signal may be
    late.
    """
    if stop is not None and lines(Path(stop[0])) >= stop[1]:
        time.sleep(3600)
    time.sleep(seconds)
    return render(scene, index, layout=layout)


def lines(out):
    path = out / "manifest.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


@dataclass(frozen=True)
class KilledOnce:
    """Renderer whose process is killed at one frame, as by the kernel when memory runs out."""

    folder: Path
    index: int

    def __call__(self, scene, index, *, layout):
        mark = self.folder / "killed"
        if index == self.index and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return render(scene, index, layout=layout)


@dataclass(frozen=True)
class TooLarge:
    """Renderer that runs out of memory at one frame."""

    index: int

    def __call__(self, scene, index, *, layout):
        if index == self.index:
            raise RuntimeError("jit_malloc(): out of memory! Could not allocate 9 GiB of device memory.")
        return render(scene, index, layout=layout)
