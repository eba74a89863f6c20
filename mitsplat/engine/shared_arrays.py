"""What is sent to worker processes, with arrays that all of them share: one copy in memory, which nobody can change.

The arrays are taken out of the pickle (PEP 574) and put into a file that every worker maps. It has no name, so that the
system frees it with the last process, however that ends.
"""

from __future__ import annotations

import logging
import mmap
import os
import pickle
import tempfile
from contextlib import suppress
from multiprocessing.reduction import DupFd
from typing import IO, Any, Generic, TypeVar

from mitsplat.cache import cache_folder

Value = TypeVar("Value")

_LINE = 64
"""Arrays start at whole cache lines [bytes]."""

_logger = logging.getLogger(__name__)


class SharedArrays(Generic[Value]):
    """A value that processes can be started with; there it is unpickled where it stands, as that value.

    Where no file can be written, each process gets a copy.

    Attributes:
        size: What the processes share [bytes].
    """

    def __init__(self, value: Value) -> None:
        buffers: list[pickle.PickleBuffer] = []
        self._pickled = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        self._places: list[tuple[int, int]] = []
        self._file: IO[bytes] | None = None
        self.size = 0
        if not buffers:
            return
        try:
            folder = cache_folder()
            folder.mkdir(parents=True, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by close()
            for buffer in buffers:
                with buffer.raw() as raw:
                    self._file.seek(self.size)
                    self._file.write(raw)
                    self._places.append((self.size, raw.nbytes))
                    self.size += -(-raw.nbytes // _LINE) * _LINE
            self._file.truncate(max(self.size, _LINE))  # what is empty cannot be mapped
            self._file.flush()
        except OSError as error:
            _logger.warning("%s: arrays are not shared (%s): each worker has a copy", cache_folder(), error)
            self.close()
            self._pickled, self._places, self.size = pickle.dumps(value), [], 0

    def __reduce__(self) -> tuple[Any, ...]:
        handle = None if self._file is None else DupFd(self._file.fileno())
        return _open, (self._pickled, handle, self._places)

    def close(self) -> None:
        """Let go of the file; processes that were started keep it."""
        if self._file is not None:
            with suppress(OSError):  # of a full disk, which is told of already
                self._file.close()
            self._file = None


def _open(pickled: bytes, handle: Any, places: list[tuple[int, int]]) -> Any:
    if handle is None:
        return pickle.loads(pickled)
    number = handle.detach()
    try:
        mapped = memoryview(mmap.mmap(number, 0, access=mmap.ACCESS_READ))
    finally:
        os.close(number)
    return pickle.loads(pickled, buffers=[mapped[start : start + size] for start, size in places])
