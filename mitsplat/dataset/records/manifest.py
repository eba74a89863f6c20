"""Append-only files with one JSON record per line.

Every line of a manifest ends in ``"check"``, a checksum of the rest of the line: the first 64 bits of its SHA-256.
"""

from __future__ import annotations

import json
import os
import re
from array import array
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import IO

from mitsplat.errors import InputError
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.files import Record, open_in_place, open_regular, write_file

LONGEST_LINE = 1 << 26
"""Maximum number of bytes of a line that are read at once; larger than any record of a frame."""
_CHECKED = re.compile(rb'(\{.*),"check":"([0-9a-f]{16})"\}')


class Manifest:
    """Records of a dataset's frames on disk.

    Only the offsets of the lines are held in memory, 8 bytes per frame. Iteration is by ascending frame index. If two
    lines have the same index, the later one counts.

    Args:
        path: Manifest file; it is created if missing. An incomplete last line, left by an interrupted run, is cut off.
        is_valid: Predicate that is called once per record while the file is read. If it returns False, the record is
            ignored. All records count if None.
        check: Function that raises ValueError if a line with a valid checksum is no record of the dataset.
        writable: Allow the file to be changed. If False, an incomplete last line stays in the file, but is ignored.

    Raises:
        InputError: If any other line is damaged.
    """

    def __init__(
        self,
        path: Path,
        is_valid: Callable[[Record], bool] | None = None,
        check: Callable[[bytes, Record], object] = lambda line, record: None,
        *,
        writable: bool = True,
    ) -> None:
        self.path = path
        self._offsets = _LineOffsets()
        self._in_order, self._end, self._last = True, 0, -1
        if writable:
            remove_incomplete_line(path)
        damaged: InputError | None = None
        with open_regular(path) as file:
            for number, line in enumerate(read_lines(file), start=1):
                if damaged is not None:
                    raise damaged
                try:
                    if not line.endswith(b"\n"):
                        raise ValueError("the line is incomplete")
                    record = parse_line(line)
                except ValueError as error:
                    damaged = _line_error(path, number, error)
                else:
                    try:
                        check(line, record)
                        index = _index_of(record)
                    except ValueError as error:
                        raise _line_error(path, number, error) from error
                    self._add_line(index, len(line))
                    if is_valid is not None and not is_valid(record):
                        self._in_order = False
                        self._offsets.pop(index)
        if damaged is not None and writable:
            with open_in_place(path, "r+b") as file:
                file.truncate(self._end)

    def _add_line(self, index: int, length: int) -> None:
        self._offsets[index] = self._end
        self._end += length
        self._in_order &= index > self._last
        self._last = max(self._last, index)

    def __len__(self) -> int:
        return len(self._offsets)

    def __contains__(self, index: object) -> bool:
        return isinstance(index, int) and index in self._offsets

    def __iter__(self) -> Iterator[Record]:
        for _, line in self._lines():
            yield parse_line(line)

    @property
    def indices(self) -> Iterator[int]:
        """Indices of the frames, ascending."""
        return (index for index, _ in self._offsets)

    def append(self, record: Record) -> None:
        """Add a record; it is on disk when this method returns.

        Raises:
            InputError: If another process changed or removed the file.
        """
        line = encode_line(record)
        offset = _append(self.path, line)
        if offset != self._end:
            raise InputError(
                f"{self.path}: must not be changed or removed while it is written (it had {self._end} bytes, "
                f"then {offset}); run again"
            )
        self._add_line(record["index"], len(line))

    def sort(self, visit: Callable[[Record], object] = lambda record: None) -> None:
        """Sort the file to one line per frame by ascending index, and call ``visit`` with every record in that order.

        A file that is sorted already is not rewritten. Otherwise it is replaced after the last call of ``visit``.
        """
        if self._in_order:
            for record in self:
                visit(record)
            return

        def write(temporary: Path) -> None:
            offset = 0
            with temporary.open("wb") as new:
                for index, line in self._lines():
                    visit(parse_line(line))
                    new.write(line)
                    offsets[index] = offset
                    offset += len(line)

        offsets = _LineOffsets()
        write_file(self.path, write)
        self._offsets, self._end, self._in_order = offsets, self.path.stat().st_size, True

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        with open_regular(self.path) as file:
            position = 0
            for index, offset in self._offsets:
                if offset != position:  # a seek discards the read buffer
                    file.seek(offset)
                line = file.readline()
                position = offset + len(line)
                yield index, line


def _line_error(path: Path, number: int, error: ValueError) -> InputError:
    line_error = InputError(
        f"{path}:{number}: must be the record of a frame ({error}); remove the line to render its frame again"
    )
    line_error.__cause__ = error
    return line_error


def _index_of(record: Record) -> int:
    index = record.get("index")
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < 2**31:
        raise ValueError(f"index must be a number from 0 to {2**31 - 1} (got {str(index)[:20]})")
    return index


class _LineOffsets:
    """Sparse map from frame index to the offset of its line, iterated by ascending index.

    Offsets are stored in pages. Frame indices are contiguous, but those of a shard do not start at 0, and an untrusted
    file may contain any index.
    """

    _PAGE = 4096
    _BLANK = array("q", [-1]) * _PAGE

    def __init__(self) -> None:
        self._pages: dict[int, array[int]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __contains__(self, index: int) -> bool:
        page = self._pages.get(index // self._PAGE)
        return page is not None and page[index % self._PAGE] >= 0

    def __setitem__(self, index: int, offset: int) -> None:
        self._count += index not in self
        self._pages.setdefault(index // self._PAGE, self._BLANK[:])[index % self._PAGE] = offset

    def pop(self, index: int) -> None:
        if index in self:
            self._pages[index // self._PAGE][index % self._PAGE] = -1
            self._count -= 1

    def __iter__(self) -> Iterator[tuple[int, int]]:
        for number in sorted(self._pages):
            for position, offset in enumerate(self._pages[number]):
                if offset >= 0:
                    yield number * self._PAGE + position, offset


def encode_line(record: Record) -> bytes:
    """Return the manifest line of a record, with its checksum."""
    text = json.dumps(record, separators=(",", ":")).encode()
    return text[:-1] + f',"check":"{_checksum(text)}"}}\n'.encode()


def parse_line(line: bytes) -> Record:
    """Parse the record of a line, without its checksum.

    Raises:
        ValueError: If the checksum does not match the line.
    """
    found = _CHECKED.fullmatch(line.rstrip(b"\n"))
    if found is None:
        raise ValueError("it has no checksum")
    text = found[1] + b"}"
    if _checksum(text) != found[2].decode():
        raise ValueError(f"its checksum must be {_checksum(text)} (got {found[2].decode()})")
    try:
        record: Record = json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    return record


def read_lines(file: IO[bytes]) -> Iterator[bytes]:
    """Iterate over the lines of a file; a line longer than :data:`LONGEST_LINE` is split into pieces."""
    return iter(partial(file.readline, LONGEST_LINE), b"")


def append_line(path: Path, record: Mapping[str, object]) -> None:
    """Append a record without a checksum; it is on disk when this function returns."""
    _append(path, json.dumps(record, separators=(",", ":")).encode() + b"\n")


def _checksum(text: bytes) -> str:
    return ContentHash(text).hexdigest()[:16]


def _append(path: Path, line: bytes) -> int:
    """Append a line and flush it to disk, and return its offset in the file."""
    with open_in_place(path, "ab") as file:
        offset = file.tell()
        file.write(line)
        file.flush()
        os.fsync(file.fileno())
    return offset


def remove_incomplete_line(path: Path) -> None:
    """Create the file if it is missing, and cut off an incomplete last line."""
    with open_in_place(path, "a+b") as file:
        size = end = file.seek(0, os.SEEK_END)
        tail = b""
        while end and b"\n" not in tail:
            start = max(0, end - 65536)
            file.seek(start)
            tail = file.read(end - start)
            end = start
        complete = end + tail.rfind(b"\n") + 1
        if complete < size:
            file.truncate(complete)
