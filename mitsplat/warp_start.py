"""Starting Warp without what it says of machines that have no GPU."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

_NO_GPU = b"Could not find or load the NVIDIA CUDA driver"


def init_warp() -> None:
    """Start Warp; on machines without a GPU this is no news, and its warning, which no setting mutes, is left out."""
    import warp as wp

    with _stderr_without(_NO_GPU):
        wp.init()  # type: ignore[no-untyped-call]


@contextmanager
def _stderr_without(phrase: bytes) -> Iterator[None]:
    """Leave out lines with a phrase from what native code writes to stderr."""
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    with tempfile.TemporaryFile() as written:
        os.dup2(written.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            written.seek(0)
            os.write(2, b"".join(line for line in written if phrase not in line))
