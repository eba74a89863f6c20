"""SHA-256 of content, for integrity checks of files and for cache keys."""

from __future__ import annotations

import hashlib
import json
from io import BufferedReader
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsplat.errors import InputError


def file_hash(file: Path | BufferedReader) -> str:
    """Compute the SHA-256 of a file's content, or of the rest of an open file, as hexadecimal text.

    Raises:
        OSError: If the file cannot be read.
    """
    if isinstance(file, Path):
        with file.open("rb") as opened:
            return file_hash(opened)
    return hashlib.file_digest(file, "sha256").hexdigest()


class ContentHash:
    """SHA-256 of several parts, in the order in which they are added.

    Parts are concatenated without separators. Where their boundaries are ambiguous, add the lengths as well, as
    :meth:`add_array` does.

    Args:
        parts: First parts, as for :meth:`add`.
    """

    def __init__(self, *parts: bytes | str) -> None:
        self._sha = hashlib.sha256()
        self.add(*parts)

    def add(self, *parts: bytes | str) -> None:
        """Add bytes, or text in UTF-8."""
        for part in parts:
            self._sha.update(part.encode() if isinstance(part, str) else part)

    def add_json(self, value: object) -> None:
        """Add a JSON value, independent of the order of its keys."""
        self.add(json.dumps(value, sort_keys=True))

    def add_array(self, array: npt.NDArray[np.generic]) -> None:
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
        """Return the hash of all added parts as hexadecimal text."""
        return self._sha.hexdigest()
