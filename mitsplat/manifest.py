"""Files of one JSON record per line that only grow while a dataset is made.

Every line of a manifest ends in a checksum of the rest of it, ``"check"``: the first 64 bits of its SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mitsplat.errors import InputError
from mitsplat.files import Record, write_file

_CHECKED = re.compile(rb'(\{.*),"check":"([0-9a-f]{16})"\}')


class Manifest:
    """The records of a dataset's frames, on disk; only their places in the file are held in memory.

    Iteration is by ascending frame index. Where two lines have one index, the later counts.

    Args:
        path: The file; made if missing. A last line that is not whole is cut off: whoever wrote it was stopped.

    Raises:
        InputError: If any other line is not as it was written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._places: dict[int, int] = {}
        cut_torn_line(path)
        place = 0
        torn: InputError | None = None
        with path.open("rb") as file:
            for number, line in enumerate(file, start=1):
                if torn is not None:
                    raise torn
                try:
                    self._places[parse_line(line)["index"]] = place
                except ValueError as error:
                    torn = InputError(
                        f"{path}, line {number}: must be the record of a frame ({error}); "
                        "without that line its frame is made again"
                    )
                    torn.__cause__ = error
                else:
                    place += len(line)
        if torn is not None:
            os.truncate(path, place)
        self._end = place

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, index: object) -> bool:
        return index in self._places

    def __iter__(self) -> Iterator[Record]:
        with self.path.open("rb") as file:
            for index in sorted(self._places):
                file.seek(self._places[index])
                yield parse_line(file.readline())

    @property
    def indices(self) -> list[int]:
        """Indices of the frames, ascending."""
        return sorted(self._places)

    def append(self, record: Record) -> None:
        """Add a record; it is on disk when this returns.

        Raises:
            InputError: If someone else changed or removed the file.
        """
        line = encode_line(record)
        place = _append(self.path, line)
        if place != self._end:
            raise InputError(
                f"{self.path}: must not be changed or removed while it is written (it had {self._end} bytes, "
                f"then {place}); run again"
            )
        self._places[record["index"]] = place
        self._end = place + len(line)

    def forget(self, index: int) -> None:
        """Act as if the file had no record of this frame."""
        del self._places[index]

    def sort(self) -> None:
        """Rewrite the file with one line per frame, by ascending index."""

        def write(temporary: Path) -> None:
            with self.path.open("rb") as old, temporary.open("wb") as new:
                for index in sorted(self._places):
                    old.seek(self._places[index])
                    places[index] = new.tell()
                    new.write(old.readline())

        places: dict[int, int] = {}
        write_file(self.path, write)
        self._places, self._end = places, self.path.stat().st_size


def encode_line(record: Record) -> bytes:
    """The line of a frame's record, with its checksum."""
    text = json.dumps(record, separators=(",", ":")).encode()
    return text[:-1] + f',"check":"{_checksum(text)}"}}\n'.encode()


def parse_line(line: bytes) -> Record:
    """The record of a line, without its checksum.

    Raises:
        ValueError: If it is not as it was written.
    """
    found = _CHECKED.fullmatch(line.rstrip(b"\n"))
    if found is None:
        raise ValueError("it has no checksum")
    text = found[1] + b"}"
    if _checksum(text) != found[2].decode():
        raise ValueError(f"its checksum must be {_checksum(text)} (got {found[2].decode()})")
    record: Record = json.loads(text)
    return record


def append_line(path: Path, record: Mapping[str, Any]) -> None:
    """Append a record without a checksum; it is on disk when this returns."""
    _append(path, json.dumps(record, separators=(",", ":")).encode() + b"\n")


def _checksum(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()[:16]


def _append(path: Path, line: bytes) -> int:
    """Append a line; it is on disk when this returns its place in the file."""
    with path.open("ab") as file:
        place = file.tell()
        file.write(line)
        file.flush()
        os.fsync(file.fileno())
    return place


def cut_torn_line(path: Path) -> None:
    """Make the file if it is missing; cut it behind its last newline if a line was not written to its end."""
    with path.open("a+b") as file:
        end = file.tell()
        tail = b""
        while end and b"\n" not in tail:
            start = max(0, end - 65536)
            file.seek(start)
            tail = file.read(end - start)
            end = start
        file.truncate(end + tail.rfind(b"\n") + 1)
