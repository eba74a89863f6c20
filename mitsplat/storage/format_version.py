"""Versions of the files that a later mitsplat reads back.

Such a file states its version as ``format_version``; one that states none is of version 1. A version goes up when an
earlier mitsplat would misread the file. What reads what is told in ``docs/compatibility.md``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.version import __version__

FORMAT_VERSION = "format_version"
"""The key that states it."""

FORMAT_VERSIONS = {"asset.yaml": 1, "capture.json": 1, "dataset.json": 1, "fit.json": 1}
"""Newest version by file, which is the one that is written. That of ``dataset.json`` is of the whole dataset."""


def check_format_version(stored: object, newest: int, place: str | Path) -> None:
    """Refuse what only a later mitsplat understands.

    Args:
        stored: What the file holds; anything but a mapping is left to what reads it.
        newest: The newest version that is read.
        place: The file, and its line if known, with which the error begins.

    Raises:
        InputError: If the file states a newer version, or none that could be one.
    """
    if not isinstance(stored, Mapping):
        return
    found = stored.get(FORMAT_VERSION, 1)
    if not isinstance(found, int) or isinstance(found, bool) or found < 1:
        shown = json.dumps(found, default=str)
        raise InputError(f"{place}: {FORMAT_VERSION} must be a whole number of at least 1 (got {shown})")
    if found > newest:
        raise InputError(
            f"{place}: {FORMAT_VERSION} must be at most {newest}, the newest that mitsplat {__version__} reads "
            f"(got {found}): update mitsplat, or make it anew with this one"
        )
