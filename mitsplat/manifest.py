"""Files of one JSON record per line that only grow while a dataset is made."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mitsplat.errors import InputError
from mitsplat.files import Record, write_file


class Manifest:
    """The records of a dataset's frames, on disk; only their places in the file are held in memory.

    Iteration is by ascending frame index. Where two lines have one index, the later counts.

    Args:
        path: The file; made if missing, cut behind its last whole line if torn.

    Raises:
        InputError: If a whole line is not a record of a frame.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._places: dict[int, int] = {}
        cut_torn_line(path)
        place = 0
        with path.open("rb") as file:
            for number, line in enumerate(file, start=1):
                try:
                    self._places[json.loads(line)["index"]] = place
                except (ValueError, KeyError, TypeError) as error:
                    raise InputError(f"{path}, line {number}: must be the record of a frame ({error!r})") from error
                place += len(line)

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, index: object) -> bool:
        return index in self._places

    def __iter__(self) -> Iterator[Record]:
        with self.path.open("rb") as file:
            for index in sorted(self._places):
                file.seek(self._places[index])
                record: Record = json.loads(file.readline())
                yield record

    def append(self, record: Record) -> None:
        """Add a record; it is on disk when this returns."""
        self._places[record["index"]] = append_line(self.path, record)

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
        self._places = places


def append_line(path: Path, record: Mapping[str, Any]) -> int:
    """Append a record; it is on disk when this returns its place in the file."""
    with path.open("ab") as file:
        place = file.tell()
        file.write(json.dumps(record, separators=(",", ":")).encode() + b"\n")
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
