"""Progress callback types."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int, str], None]
"""Callback for progress: steps done, number of steps, short name of the current step."""

Note = Callable[[str], None]
"""Callback that receives a short description of a slow operation."""

TIME_NOTE = "time: "
"""Beginning of the note that estimates the time of a run. It stays visible."""


def discard_note(text: str) -> None:
    """Ignore the description of a slow operation."""
