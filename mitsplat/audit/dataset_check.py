"""Base class of checks over all frames, and comparison of entries of files that describe all frames."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Generic, TypeGuard, TypeVar

import numpy as np
import numpy.typing as npt

from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.storage.files import JsonObject, read_json

Entry = TypeVar("Entry")
Violation = tuple[str, str]
"""File, relative to the dataset, and description."""
Violations = Iterator[Violation]
FileCheck = Callable[[DecodedFrame, Path], Iterator[str]]
"""Function that describes the violations in a file of a frame."""

FRACTION_TOLERANCE = 1e-5
"""Tolerance of fractions that are stored with six decimals."""
_RELATIVE_TOLERANCE = 1e-9
"""Relative tolerance of poses and intrinsics, which are stored with full precision."""


class DatasetCheck:
    """Check that gets all frames of a dataset one by one, by ascending index."""

    def check(self, frame: DecodedFrame) -> Violations:
        """Yield the violations of the next frame."""
        yield from ()

    def finish(self) -> Violations:
        """Yield the remaining violations, after all frames were checked."""
        yield from ()


class EntryCursor(Generic[Entry]):
    """Position in the entries of a file, which is read in parallel with the manifest. A read error is reported once.

    Args:
        file: File, relative to the dataset.
        entries: Frame index and entry of each, by ascending index.
        noun: Plural of the entries in messages.

    Attributes:
        broken: True after an error, so that no further entries are read.
    """

    def __init__(self, file: str, entries: Iterator[tuple[int, Entry]], noun: str = "entries") -> None:
        self.file = file
        self._entries, self._noun = entries, noun
        self._next: tuple[int, Entry] | None = None
        self._error = ""
        self.broken = False
        self._advance()

    def _advance(self) -> None:
        last = -1 if self._next is None else self._next[0]
        self._next = None
        try:
            self._next = next(self._entries, None)
            if self._next is not None and self._next[0] < last:
                raise ValueError(f"frame {self._next[0]} follows frame {last}")
        except FileNotFoundError:
            self._error = "is missing"
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            self._error = f"cannot be read ({type(error).__name__}: {error})"
        if self._error:
            self._next = None

    def entries_of(self, frame: DecodedFrame) -> Generator[Violation, None, list[Entry]]:
        """Yield a read error or entries of other frames as a violation; return the entries of a frame."""
        found = []
        while not self.broken and self._next is not None and self._next[0] <= frame.index:
            index, entry = self._next
            self._advance()
            if index == frame.index:
                found.append(entry)
            else:
                self._error = self._error or _unexpected(index)
        yield from self._report_error()
        return [] if self.broken else found

    def entry_of(self, frame: DecodedFrame) -> Generator[Violation, None, list[Entry]]:
        """Check that a frame has one entry; return a list of this entry, which is empty after a violation."""
        found = yield from self.entries_of(frame)
        if self.broken or len(found) == 1:
            return found
        yield self.file, f"has {len(found)} {self._noun} of frame {frame.index}"
        return []

    def finish(self) -> Violations:
        """Yield the remaining errors, and a violation if entries are left."""
        yield from self._report_error()
        if self._next is not None and not self.broken:
            yield self.file, _unexpected(self._next[0])
            while self._next is not None:
                self._advance()

    def _report_error(self) -> Violations:
        """Yield the error so far; after an error, no further entries are read."""
        if self._error:
            self.broken = True
            yield self.file, self._error
            self._error = ""


def read_json_file(root: Path, file: str) -> Generator[Violation, None, list[object]]:
    """Return a list of the JSON value of a file, relative to the dataset; the list is empty after a violation."""
    try:
        return [read_json(root / file)]
    except FileNotFoundError:
        yield file, "is missing"
    except (OSError, ValueError) as error:
        yield file, f"cannot be read ({error})"
    return []


def _unexpected(index: int) -> str:
    return f"has an entry of frame {index}, which the manifest does not have at this position"


def prefixed(file: str, prefix: str, texts: Iterable[str]) -> Violations:
    """Yield descriptions as violations of a file, after a prefix that states the place in the file."""
    return ((file, f"{prefix}: {text}") for text in texts)


def is_close(found: object, expected: npt.ArrayLike, tolerance: float = _RELATIVE_TOLERANCE) -> bool:
    """Return True if a number or list read from a file equals the expected values within a relative tolerance."""
    reference = np.asarray(expected, dtype=np.float64)
    try:
        values = np.array(found, dtype=np.float64)
    except (ValueError, TypeError):
        return False
    scale = max(1.0, float(np.abs(reference).max(initial=0)))
    return values.shape == reference.shape and bool(np.all(np.abs(values - reference) <= tolerance * scale))


def are_objects(found: object) -> TypeGuard[list[JsonObject]]:
    """Return True if a value read from a file is a list of objects."""
    return isinstance(found, list) and all(isinstance(entry, dict) for entry in found)


def compare_keys(found: object, expected: Mapping[str, object]) -> Iterator[str]:
    """Yield a description of the first key with an unexpected value, if there is one."""
    if not isinstance(found, dict):
        yield f"must be an object (got {str(found)[:40]})"
        return
    for key, value in expected.items():
        if found.get(key) != value:
            yield f"{key} is {str(found.get(key))[:80]}, not {str(value)[:80]}"
            return
