"""Files that are never half written."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from PIL import Image

from mitsplat.errors import FULL, InputError, MissingResourceError
from mitsplat.storage.content_hash import file_hash

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
        temporary.unlink(missing_ok=True)  # a link of this name would be followed
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
        self._temporary.unlink(missing_ok=True)
        self._file = self._temporary.open("x+b", buffering=1 << 16)
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


def open_in_place(path: Path, mode: str) -> IO[Any]:
    """Open a file that is written where it lies, and is made if the mode says so.

    Raises:
        OSError: If it cannot be opened, or another file would be written with it: it is a link, or has a second name.
    """
    file: IO[Any] = open(path, mode, opener=_open_unlinked)  # noqa: SIM115 - the caller's
    return file


def _open_unlinked(name: str, flags: int) -> int:
    try:
        number = os.open(name, flags & ~os.O_TRUNC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "must not be a link: remove it", str(name)) from error
        raise
    try:
        _check_regular(number, name)
        if os.fstat(number).st_nlink > 1:
            raise OSError(errno.EMLINK, "must not have a second name (a hard link): remove it, or copy it", str(name))
        if flags & os.O_TRUNC:
            os.ftruncate(number, 0)
    except BaseException:
        os.close(number)
        raise
    return number


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file to read, through links too; others, such as a pipe, could be waited for without end.

    Raises:
        OSError: If it is none, or cannot be opened.
    """
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _check_regular(number, path)
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def _check_regular(number: int, path: str | Path) -> None:
    mode = os.fstat(number).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "must be a regular file", str(path))


MOST_JSON = 1 << 28
"""Largest JSON file that is read as a whole [bytes]."""
DEEPEST_JSON = 64
"""Most levels of JSON; what mitsplat and others write has about ten."""
_NO_BRACKETS = bytes(set(range(256)) - set(b'[]{}"'))


def read_json(path: Path, most: int = MOST_JSON) -> Any:
    """The value of a JSON file that need not be trusted: a regular one of ``most`` bytes, bounded in depth.

    Raises:
        OSError: If it cannot be read.
        ValueError: If it is too large, too deep, or no JSON.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"must have at most {most} bytes (got {size})")
        return parse_json(file.read())


def parse_json(data: bytes) -> Any:
    """The value of JSON as UTF-8.

    Raises:
        ValueError: If it has more than :data:`DEEPEST_JSON` levels, or is no JSON.
    """
    text = data.decode("utf-8-sig")
    if data.count(b"[") + data.count(b"{") > DEEPEST_JSON:
        bare = re.sub(rb"\\.", b"", data, flags=re.DOTALL) if b"\\" in data else data
        brackets = re.sub(rb'"[^"]*"', b"", bare.translate(None, _NO_BRACKETS))
        steps = np.frombuffer(brackets, dtype=np.uint8) & 2  # of [ and {, but not of ] and }
        if np.cumsum(steps.astype(np.int64) - 1).max(initial=0) > DEEPEST_JSON:
            raise ValueError(f"must not be nested deeper than {DEEPEST_JSON} levels")
    return json.loads(text)


def remove_folder(folder: Path) -> None:
    """Remove a folder, if it is there, or a link of its name, but not what the link leads to."""
    if folder.is_symlink():
        folder.unlink()
    shutil.rmtree(folder, ignore_errors=True)


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
        os.link(os.path.realpath(source), target)
    except OSError:
        shutil.copyfile(source, target)
