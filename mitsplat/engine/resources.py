"""Memory of this machine, and memory requirements of workers."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class WorkerMemory:
    """Memory requirements of worker processes [bytes].

    Attributes:
        own: Memory of each worker.
        shared: Memory that all workers share.
        gpu: GPU memory of each worker that computes on a GPU.
    """

    own: float
    shared: float = 0.0
    gpu: float = 3.0 * 2**30


TYPICAL_MEMORY = WorkerMemory(4.0 * 2**30)
"""Requirements of work without an estimate."""


def unused_memory() -> float:
    """Return the memory available to programs [GiB], within the limit of a container."""
    free = {"MemAvailable": os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30}
    with suppress(OSError):
        lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
        free |= {words[0].rstrip(":"): int(words[1]) / 2**20 for words in lines}
    with suppress(OSError, ValueError):  # an absent limit reads "max", which is not a number
        limit, used = (int((_CGROUP / name).read_text()) for name in ("memory.max", "memory.current"))
        return min(free["MemAvailable"], (limit - used) / 2**30)
    return free["MemAvailable"]
