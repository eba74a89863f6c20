"""SHA-256 of content: whether a file is as it was written, and what a result that is kept was made of."""

from __future__ import annotations

import hashlib
import json
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from mitsplat.errors import InputError


def file_hash(file: Path | BufferedReader) -> str:
    """SHA-256 of a file's content, or of the rest of an open one, as hexadecimal text.

    Raises:
        OSError: If it cannot be read.
    """
    if isinstance(file, Path):
        with file.open("rb") as opened:
            return file_hash(opened)
    return hashlib.file_digest(file, "sha256").hexdigest()


class ContentHash:
    """SHA-256 of several parts, in the order in which they are added.

    Parts are not kept apart: where one could end elsewhere, add what tells, as :meth:`add_array` does.

    Args:
        parts: The first ones, as :meth:`add` takes them.
    """

    def __init__(self, *parts: bytes | str) -> None:
        self._sha = hashlib.sha256()
        self.add(*parts)

    def add(self, *parts: bytes | str) -> None:
        """Add bytes, and text in UTF-8, as they are."""
        for part in parts:
            self._sha.update(part.encode() if isinstance(part, str) else part)

    def add_json(self, value: Any) -> None:
        """Add a JSON value, whatever the order of its keys."""
        self.add(json.dumps(value, sort_keys=True))

    def add_array(self, array: Any) -> None:
        """Add the type, shape and values of an array."""
        self.add(f"{array.dtype} {np.shape(array)}")
        self._sha.update(np.ascontiguousarray(array).data)

    def add_file(self, path: Path) -> None:
        """Add the SHA-256 of a file's content.

        Raises:
            InputError: If the file cannot be read.
        """
        try:
            self.add(bytes.fromhex(file_hash(path)))
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from error

    def hexdigest(self) -> str:
        """The hash of what was added so far, as hexadecimal text."""
        return self._sha.hexdigest()
