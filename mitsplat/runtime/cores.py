"""Number of CPU cores available to this process."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Return the number of cores on which this process may run, for example limited by ``taskset``.

    More threads than these cores only increase memory use.
    """
    return len(os.sched_getaffinity(0))
