"""Minimum number of Dr.Jit's threads."""

from __future__ import annotations

import drjit as dr

MIN_THREADS = 2
"""With one thread, as on one core, Mitsuba 3.9 waits forever when it reads or writes an OpenEXR file."""


def ensure_threads(count: int | None = None) -> None:
    """Set the number of Dr.Jit's threads to ``count``, by default the current one, and at least to MIN_THREADS."""
    wanted = max(count or dr.thread_count(), MIN_THREADS)
    if wanted != dr.thread_count():
        dr.set_thread_count(wanted)
