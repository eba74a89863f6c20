"""How long work tells of itself."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int, str], None]
"""Told how many steps are done, of how many, and in a few words what is being done."""

Note = Callable[[str], None]
"""Told in a few words what takes long."""
