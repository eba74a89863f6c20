"""What mitsplat raises when its input, not its code, is at fault."""

from __future__ import annotations

import errno
import re

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the system's errors where there is no room for a file."""

_OUT_OF_MEMORY = re.compile("out[ _]of[ _]memory|can.t allocate memory|insufficient memory", re.IGNORECASE)


class InputError(ValueError):
    """Bad input: one sentence that names file or place, rule and value. The command line exits with status 2."""


class LateDeviceError(InputError):
    """Another GPU is visible first to this process than the one it was to take.

    Attributes:
        environment: Variables with which a process can take it.
    """

    def __init__(self, sentence: str, environment: dict[str, str]) -> None:
        super().__init__(sentence)
        self.environment = environment


class MissingResourceError(RuntimeError):
    """Something that mitsplat needs of the machine is missing; the sentence says what to do. Exit status 3."""


class PartialResultError(RuntimeError):
    """A result was written, but it misses a threshold; the sentence says which, and what would help. Exit status 4."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether the machine's memory has run out, or a GPU's, which Dr.Jit, PyTorch and OpenCV tell by a text.

    A `TypeError` is what that becomes where an array is made of values that do not fit.
    """
    if isinstance(error, MissingResourceError | PartialResultError):
        return False
    telling = isinstance(error, RuntimeError | TypeError) or type(error).__module__ == "cv2"
    return isinstance(error, MemoryError) or (telling and bool(_OUT_OF_MEMORY.search(str(error))))


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether someone has interrupted, which Dr.Jit wraps in an error of its own where it was at work."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def exit_status(error: BaseException) -> int | None:
    """Status with which the command line exits for an error that is no bug of ours, else None."""
    if isinstance(error, MissingResourceError) or is_out_of_memory(error):
        return 3
    if isinstance(error, OSError) and error.errno in FULL:
        return 3
    if isinstance(error, PartialResultError):
        return 4
    if _is_interrupt(error):
        return 130
    return 2 if isinstance(error, InputError | OSError) else None


def sentence_of(error: BaseException) -> str:
    """What to tell of an error."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if is_out_of_memory(error):
        said = str(error).partition("\n")[0]
        said = f" ({said})" if said else ""
        return (
            f"memory has run out{said}: smaller images and fewer samples take less; if it was a GPU's, use --device cpu"
        )
    return str(error)
