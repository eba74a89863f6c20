"""Atomic and safe file access."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from PIL import Image

from mitsplat.errors import FULL, InputError, MissingResourceError, failed_path
from mitsplat.storage.content_hash import file_hash

JsonObject = dict[str, Any]
"""JSON object, parsed or to be written."""
Record = JsonObject
"""Line of one frame in ``manifest.jsonl``."""

_YAML_WORDS = frozenset({"true", "false", "yes", "no", "on", "off", "y", "n", "null", "~"})
"""Words that YAML does not read as text."""

SPLITS = ("train", "val", "test")
"""Splits of a dataset. The scene may disable the last one."""


def splits_of(output: JsonObject) -> tuple[str, ...]:
    """Return the splits of a dataset from the ``output`` section of its scene."""
    return SPLITS if output.get("test") else SPLITS[:2]


_MAX_PATH_LENGTH = 4096
"""Length of the longest path that the system resolves [characters]."""

IMAGE_ERRORS = (OSError, SyntaxError, ValueError, TypeError, struct.error, Image.DecompressionBombError)
"""Exceptions of Pillow for damaged images, and for images with an excessive number of pixels."""

MESH_ERRORS = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, AssertionError, RuntimeError),
    *(MemoryError, EOFError, ImportError, NameError, struct.error),
)
"""Exceptions of trimesh's readers for damaged files.

ImportError occurs where a reader guesses the encoding of binary data. NameError occurs where damaged data skip the
branch that sets a variable.
"""


def write_file(path: Path, write: Callable[[Path], object]) -> str:
    """Write a file atomically: call ``write(temporary path)``, sync, and rename to ``path``.

    The folder of the file is created if needed.

    Returns:
        The SHA-256 of the content.
    """
    temporary = _temporary_path(path)
    try:
        temporary.unlink(missing_ok=True)  # a link of this name would be followed
        write(temporary)
        with temporary.open("rb") as file:
            digest = file_hash(file)
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        with suppress(OSError):  # the disk may not be writable
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise
    return digest


def _temporary_path(path: Path) -> Path:
    """Return the path of an unfinished file of this process, and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.with_name(f".{path.name}.{os.getpid()}.part")


class GrowingFile:
    """A text file that is written incrementally under a temporary name and renamed atomically at the end.

    Args:
        path: The file; its folder is created.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._temporary = path, _temporary_path(path)
        self._temporary.unlink(missing_ok=True)
        self._file = self._temporary.open("x+b", buffering=1 << 16)
        self._renamed = False

    def write(self, text: str) -> None:
        """Append UTF-8 text."""
        self._file.write(text.encode())

    def append_file(self, other: GrowingFile) -> None:
        """Append the content of another growing file, and discard that file."""
        other._file.seek(0)
        shutil.copyfileobj(other._file, self._file, 1 << 20)
        other.discard()

    def commit(self) -> None:
        """Sync the file to disk and give it its final name."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self.close()
        self.rename()

    def close(self) -> None:
        """Close the file for writing."""
        self._file.close()

    def sync(self) -> None:
        """Sync a closed file to disk."""
        with self._temporary.open("rb") as file:
            os.fsync(file.fileno())

    def rename(self) -> None:
        """Give a closed file its final name; it must be synced before."""
        self._temporary.replace(self._path)
        self._renamed = True

    def discard(self) -> None:
        """Remove the temporary file, unless it has its final name."""
        self._file.close()
        if not self._renamed:
            self._temporary.unlink(missing_ok=True)


def open_in_place(path: Path, mode: str) -> IO[Any]:
    """Open a file for writing in place; depending on the mode, the file is created.

    Raises:
        OSError: If the file cannot be opened. A link, or a file with a second hard link, is refused, because another
            file would be changed too.
    """
    file: IO[Any] = open(path, mode, opener=_open_unlinked)  # noqa: SIM115 - the caller's
    return file


def _open_unlinked(name: str, flags: int) -> int:
    """Open a regular file that is no link and has no other name; return its descriptor. For ``open(opener=)``."""
    try:
        number = os.open(name, flags & ~os.O_TRUNC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "must not be a link: remove it", str(name)) from error
        raise
    try:
        _check_regular(number, name)
        if os.fstat(number).st_nlink > 1:
            raise OSError(errno.EMLINK, "must not be a hard link: remove it, or replace it by a copy", str(name))
        if flags & os.O_TRUNC:
            os.ftruncate(number, 0)
    except BaseException:
        os.close(number)
        raise
    return number


def open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading, also through links; other files, such as a pipe, could block forever.

    Raises:
        OSError: If the file is not regular, or cannot be opened.
    """
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _check_regular(number, path)
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Read an untrusted file of at most ``max_bytes`` bytes.

    Raises:
        OSError: As :func:`open_regular`.
        ValueError: If it is larger.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise ValueError(f"must have at most {max_bytes} bytes (got {size})")
        return file.read()


def _check_regular(number: int, path: str | Path) -> None:
    mode = os.fstat(number).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "must be a regular file", str(path))


MAX_JSON_BYTES = 1 << 28
"""Maximum size of a JSON file that is read as a whole [bytes]."""
MAX_JSON_DEPTH = 64
"""Maximum nesting depth of JSON; files of mitsplat and other tools use about ten levels."""
_NO_BRACKETS = bytes(set(range(256)) - set(b'[]{}"'))


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Read an untrusted JSON file: a regular file of at most ``max_bytes``, with limited depth.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it is too large, too deep, or not JSON.
    """
    return parse_json(read_regular(path, max_bytes))


def parse_json(data: bytes) -> Any:
    """Parse JSON in UTF-8.

    Raises:
        ValueError: If it has more than :data:`MAX_JSON_DEPTH` levels, or is not JSON.
    """
    text = data.decode("utf-8-sig")
    if data.count(b"[") + data.count(b"{") > MAX_JSON_DEPTH:
        bare = re.sub(rb"\\.", b"", data, flags=re.DOTALL) if b"\\" in data else data
        brackets = re.sub(rb'"[^"]*"', b"", bare.translate(None, _NO_BRACKETS))
        steps = np.frombuffer(brackets, dtype=np.uint8) & 2  # bit 1 is set for [ and {, but not for ] and }
        if np.cumsum(steps.astype(np.int64) - 1).max(initial=0) > MAX_JSON_DEPTH:
            raise ValueError(f"must not be nested deeper than {MAX_JSON_DEPTH} levels")
    return json.loads(text)


def remove_folder(folder: Path) -> None:
    """Remove a folder if it exists. A link of that name is removed, but not its target."""
    if folder.is_symlink():
        folder.unlink()
    shutil.rmtree(folder, ignore_errors=True)


def write_bytes(path: Path, data: bytes) -> str:
    """Write bytes by :func:`write_file`."""
    return write_file(path, lambda temporary: temporary.write_bytes(data))


def write_text(path: Path, text: str) -> str:
    """Write UTF-8 text by :func:`write_file`."""
    return write_bytes(path, text.encode())


def yaml_scalar(text: str) -> str:
    """Return a text as it stands in a YAML file: in quotes, unless it is a plain word or path."""
    plain = re.fullmatch(r"([A-Za-z_/]|\.\.?/)[\w./-]*", text, re.ASCII) and text.lower() not in _YAML_WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)


def files_below(folder: Path, *, skip: Path | None = None) -> list[Path]:
    """List all files in a folder and in linked folders, each once, sorted by name; the folder ``skip`` is left out."""
    found, seen = list[Path](), set[str]() if skip is None else {os.path.realpath(skip)}
    for place, folders, files in os.walk(folder, followlinks=True):
        seen.add(os.path.realpath(place))
        folders[:] = [name for name in folders if os.path.realpath(Path(place, name)) not in seen]
        found += [Path(place, name) for name in files]
    return sorted(found)


def is_inside(folder: Path, name: str) -> bool:
    """Return True if a path (absolute or relative to ``folder``) lies in it after links and ``..`` are resolved."""
    if len(name) > _MAX_PATH_LENGTH:  # resolving takes a time with the square of the length
        return False
    try:
        return (folder / name).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # too long, a zero byte, or a loop of links
        return False


def resolve_inside(folder: Path, name: str) -> Path:
    """Return the path of a file that must lie in ``folder`` after links and ``..`` are resolved.

    Raises:
        InputError: If the file is outside or missing. The message holds only the rule, because the caller adds the
            place.
    """
    if not is_inside(folder, name):
        raise InputError(f"must be a file inside {folder} (got {name})")
    path = folder / name
    try:
        found = path.is_file()
    except OSError:  # not a valid file name
        found = False
    if not found:
        raise InputError(f"no such file (got {name})")
    return path


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Convert a library's errors to system errors; such libraries include only the text of the system error.

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
    """Convert system errors during file access in a folder to errors of one sentence.

    Raises:
        MissingResourceError: If the disk is full.
        InputError: For any other ``OSError``.
    """
    try:
        yield
    except OSError as error:
        place = failed_path(error) or folder
        if error.errno in FULL:
            remedy = "free disk space"
            if error.errno == errno.EFBIG:
                remedy = "raise the limit of file sizes (ulimit -f), or use another disk"
            raise MissingResourceError(
                f"{place}: {error.strerror}: {remedy} and run again; finished files are kept"
            ) from error
        raise InputError(f"{place}: cannot be written or read ({error.strerror or error})") from error


def copy_file(source: Path, target: Path) -> Path:
    """Copy ``source`` to ``target`` unless both are the same file; return ``target``."""
    if not (target.exists() and target.samefile(source)):
        write_file(target, lambda temporary: shutil.copyfile(source, temporary))
    return target


def link_file(source: Path, target: Path) -> None:
    """Create a hard link, or copy the file if the file system has no hard links."""
    try:
        os.link(os.path.realpath(source), target)
    except OSError:
        shutil.copyfile(source, target)
