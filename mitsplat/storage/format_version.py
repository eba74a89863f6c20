"""Versions of the file formats that later versions of mitsplat read.

Such a file stores its version as ``format_version``; the default is 1. A version increases when an earlier mitsplat
would misread the file. ``docs/compatibility.md`` states which versions are readable.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.version import __version__

FORMAT_VERSION = "format_version"
"""Key of the version."""

FORMAT_VERSIONS = {"asset.yaml": 2, "capture.json": 1, "dataset.json": 1, "fit.json": 1}
"""Newest version by file, which is the version written. That of ``dataset.json`` covers the whole dataset."""


def check_format_version(stored: object, newest: int, place: str | Path) -> None:
    """Refuse files of a newer format version.

    Args:
        stored: Content of the file. A value that is not a mapping is not checked here, but by its reader.
        newest: Newest readable version.
        place: File, and its line if known, for the beginning of the error.

    Raises:
        InputError: If the version is newer, or is not a positive whole number.
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
            f"(got {found}): update mitsplat, or create the file again with this version"
        )
