"""Detection of rays that Dr.Jit drops on a GPU, which would cause missing shadows or objects.

A kernel of ``cuda_ad_rgb`` can trace one scene. If a kernel traces two, Dr.Jit keeps the first one. It only logs a
warning that it disables the others, whose rays then hit nothing. This module turns the warning into an error.
"""

from __future__ import annotations

import atexit
import ctypes
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import drjit as dr

from mitsplat.errors import MissingResourceError

DROPPED_RAYS = b"ray tracing operation"
"""Text common to Dr.Jit's warnings about several pipelines and about several shader binding tables."""

SET_CALLBACK = "_Z26jit_set_log_level_callback8LogLevelPFvS_PKcE"
"""Exported symbol of the function ``jit_set_log_level_callback`` in Dr.Jit's library."""

_Callback = ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_char_p)

_dropped: list[str] = []


def record_dropped_rays() -> None:
    """Record Dr.Jit's log messages about dropped rays from now on, and print its other messages to stderr.

    Call this function again where other code may have set the log level, which replaces the callback. The callback
    takes Python's lock inside Dr.Jit's lock. This is safe as long as only one thread at a time uses Dr.Jit, see
    :func:`mitsplat.runtime.variant.one_at_a_time`.

    Raises:
        MissingResourceError: If the library of this Dr.Jit has no such function.
    """
    level = max(dr.log_level().value, dr.LogLevel.Warn.value)
    _set_callback()(level, _callback)


def check_dropped_rays() -> None:
    """Raise an error if rays were dropped since the last call.

    Raises:
        RuntimeError: If Dr.Jit has dropped rays.
    """
    if _dropped:
        text, count = _dropped[0], len(_dropped)
        _dropped.clear()
        raise RuntimeError(f"the image is incorrect, because Dr.Jit dropped rays ({count} times): {text}")


def _record(level: int, message: bytes) -> None:
    """Record or print a log message. Dr.Jit calls this function, so it must not raise."""
    text = message.decode(errors="replace")
    if DROPPED_RAYS in message:
        _dropped.append(text)
    elif sys.stderr is not None:
        sys.stderr.write(f"{text}\n")


_callback = _Callback(_record)


@lru_cache
def _set_callback() -> Callable[..., None]:
    """Return Dr.Jit's function that sets the log level and a callback."""
    try:
        function = ctypes.CDLL(str(Path(dr.__file__).with_name("libdrjit-core.so")))[SET_CALLBACK]
    except (OSError, AttributeError) as error:
        raise MissingResourceError(
            f"Dr.Jit {dr.__version__} does not report rays that it drops on a GPU ({error}): "
            "install a version of drjit that mitsplat requires, or use the CPU"
        ) from error
    function.argtypes, function.restype = (ctypes.c_uint32, _Callback), None
    # Dr.Jit may still log during Python's shutdown, when the callback no longer exists: this restores the default one.
    atexit.register(lambda: dr.set_log_level(dr.log_level()))
    return function
