"""Streaming JSON for objects of long lists, written and read element by element.

The output equals that of ``json.dumps`` byte for byte. The reader applies the standard library's decoder to one element
at a time, so that only one element is in memory.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NoReturn

from mitsplat.storage.files import GrowingFile, open_regular

_BLOCK = 1 << 16
_LOOK_AHEAD = 3
"""Characters after a number that show that it has ended; it could continue with ``.5`` or ``e-5``."""
MAX_ELEMENT_LENGTH = 1 << 26
"""Maximum size of an element [characters]; frames need less."""


class ListsFile:
    """An object of growing lists, such as COCO's ``{"images": [...], "annotations": [...], "categories": [...]}``.

    Every list except the first grows in a separate file, which is appended at the end.

    Args:
        path: The file, which gets its final name in :meth:`commit`.
        lists: Names of the lists, in their order.
        before: Entries before the lists.
        after: Entries after the lists.
    """

    def __init__(
        self,
        path: Path,
        lists: Sequence[str],
        *,
        before: Mapping[str, object] | None = None,
        after: Mapping[str, object] | None = None,
    ) -> None:
        head = "".join(f"{json.dumps(key)}: {json.dumps(value)}, " for key, value in (before or {}).items())
        self._after = after or {}
        names = [path, *(path.with_name(f"{path.name}.{name}") for name in lists[1:])]
        self._parts = {name: GrowingFile(part) for name, part in zip(lists, names, strict=True)}
        self._counts = dict.fromkeys(lists, 0)
        self._first, *self._others = lists
        self._parts[self._first].write(f"{{{head}{json.dumps(self._first)}: [")

    def append(self, name: str, element: object) -> None:
        """Append an element to a list."""
        text = json.dumps(element)
        self._parts[name].write(f", {text}" if self._counts[name] else text)
        self._counts[name] += 1

    def count(self, name: str) -> int:
        """Return the current number of elements of a list."""
        return self._counts[name]

    def commit(self) -> None:
        """End the lists, and give the file its final name."""
        first = self._parts[self._first]
        for name in self._others:
            first.write(f"], {json.dumps(name)}: [")
            first.append_file(self._parts[name])
        first.write("]" + "".join(f", {json.dumps(key)}: {json.dumps(value)}" for key, value in self._after.items()))
        first.write("}")
        first.commit()

    def discard(self) -> None:
        """Remove the temporary files, unless the file was committed."""
        for part in self._parts.values():
            part.discard()


class EntriesFile:
    """A growing JSON object, such as BOP's ``{"0": ..., "1": ...}``; it ends as a :class:`GrowingFile`."""

    def __init__(self, path: Path) -> None:
        self._file = GrowingFile(path)
        self._separator = "{"

    def append(self, key: str, value: object) -> None:
        """Append an entry."""
        self._file.write(f"{self._separator}{json.dumps(key)}: {json.dumps(value)}")
        self._separator = ", "

    def end(self) -> GrowingFile:
        """End the object and return its closed file, which still needs its final name."""
        self._file.write("{}" if self._separator == "{" else "}")
        self._file.close()
        return self._file

    def discard(self) -> None:
        """Remove the temporary file."""
        self._file.discard()


def read_entries(path: Path, *, split_lists: bool = False) -> Iterator[tuple[str, Any]]:
    """Yield the entries of an object; with ``split_lists``, the elements of its lists one by one, each with its key.

    Raises:
        ValueError: If the file is not JSON or not an object.
        OSError: If it cannot be read.
    """
    with io.TextIOWrapper(open_regular(path), encoding="utf-8") as file:
        window = _Window(file)
        for _ in _items(window, "{", "}"):
            key = window.value()
            if not isinstance(key, str):
                raise ValueError(f"a key must be a string (got {str(key)[:40]})")
            window.expect(":")
            if split_lists and window.peek() == "[":
                for _ in _items(window, "[", "]"):
                    yield key, window.value()
            else:
                yield key, window.value()
        if window.peek():
            raise ValueError(f"must end after the closing brace (got {window.peek()!r})")


def _items(window: _Window, first: str, last: str) -> Iterator[None]:
    """Move to each item of an object or a list in brackets; the caller decodes the item."""
    window.expect(first)
    if window.peek() != last:
        yield
        while window.peek() == ",":
            window.expect(",")
            yield
    window.expect(last)


class _Window:
    """Part of a file that is being decoded."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._text, self._at = "", 0
        self._decode = json.JSONDecoder(parse_constant=_refuse_constant).raw_decode

    def peek(self) -> str:
        """Return the next character that is not white space, or "" at the end."""
        while True:
            self._at = _skip_space(self._text, self._at)
            if self._at < len(self._text) or not self._read():
                return self._text[self._at : self._at + 1]

    def expect(self, character: str) -> None:
        if self.peek() != character:
            raise ValueError(f"must have {character!r} here (got {self._text[self._at : self._at + 20]!r})")
        self._at += 1

    def value(self) -> Any:
        """Decode the value at the current position."""
        self.peek()
        while True:
            try:
                value, end = self._decode(self._text, self._at)
            except json.JSONDecodeError as error:
                if len(self._text) - self._at > MAX_ELEMENT_LENGTH or not self._read(len(self._text) - self._at):
                    raise ValueError(f"{error.msg} (at {self._text[self._at : self._at + 20]!r})") from error
            except RecursionError as error:
                raise ValueError("it is nested too deeply") from error
            else:
                # A number may continue beyond the text read so far; all other values end with a character of their own.
                complete = not isinstance(value, int | float) or end + _LOOK_AHEAD <= len(self._text)
                if complete or not self._read():
                    self._at = end
                    return value

    def _read(self, least: int = 0) -> bool:
        """Drop the decoded text and read the next block, at least ``least`` characters."""
        block = self._file.read(max(_BLOCK, least))
        if block:
            self._text, self._at = self._text[self._at :] + block, 0
        return bool(block)


def _skip_space(text: str, at: int) -> int:
    while at < len(text) and text[at] in " \t\n\r":
        at += 1
    return at


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")
