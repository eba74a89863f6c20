"""Number of workers, chosen by measured speed."""

from __future__ import annotations

import math
from statistics import median

MIN_SPEED_UP = 1.1
"""Minimum speed-up for keeping another worker, if the engine chooses the number of workers."""

_SPEED_WINDOW = 8
"""Frames per worker over which speed is measured."""


class WorkerGrowth:
    """Decision about another worker, from the speeds with n and with n - 1 workers.

    The speed is the number of workers over the median time of a frame. The median ignores frames that take longer
    because they are the first of a layout or compile kernels.
    """

    def __init__(self, max_workers: int) -> None:
        self._max_workers = max_workers
        self._speed = 0.0
        self._count = 0
        self._warm: set[int] = set()
        self._since = 0.0
        self._seconds: list[float] = []

    def decide(self, worker: int, count: int, begin: float, now: float) -> str:
        """Evaluate a frame that one of ``count`` workers began at ``begin`` and has finished.

        Frames that began before every worker had finished its first one are ignored.

        Returns:
            "start", "stop", "stay" or "" (undecided).
        """
        if count != self._count:
            self._count, self._since, self._seconds = count, math.inf, []
        self._warm.add(worker)
        if len(self._warm) < count:
            return ""
        self._since = min(self._since, now)
        if begin >= self._since:
            self._seconds.append(now - begin)
        if len(self._seconds) < _SPEED_WINDOW * count:
            return ""
        speed = count / median(self._seconds)
        if speed < MIN_SPEED_UP * self._speed:
            return "stop"
        self._speed = speed
        return "start" if count < self._max_workers else "stay"
