"""Files that are never half written."""

from __future__ import annotations

import errno
import os
import shutil
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from PIL import Image

from mitsplat.content_hash import file_hash
from mitsplat.errors import FULL, InputError, MissingResourceError

Record = dict[str, Any]
"""The line of one frame in ``manifest.jsonl``."""

SPLITS = ("train", "val", "test")
"""A dataset has the last one if its scene asks for it."""


def splits_of(output: Mapping[str, Any]) -> tuple[str, ...]:
    """Splits of a dataset whose scene says this as ``output``."""
    return SPLITS if output.get("test") else SPLITS[:2]


IMAGE_ERRORS = (OSError, SyntaxError, ValueError, TypeError, struct.error, Image.DecompressionBombError)
"""What Pillow raises on damaged images, and on those of more pixels than a file should hold."""

MESH_ERRORS = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, AssertionError, RuntimeError),
    *(MemoryError, EOFError, ImportError, NameError, struct.error),
)
"""What trimesh's readers raise on damaged files; ImportError where they guess at the encoding of binary rubbish,
NameError where a branch that rubbish does not take sets a variable."""


def write_file(path: Path, write: Callable[[Path], object]) -> str:
    """Make a file by ``write(temporary path)``, then move it to ``path`` at once and for good; its folder is made.

    Returns:
        The SHA-256 of the content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write(temporary)
        with temporary.open("rb") as file:
            digest = file_hash(file)
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        with suppress(OSError):  # a disk that cannot be written
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    return digest


class GrowingFile:
    """A text file that is written bit by bit under a temporary name, and gets its own at once and for good.

    Args:
        path: The file; its folder is made.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._temporary = path, path.with_name(f".{path.name}.{os.getpid()}.part")
        self._file = self._temporary.open("w+b", buffering=1 << 16)
        self._named = False

    def write(self, text: str) -> None:
        """Add UTF-8 text."""
        self._file.write(text.encode())

    def take(self, other: GrowingFile) -> None:
        """Add what another one holds, which is given up."""
        other._file.seek(0)
        shutil.copyfileobj(other._file, self._file, 1 << 20)
        other.discard()

    def keep(self) -> None:
        """Give the file its name; it is on disk then."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self.close()
        self.name()

    def close(self) -> None:
        """Write no more."""
        self._file.close()

    def sync(self) -> None:
        """Wait until a closed file is on disk."""
        with self._temporary.open("rb") as file:
            os.fsync(file.fileno())

    def name(self) -> None:
        """Give a closed file its name; it must be on disk."""
        self._temporary.replace(self._path)
        self._named = True

    def discard(self) -> None:
        """Remove what was written, unless it has its name."""
        self._file.close()
        if not self._named:
            self._temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> str:
    """Write UTF-8 text by :func:`write_file`."""
    return write_file(path, lambda temporary: temporary.write_bytes(text.encode()))


def files_below(folder: Path, *, but: Path | None = None) -> list[Path]:
    """Files anywhere in a folder, and in folders that it links to, each of them once; not in ``but``; by name."""
    found, seen = list[Path](), set[str]() if but is None else {os.path.realpath(but)}
    for place, folders, files in os.walk(folder, followlinks=True):
        seen.add(os.path.realpath(place))
        folders[:] = [name for name in folders if os.path.realpath(Path(place, name)) not in seen]
        found += [Path(place, name) for name in files]
    return sorted(found)


def is_inside(folder: Path, name: str) -> bool:
    """Whether a path, relative to ``folder`` or absolute, is in it also after links and ``..`` are followed."""
    try:
        return (folder / name).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # too long, a zero byte, a loop of links
        return False


def file_inside(folder: Path, name: str) -> Path:
    """The file of this name, which must be in ``folder`` also after links and ``..`` are followed.

    Raises:
        InputError: With the rule alone, if it is outside or missing: the caller knows where the name is from.
    """
    if not is_inside(folder, name):
        raise InputError(f"must be a file inside {folder} (got {name})")
    path = folder / name
    try:
        found = path.is_file()
    except OSError:  # a name that no file can have
        found = False
    if not found:
        raise InputError(f"no such file (got {name})")
    return path


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Make the system's errors of those of a library, which puts their words, but not their numbers, into what it says.

    Raises:
        OSError: For any ``RuntimeError``.
    """
    try:
        yield
    except RuntimeError as error:
        number = next((number for number in FULL if os.strerror(number) in str(error)), errno.EIO)
        raise OSError(number, os.strerror(number), str(path)) from error


@contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Tell what prevents writing into a folder in one sentence.

    Raises:
        MissingResourceError: If there is no room.
        InputError: If something else is wrong with a file.
    """
    try:
        yield
    except OSError as error:
        place = error.filename or folder
        if error.errno in FULL:
            raise MissingResourceError(
                f"{place}: {error.strerror}: make room and run again; what is finished is kept"
            ) from error
        raise InputError(f"{place}: cannot be written or read ({error.strerror or error})") from error


def copied(source: Path, target: Path) -> Path:
    """``target``, made a copy of ``source`` unless it is that already."""
    if not (target.exists() and target.samefile(source)):
        write_file(target, lambda temporary: shutil.copyfile(source, temporary))
    return target


def link_file(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
