"""Rays that Dr.Jit leaves out on a GPU, made an error: it only warns, and the picture lacks shadows or objects.

A kernel of ``cuda_ad_rgb`` can trace one scene. Of one that traces two, Dr.Jit keeps the first, and logs that it
disables the others, which then hit nothing.
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

SIGN = b"ray tracing operation"
"""Part of what Dr.Jit logs then, of several pipelines and of several shader binding tables alike."""

SET_CALLBACK = "_Z26jit_set_log_level_callback8LogLevelPFvS_PKcE"
"""The function ``jit_set_log_level_callback``, as the library of Dr.Jit exports it."""

_Callback = ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_char_p)

_lost: list[str] = []


def watch_rays() -> None:
    """Keep from now on what Dr.Jit logs of rays that it leaves out, and print its other messages to stderr.

    To be called again where somebody else may have set the log level, which takes the callback's place. The callback
    takes Python's lock inside of Dr.Jit's: safe as long as Dr.Jit is used by one thread at a time, see
    :func:`mitsplat.runtime.variant.one_at_a_time`.

    Raises:
        MissingResourceError: If the library of this Dr.Jit has no such function.
    """
    level = max(dr.log_level().value, dr.LogLevel.Warn.value)
    _set_callback()(level, _callback)


def refuse_lost_rays() -> None:
    """Raise what was logged of rays since the last call.

    Raises:
        RuntimeError: If Dr.Jit left out any.
    """
    if _lost:
        text, count = _lost[0], len(_lost)
        _lost.clear()
        raise RuntimeError(f"the picture is wrong, because Dr.Jit left out rays ({count} times): {text}")


def _keep(level: int, message: bytes) -> None:
    """Must not raise: it is called from within Dr.Jit."""
    text = message.decode(errors="replace")
    if SIGN in message:
        _lost.append(text)
    elif sys.stderr is not None:
        sys.stderr.write(f"{text}\n")


_callback = _Callback(_keep)


@lru_cache
def _set_callback() -> Callable[..., None]:
    """The function that gives Dr.Jit a level and a callback."""
    try:
        function = ctypes.CDLL(str(Path(dr.__file__).with_name("libdrjit-core.so")))[SET_CALLBACK]
    except (OSError, AttributeError) as error:
        raise MissingResourceError(
            f"Dr.Jit {dr.__version__} cannot be asked which rays it leaves out on a GPU ({error}): "
            "install the drjit that mitsplat was tested with, or take the CPU"
        ) from error
    function.argtypes, function.restype = (ctypes.c_uint32, _Callback), None
    # Dr.Jit may still log while Python ends, when the callback is gone: this brings back its own.
    atexit.register(lambda: dr.set_log_level(dr.log_level()))
    return function
