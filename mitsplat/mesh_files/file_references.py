"""Files that mesh files name: textures, buffers and material files in the folder of the mesh."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path, PurePosixPath

from mitsplat.errors import InputError
from mitsplat.storage.files import is_inside, resolve_inside

_DRIVE = re.compile(r"[A-Za-z]:[\\/]")


def find_reference(source: Path, name: str, kind: str, *, folder: Path | None = None) -> Path:
    """Return the file that ``source`` names.

    A backslash separates folders, and the letter case may differ, as on Windows. Of a path with a drive letter only the
    file name is used.

    Args:
        source: The file that holds the name. The name is relative to its folder.
        name: The name.
        kind: The kind of the named file, for the message.
        folder: Folder in which the file must lie; by default that of ``source``.

    Raises:
        InputError: If the file is missing or outside of the folder.
    """
    base = source.parent.absolute()
    folder = base if folder is None else folder.absolute()
    plain = name.strip("\"'").replace("\\", "/")
    if _DRIVE.match(name):
        plain = PurePosixPath(plain).name
    for spelling in dict.fromkeys((name, plain)):
        with suppress(InputError):
            return resolve_inside(folder, str(base / spelling))
    found = _in_other_case(base, plain)
    if found is not None and is_inside(folder, str(found)):
        return found
    fault = "is missing" if is_inside(folder, str(base / plain)) else "is outside of its folder"
    remedy = "" if kind == "buffer" else ", or give a colour"
    raise InputError(f"{source}: its {kind} {name} {fault}; put it there{remedy}")


def _in_other_case(folder: Path, name: str) -> Path | None:
    """Return the only file in ``folder`` whose path differs from ``name`` in letter case alone, or None."""
    path = folder
    for part in PurePosixPath(name).parts:
        try:
            alike = [entry for entry in path.iterdir() if entry.name.casefold() == part.casefold()]
        except OSError:
            return None
        if len(alike) != 1:
            return None
        path = alike[0]
    return path if path.is_file() else None
