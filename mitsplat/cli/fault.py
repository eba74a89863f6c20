"""Handling of unexpected errors on the command line: a sentence on stderr and a traceback in a log file."""

from __future__ import annotations

import os
import platform
import shlex
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mitsplat.errors import exit_status, sentence_of
from mitsplat.storage.cache import cache_folder
from mitsplat.version import __version__

STATUS = 70
"""Exit status EX_SOFTWARE of sysexits.h: an internal error of mitsplat."""

VARIABLE = "MITSPLAT_TRACEBACK"
"""Environment variable that prints the traceback to stderr."""

_MAX_LENGTH = 200
_FOLDERS: tuple[Callable[[], Path], ...] = (
    lambda: cache_folder() / "logs",
    lambda: Path(tempfile.gettempdir()),
    Path.cwd,
)


def outcome_of(error: BaseException) -> tuple[int, str]:
    """Return the exit status and the sentence of an error; an unexpected error is written to a log file."""
    status = exit_status(error)
    return (STATUS, report_fault(error)) if status is None else (status, sentence_of(error))


def report_fault(error: BaseException) -> str:
    """Return one sentence about an unexpected error, and write its traceback to a log file.

    The traceback includes that of the worker process in which the error occurred.
    """
    text = "".join(traceback.format_exception(error))
    if os.environ.get(VARIABLE):
        sys.stderr.write(text)
    lines = str(error).strip().splitlines()
    what = f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
    if len(what) > _MAX_LENGTH:
        what = f"{what[: _MAX_LENGTH - 3]}..."
    log = _write_log(f"{_environment_text()}\n{text}")
    where = f"set {VARIABLE}=1 to print the traceback" if log is None else f"the log is {log}"
    return f"internal error of mitsplat, not caused by the input: {what} ({where})"


def _environment_text() -> str:
    return (
        f"mitsplat {__version__}, Python {platform.python_version()}, {platform.platform()}\n"
        f"{time.strftime('%Y-%m-%d %H:%M:%S %z')} in {os.environ.get('PWD', '')}\n{shlex.join(sys.argv)}\n"
    )


def _write_log(text: str) -> Path | None:
    """Write the text to a new file in the first writable folder; return its path, or None if no folder is writable."""
    for folder in _FOLDERS:
        with suppress(OSError, RuntimeError):  # RuntimeError: there is no home folder
            place = folder()
            place.mkdir(parents=True, exist_ok=True)
            number, name = tempfile.mkstemp(".log", time.strftime("mitsplat-%Y%m%d-%H%M%S-"), place)
            with os.fdopen(number, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(text)
            return Path(name)
    return None
