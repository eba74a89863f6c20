"""Lists of image files from a file, a folder, a pattern or a list of names."""

from __future__ import annotations

import fnmatch
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.images.untrusted_images import IMAGE_SUFFIXES
from mitsplat.storage.file_kinds import check_path_encoding

WILDCARDS = frozenset("*?[")
"""Characters that make a name a pattern."""

MAX_ENTRIES = 1_000_000
"""Maximum number of folder entries that a pattern may visit."""
MAX_PARTS = 64
"""Maximum number of parts of a pattern, separated by slashes."""
MAX_LENGTH = 4096
"""Maximum length of a pattern, that of the longest path [characters]."""


def glob_below(folder: Path, pattern: str) -> list[Path]:
    """Return the paths below a folder that match a pattern, sorted by name.

    The pattern has the syntax of :meth:`pathlib.Path.glob`. Each folder is read once, however often ``**`` occurs, so
    the time grows with the number of entries.

    Raises:
        InputError: If the pattern is invalid, or if it must visit more than :data:`MAX_ENTRIES` entries.
    """
    if len(pattern) > MAX_LENGTH:
        raise InputError(
            f"must be a pattern of files or folders of at most {MAX_LENGTH} characters (got {len(pattern)})"
        )
    absolute = Path(pattern).is_absolute()
    parts = [part for part in pattern.split("/") if part not in ("", ".")]
    parts = [part for number, part in enumerate(parts) if part != "**" or parts[number - 1 : number] != ["**"]]
    wrong = next((part for part in parts if "**" in part and part != "**"), None)
    if not parts or wrong or "\0" in pattern or len(parts) > MAX_PARTS:
        rule = f"'**' must be a whole part in {wrong!r}" if wrong else f"of 1 to {MAX_PARTS} parts"
        raise InputError(f"must be a pattern of files or folders ({rule}; got {pattern!r})")
    found = _matches("/" if absolute else str(folder), parts, pattern)
    return sorted(Path(path) for path in found if not pattern.endswith("/") or Path(path).is_dir())


def _matches(root: str, parts: Sequence[str], pattern: str) -> set[str]:
    """Return the paths below a folder that match the parts of a pattern.

    Every folder is visited once, with the numbers of all parts that may match there.
    """
    wild = {i: re.compile(fnmatch.translate(part)).match for i, part in enumerate(parts) if WILDCARDS & set(part)}
    found, num_visited = set[str](), 0
    waiting = [(root, {0})]
    while waiting:
        place, numbers = waiting.pop()
        numbers |= {i + 1 for i in numbers if i < len(parts) and parts[i] == "**"}  # '**' also matches no folder
        if len(parts) in numbers:
            found.add(place)
        below = defaultdict[str, set[int]](set)
        for i in numbers - {len(parts)} - wild.keys():
            if os.path.lexists(path := f"{place}/{parts[i]}") and Path(path).exists():
                below[parts[i]].add(i + 1)
        try:
            entries = os.scandir(place) if numbers & wild.keys() else nullcontext(())
        except OSError:  # not a folder, or not readable
            entries = nullcontext(())
        with entries as inside:
            for entry in inside:
                num_visited += 1
                if num_visited > MAX_ENTRIES:
                    raise InputError(f"must visit at most {MAX_ENTRIES} files and folders (got {pattern!r})")
                for i in numbers & wild.keys():
                    if parts[i] == "**":
                        if entry.is_dir(follow_symlinks=False):
                            below[entry.name].add(i)
                    elif wild[i](entry.name) and (i + 1 == len(parts) or entry.is_dir()):
                        below[entry.name].add(i + 1)
        waiting += [(f"{place.rstrip('/')}/{name}", after) for name, after in below.items()]
    return found


def names_below(folder: Path, pattern: str, paths: Iterable[Path]) -> tuple[str, ...]:
    """Return matched paths as names in the form that a scene file in ``folder`` would use.

    Raises:
        InputError: If a name is not UTF-8.
    """
    absolute = Path(pattern).is_absolute()
    paths = list(paths)
    for path in paths:
        check_path_encoding(path)
    return tuple(path.as_posix() if absolute else path.relative_to(folder).as_posix() for path in paths)


def image_names(folder: Path, images: str | tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the image files, relative to a folder, in order.

    Raises:
        InputError: If there is no image, or if a file does not exist.
    """
    if isinstance(images, tuple):
        names = images
    elif (folder / images).is_file():
        names = (images,)
    else:
        pattern = f"{images.rstrip('/')}/*" if (folder / images).is_dir() else images
        found = glob_below(folder, pattern) if WILDCARDS & set(pattern) else []
        wanted = [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")]
        names = names_below(folder, pattern, wanted)
    if not names:
        raise InputError(f"must name at least one image (got {images!r}, which matches none)")
    for name in names:
        if not (folder / name).is_file():
            raise InputError(f"{folder / name}: no such file")
    return names
