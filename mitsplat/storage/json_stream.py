"""JSON that need not fit into memory: objects of long lists, written and read element by element.

What is written is byte for byte what ``json.dumps`` makes of the whole. Reading takes the standard library's decoder to
one element after the other, which are small here; only one is held at a time.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from mitsplat.storage.files import GrowingFile, open_regular

_BLOCK = 1 << 16
_LOOK_AHEAD = 3
"""Characters behind a number by which it is known to have ended: it may go on by ``.5`` or ``e-5``."""
MOST_ELEMENT = 1 << 26
"""Largest element that is read [characters]; no frame needs as much."""


class ListsFile:
    """An object of growing lists, such as COCO's ``{"images": [...], "annotations": [...], "categories": [...]}``.

    Every list but the first grows in a file of its own, which is added at the end.

    Args:
        path: The file, which gets its name when it is kept.
        lists: Names of the lists, in their order.
        before: Entries before the lists.
        after: Entries after them.
    """

    def __init__(
        self,
        path: Path,
        lists: Sequence[str],
        *,
        before: Mapping[str, Any] | None = None,
        after: Mapping[str, Any] | None = None,
    ) -> None:
        head = "".join(f"{json.dumps(key)}: {json.dumps(value)}, " for key, value in (before or {}).items())
        self._after = after or {}
        names = [path, *(path.with_name(f"{path.name}.{name}") for name in lists[1:])]
        self._parts = {name: GrowingFile(part) for name, part in zip(lists, names, strict=True)}
        self._counts = dict.fromkeys(lists, 0)
        self._first, *self._others = lists
        self._parts[self._first].write(f"{{{head}{json.dumps(self._first)}: [")

    def append(self, name: str, element: Any) -> None:
        """Add an element to a list."""
        text = json.dumps(element)
        self._parts[name].write(f", {text}" if self._counts[name] else text)
        self._counts[name] += 1

    def count(self, name: str) -> int:
        """Elements of a list so far."""
        return self._counts[name]

    def keep(self) -> None:
        """End the lists, and give the file its name."""
        whole = self._parts[self._first]
        for name in self._others:
            whole.write(f"], {json.dumps(name)}: [")
            whole.take(self._parts[name])
        whole.write("]" + "".join(f", {json.dumps(key)}: {json.dumps(value)}" for key, value in self._after.items()))
        whole.write("}")
        whole.keep()

    def discard(self) -> None:
        """Remove what was written, unless it was kept."""
        for part in self._parts.values():
            part.discard()


class EntriesFile:
    """A growing JSON object, such as BOP's ``{"0": ..., "1": ...}``; see :class:`GrowingFile` for its end."""

    def __init__(self, path: Path) -> None:
        self._file = GrowingFile(path)
        self._separator = "{"

    def append(self, key: str, value: Any) -> None:
        """Add an entry."""
        self._file.write(f"{self._separator}{json.dumps(key)}: {json.dumps(value)}")
        self._separator = ", "

    def end(self) -> GrowingFile:
        """End the object; its file, closed, still has to be named."""
        self._file.write("{}" if self._separator == "{" else "}")
        self._file.close()
        return self._file

    def discard(self) -> None:
        """Remove what was written."""
        self._file.discard()


def read_lists(path: Path) -> Iterator[tuple[str, Any]]:
    """Elements of an object's lists, and its other values, each with its key, one after the other.

    Raises:
        ValueError: If it is not JSON or not an object.
        OSError: If it cannot be read.
    """
    yield from _read_object(path, lists=True)


def read_entries(path: Path) -> Iterator[tuple[str, Any]]:
    """Entries of an object, one after the other.

    Raises:
        ValueError: If it is not JSON or not an object.
        OSError: If it cannot be read.
    """
    yield from _read_object(path, lists=False)


def _read_object(path: Path, *, lists: bool) -> Iterator[tuple[str, Any]]:
    with io.TextIOWrapper(open_regular(path), encoding="utf-8") as file:
        window = _Window(file)
        window.expect("{")
        if window.peek() == "}":
            window.expect("}")
        else:
            while True:
                key = window.value()
                if not isinstance(key, str):
                    raise ValueError(f"a key must be a string (got {str(key)[:40]})")
                window.expect(":")
                if lists and window.peek() == "[":
                    for element in _elements(window):
                        yield key, element
                else:
                    yield key, window.value()
                if window.peek() != ",":
                    break
                window.expect(",")
            window.expect("}")
        if window.peek():
            raise ValueError(f"something follows its end (got {window.peek()!r})")


def _elements(window: _Window) -> Iterator[Any]:
    window.expect("[")
    if window.peek() == "]":
        window.expect("]")
        return
    while True:
        yield window.value()
        if window.peek() != ",":
            break
        window.expect(",")
    window.expect("]")


class _Window:
    """The part of a file that is being decoded."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._text, self._at = "", 0
        self._decode = json.JSONDecoder(parse_constant=_refuse_constant).raw_decode

    def peek(self) -> str:
        """The next character that is no space, "" at the end."""
        while True:
            self._at = _skip_space(self._text, self._at)
            if self._at < len(self._text) or not self._read():
                return self._text[self._at : self._at + 1]

    def expect(self, character: str) -> None:
        if self.peek() != character:
            raise ValueError(f"{character!r} must follow (got {self._text[self._at : self._at + 20]!r})")
        self._at += 1

    def value(self) -> Any:
        """The value that begins here."""
        self.peek()
        while True:
            try:
                value, end = self._decode(self._text, self._at)
            except json.JSONDecodeError as error:
                if len(self._text) - self._at > MOST_ELEMENT or not self._read(len(self._text) - self._at):
                    raise ValueError(f"{error.msg} (at {self._text[self._at : self._at + 20]!r})") from error
            except RecursionError as error:
                raise ValueError("it is nested too deeply") from error
            else:
                # A number may go on where what was read ends; whatever else ends in a character of its own.
                sure = not isinstance(value, int | float) or end + _LOOK_AHEAD <= len(self._text)
                if sure or not self._read():
                    self._at = end
                    return value

    def _read(self, least: int = 0) -> bool:
        """Let go of what was decoded and read on, twice as much where an element is large."""
        block = self._file.read(max(_BLOCK, least))
        if block:
            self._text, self._at = self._text[self._at :] + block, 0
        return bool(block)


def _skip_space(text: str, at: int) -> int:
    while at < len(text) and text[at] in " \t\n\r":
        at += 1
    return at


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON")
