"""How much memory this machine has for workers, and how much they take."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class WorkerMemory:
    """What worker processes take [bytes].

    Attributes:
        own: Each of them.
        shared: All of them together, once.
        gpu: Each of those that compute on a GPU, of its memory.
    """

    own: float
    shared: float = 0.0
    gpu: float = 3.0 * 2**30


TYPICAL = WorkerMemory(4.0 * 2**30)
"""Of work that nothing is known of."""


def unused_memory() -> float:
    """Memory that programs can still have [GiB], within what a container is limited to."""
    free = {"MemAvailable": os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30}
    with suppress(OSError):
        lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
        free |= {words[0].rstrip(":"): int(words[1]) / 2**20 for words in lines}
    with suppress(OSError, ValueError):  # no limit is "max", which is no number
        limit, used = (int((_CGROUP / name).read_text()) for name in ("memory.max", "memory.current"))
        return min(free["MemAvailable"], (limit - used) / 2**30)
    return free["MemAvailable"]
