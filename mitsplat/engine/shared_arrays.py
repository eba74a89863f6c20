"""Values for worker processes whose arrays share one read-only copy in memory.

The arrays are extracted from the pickle (PEP 574) and written to a file that every worker maps, followed by the pickle
and a table of offsets. The file has no name, so that the system frees it when the last process ends.
"""

from __future__ import annotations

import logging
import mmap
import os
import pickle
import tempfile
from array import array
from collections.abc import Sequence
from contextlib import suppress
from itertools import accumulate, chain
from multiprocessing.reduction import DupFd
from typing import IO, Any, Generic, TypeVar

from mitsplat.storage.cache import cache_folder

Value = TypeVar("Value")

_CACHE_LINE = 64
"""Alignment of arrays to cache lines [bytes]."""

_logger = logging.getLogger(__name__)


class SharedArrays(Generic[Value]):
    """A value for the start of processes, which each process unpickles as the original value.

    If no file can be written, the processes share memory that the system cannot swap out.

    Attributes:
        size: Shared data [bytes].
    """

    def __init__(self, value: Value) -> None:
        buffers: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        parts = [*(buffer.raw() for buffer in buffers), memoryview(pickled)]
        *starts, self.size = accumulate((-(-part.nbytes // _CACHE_LINE) * _CACHE_LINE for part in parts), initial=0)
        table = array("q", chain.from_iterable((start, part.nbytes) for start, part in zip(starts, parts, strict=True)))
        places = list(zip([*starts, self.size], [*parts, memoryview(table)], strict=True))
        try:
            self._file = _write_parts(_in_cache(), places)
        except OSError as error:
            _logger.warning("%s: cannot be written (%s): workers share memory instead", cache_folder(), error)
            self._file = _write_parts(os.fdopen(os.memfd_create("mitsplat"), "w+b"), places)

    def __reduce__(self) -> tuple[object, ...]:
        return _open, (DupFd(self._file.fileno()), self.size)

    def close(self) -> None:
        """Close the file; started processes keep it open."""
        self._file.close()


def _write_parts(file: IO[bytes], places: Sequence[tuple[int, memoryview]]) -> IO[bytes]:
    """Write all parts to the file and return it; close it if there is no space."""
    try:
        for start, part in places:
            file.seek(start)
            file.write(part)
        file.flush()
    except BaseException:
        with suppress(OSError):  # closing tries to write the remaining data again
            file.close()
        raise
    return file


def _in_cache() -> IO[bytes]:
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    return tempfile.TemporaryFile(dir=folder)


def _open(handle: Any, end: int) -> Any:
    number = handle.detach()
    try:
        mapped = memoryview(mmap.mmap(number, 0, access=mmap.ACCESS_READ))
    finally:
        os.close(number)
    table = mapped[end:].cast("q").tolist()  # of starts and sizes
    *buffers, pickled = (mapped[start : start + size] for start, size in zip(table[::2], table[1::2], strict=True))
    return pickle.loads(pickled, buffers=buffers)
