"""Exceptions for bad input and missing resources, and their exit statuses."""

from __future__ import annotations

import errno
import re

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of the operating system that mean that there is no space for a file."""

INTERRUPTED = 130
"""Exit status of an interrupted command."""

_OUT_OF_MEMORY = re.compile("out[ _]of[ _]memory|can.t allocate memory|insufficient memory", re.IGNORECASE)


class InputError(ValueError):
    """Bad input: one sentence with file or place, rule and value. Exit status 2 of the command line."""


class LateDeviceError(InputError):
    """Request for a GPU after this process has already made another GPU its first visible one.

    Attributes:
        environment: Environment variables with which a new process uses the requested GPU.
    """

    def __init__(self, sentence: str, environment: dict[str, str]) -> None:
        super().__init__(sentence)
        self.environment = environment


class MissingResourceError(RuntimeError):
    """Missing resource of the machine, such as memory or a library; the message names the remedy. Exit status 3."""


class PartialResultError(RuntimeError):
    """Written result that misses a threshold; the message names the threshold and a remedy. Exit status 4."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return True if an error means that host or GPU memory is exhausted.

    Dr.Jit, PyTorch and OpenCV report exhausted memory only in the message text. A `TypeError` with such a text occurs
    when an array is built from values that do not fit into memory.
    """
    if isinstance(error, MissingResourceError | PartialResultError):
        return False
    reports_by_text = isinstance(error, RuntimeError | TypeError) or type(error).__module__ == "cv2"
    return isinstance(error, MemoryError) or (reports_by_text and bool(_OUT_OF_MEMORY.search(str(error))))


def _is_interrupt(error: BaseException | None) -> bool:
    """Return True for a keyboard interrupt, including one that Dr.Jit has wrapped in an error of its own."""
    seen = set()
    while error is not None and not isinstance(error, KeyboardInterrupt) and id(error) not in seen:
        seen.add(id(error))  # an error that was raised from itself is its own cause
        error = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt)


def exit_status(error: BaseException) -> int | None:
    """Return the command line's exit status for an error, or None for an error that indicates a bug in mitsplat."""
    if isinstance(error, MissingResourceError) or is_out_of_memory(error):
        return 3
    if isinstance(error, OSError) and error.errno in FULL:
        return 3
    if isinstance(error, PartialResultError):
        return 4
    if _is_interrupt(error):
        return INTERRUPTED
    return 2 if isinstance(error, InputError | OSError) else None


def failed_path(error: OSError) -> str | None:
    """Return the path that a system error is about; on a full disk that of the written file, which a copy names second.

    None if the error names no path.
    """
    path: str | None = (error.filename2 if error.errno in FULL else None) or error.filename
    return path


def sentence_of(error: BaseException) -> str:
    """Return the user message of an error."""
    if isinstance(error, OSError) and error.strerror:
        place = failed_path(error)
        return f"{place}: {error.strerror}" if place else error.strerror
    if is_out_of_memory(error):
        detail = str(error).partition("\n")[0]
        detail = f" ({detail})" if detail else ""
        return (
            f"memory is exhausted{detail}: use smaller images or fewer samples; if it was GPU memory, use --device cpu"
        )
    return str(error)
