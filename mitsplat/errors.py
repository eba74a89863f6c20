"""What mitsplat raises when its input, not its code, is at fault."""

from __future__ import annotations

import errno


class InputError(ValueError):
    """Bad input: one sentence that names file or place, rule and value. The command line exits with status 2."""


class MissingResourceError(RuntimeError):
    """Something that mitsplat needs of the machine is missing; the sentence says what to do. Exit status 3."""


class PartialResultError(RuntimeError):
    """A result was written, but it misses a threshold; the sentence says which, and what would help. Exit status 4."""


def exit_status(error: BaseException) -> int | None:
    """Status with which the command line exits for an error that is no bug of ours, else None."""
    if isinstance(error, MissingResourceError | MemoryError):
        return 3
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return 3
    if isinstance(error, PartialResultError):
        return 4
    if isinstance(error, KeyboardInterrupt):
        return 130
    return 2 if isinstance(error, InputError | OSError) else None


def sentence_of(error: BaseException) -> str:
    """What to tell of an error."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return f"memory has run out ({error})" if str(error) else "memory has run out"
    return str(error)
