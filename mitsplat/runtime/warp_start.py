"""Initialisation of Warp without its banner and without the warnings in processes that see no GPU."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from mitsplat.errors import FULL
from mitsplat.storage.cache import prepare_caches

_started = False
_NO_GPU = b"Could not find or load the NVIDIA CUDA driver", b"Warp CUDA error 100: no CUDA-capable device"
"""Phrases of Warp's warnings without a driver, and with a driver if ``CUDA_VISIBLE_DEVICES`` hides all GPUs."""


@contextmanager
def quiet_warp() -> Iterator[None]:
    """Initialise Warp and limit its log to errors; also usable as a function decorator.

    The warnings about a missing GPU, which no setting disables, are filtered out. An error about a full disk gets the
    folder of Warp's kernels as file name, because no other files are written here.
    """
    import warp as wp  # takes a third of a second, which only physics needs

    global _started
    kept = wp.config.log_level
    wp.config.log_level = wp.LOG_ERROR
    try:
        if not _started:
            prepare_caches()
            with _stderr_without(_NO_GPU):
                wp.init()  # type: ignore[no-untyped-call]
            _started = True
        yield
    except OSError as error:
        if error.errno in FULL and error.filename is None:
            error.filename = wp.config.kernel_cache_dir
        raise
    finally:
        wp.config.log_level = kept


@contextmanager
def _stderr_without(phrases: tuple[bytes, ...]) -> Iterator[None]:
    """Remove lines with one of the phrases from the stderr output of native code."""
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # there is no stderr
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
            os.write(2, b"".join(line for line in written if not any(phrase in line for phrase in phrases)))
