"""Start of Python child processes: the only module that builds their command lines.

A child never imports Python files from the current folder, which may be a downloaded one. It starts in Python's
safe-path mode (``-P``), and the variable ``PYTHONSAFEPATH`` passes this mode on to its own child processes.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from mitsplat.errors import InputError

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable: Python does not search the current folder for modules."""

REFUSED_STATUS = 2
"""Exit status of a bounded child whose function raised :class:`InputError`."""

_GRACE_TIME = 5.0
"""Time by which a child may exceed its limit if its parent is gone [s]."""

_BOUNDED = "from mitsplat.runtime.child_process import run_function; run_function()"


class ChildResult(NamedTuple):
    """Result of a bounded child.

    Attributes:
        status: 0 if the function returned, :data:`REFUSED_STATUS` or 1 if it raised, negative for a signal, None after
            a timeout.
        output: Bytes that the function wrote; after a failure, those that it flushed.
        reason: Message of its exception, or a description of its end that continues "its reader ..."; empty on success.
    """

    status: int | None
    output: bytes
    reason: str


def python_command(*arguments: str | Path) -> list[str]:
    """Return the command line of a Python child for interpreter arguments such as ``-m`` and a module."""
    return [sys.executable, "-P", *map(str, arguments)]


def python_environment(changes: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the environment of a Python child: that of this process, with changes."""
    return {**os.environ, **(changes or {}), SAFE_PATH: "1"}


@contextmanager
def changed_environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Change environment variables of this process in this context, for the processes that it starts."""
    kept = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def safe_path_children() -> Iterator[None]:
    """Put processes that :mod:`multiprocessing` and libraries start in this context into safe-path mode.

    Such processes inherit this process's environment and import path, so that both are changed within the context. An
    empty entry of the path means the current folder: that of a prompt, of a notebook or of ``python -c``.
    """
    path = list(sys.path)
    sys.path[:] = [entry for entry in path if entry]
    try:
        with changed_environment({SAFE_PATH: "1"}):
            yield
    finally:
        sys.path[:] = path


def leave_current_folder() -> None:
    """Stop imports from the current folder, in this process and in all of its child processes.

    The folder stays on the import path if it contains mitsplat itself.
    """
    os.environ[SAFE_PATH] = "1"
    first = sys.path[0] if sys.path and not sys.flags.safe_path else None
    folder = None if first is None else Path(first or ".")
    # A current folder that has been removed has no path, but it is still a folder.
    if folder is not None and folder.exists() and folder.samefile(".") and not (folder / "mitsplat").is_dir():
        del sys.path[0]


def run_bounded(
    function: Callable[..., None],
    *arguments: str | Path,
    data: bytes = b"",
    imports: Sequence[str] = (),
    memory: int,
    seconds: float,
) -> ChildResult:
    """Run a function of an importable module in a child with limited memory and time.

    Args:
        function: Function at a module's top level. It is called with a binary file for its result, ``data`` and
            ``arguments``. The child imports its module.
        arguments: Text arguments of the function.
        data: Bytes argument of the function.
        imports: Modules to import before memory is limited.
        memory: Address space for the function, in addition to that of the child before the call [bytes].
        seconds: Time limit of the whole child.
    """
    call = [function.__module__, function.__qualname__, *imports]
    command = python_command("-c", _BOUNDED, json.dumps(call), str(memory), str(seconds), *arguments)
    environment = python_environment()
    try:
        done = subprocess.run(command, input=data, env=environment, capture_output=True, check=False, timeout=seconds)
    except subprocess.TimeoutExpired as error:
        return ChildResult(None, error.stdout or b"", f"did not end within {seconds:.0f} s")
    if done.returncode == 0:
        return ChildResult(0, done.stdout, "")
    lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
    if lines and done.returncode > 0:
        return ChildResult(done.returncode, done.stdout, lines[-1])
    return ChildResult(done.returncode, done.stdout, f"stopped with status {done.returncode}")


def run_function() -> None:
    """Run the function named by the command line, as the child's part of :func:`run_bounded`, and end this process."""
    call, memory, seconds, *arguments = sys.argv[1:]
    signal.alarm(math.ceil(float(seconds) + _GRACE_TIME))  # ends this process if its parent cannot
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    module, name, *imports = json.loads(call)
    function = getattr(importlib.import_module(module), name)
    for needed in imports:
        importlib.import_module(needed)
    data = sys.stdin.buffer.read()
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries print to stdout
    limit_memory(int(memory))
    try:
        function(output, data, *arguments)
        output.flush()
    except Exception as error:  # noqa: BLE001 - the parent tells of it
        lines = str(error).strip().splitlines() or [type(error).__name__]
        sys.stderr.write(f"\n{lines[-1]}\n")
        sys.stderr.flush()
        os._exit(REFUSED_STATUS if isinstance(error, InputError) else 1)
    os._exit(0)  # with limited memory, the shutdown of a driver may hang


def limit_memory(memory: int, *, final: bool = True) -> None:
    """Limit a child's address space to its present size plus ``memory`` [bytes].

    Args:
        memory: Additional address space [bytes].
        final: True keeps a lower limit of the user, and no later limit exceeds this one. False replaces the limit of an
            earlier part of the work.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    present = (soft, hard) if final else (hard,)
    bound = min([_address_space() + memory, *(limit for limit in present if limit != resource.RLIM_INFINITY)])
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound if final else hard))


def _address_space() -> int:
    """Return the address space of this process [bytes]; a GPU driver may have reserved any amount."""
    with open("/proc/self/statm") as pages:  # noqa: PTH123 - a file of the system
        return int(pages.read().split()[0]) * resource.getpagesize()
