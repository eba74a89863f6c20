"""Start of Python child processes: the only module that builds their command lines.

A child never imports Python files of the current folder, which may be a downloaded one: it starts in Python's safe-path
mode (``-P``), and the variable ``PYTHONSAFEPATH`` hands that on to the processes that it starts itself.
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
"""Environment variable: Python does not look for modules in the current folder."""

REFUSED = 2
"""Status of a bounded child whose function raised :class:`InputError`."""

_SETTLING = 5.0
"""Time by which a child may outlive its limit if its parent is gone [s]."""

_BOUNDED = "from mitsplat.runtime.child_process import run_function; run_function()"


class Ended(NamedTuple):
    """Result of a bounded child.

    Attributes:
        status: 0 if the function returned, :data:`REFUSED` or 1 if it raised, negative for a signal, None if time ran
            out.
        output: Bytes that the function wrote; of one that failed, those that it flushed.
        reason: Message of its exception, or how it ended, for "its reader ..."; empty if it returned.
    """

    status: int | None
    output: bytes
    reason: str


def python_command(*arguments: str | Path) -> list[str]:
    """Command line of a Python child: the interpreter's arguments, such as ``-m`` and a module."""
    return [sys.executable, "-P", *map(str, arguments)]


def python_environment(changes: Mapping[str, str] | None = None) -> dict[str, str]:
    """Environment of a Python child: this process's, with changes."""
    return {**os.environ, **(changes or {}), SAFE_PATH: "1"}


@contextmanager
def starting_safely() -> Iterator[None]:
    """Start processes of :mod:`multiprocessing` and of libraries in safe-path mode meanwhile.

    They get this process's environment and import path, so both are changed for that long. An empty entry of the path
    stands for the current folder: that of a prompt, of a notebook or of ``python -c``.
    """
    kept, path = os.environ.get(SAFE_PATH), list(sys.path)
    os.environ[SAFE_PATH] = "1"
    sys.path[:] = [entry for entry in path if entry]
    try:
        yield
    finally:
        sys.path[:] = path
        if kept is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = kept


def leave_current_folder() -> None:
    """Import nothing from the current folder any more, in this process and all that it starts.

    The folder stays on the import path if mitsplat itself is in it.
    """
    os.environ[SAFE_PATH] = "1"
    first = sys.path[0] if sys.path and not sys.flags.safe_path else None
    if first in ("", str(Path.cwd())) and not Path(first or ".", "mitsplat").is_dir():
        del sys.path[0]


def run_bounded(
    function: Callable[..., None],
    *arguments: str | Path,
    data: bytes = b"",
    imports: Sequence[str] = (),
    memory: int,
    seconds: float,
) -> Ended:
    """Run a function of an importable module in a child whose memory and time are bounded.

    Args:
        function: Function of a module's top level, called with a binary file for its result, ``data`` and
            ``arguments``. The child imports its module.
        arguments: Texts that the function gets.
        data: Bytes that the function gets.
        imports: Modules to import before memory is bounded.
        memory: Address space for the function, on top of what the child holds before [bytes].
        seconds: Time limit of the whole child.
    """
    call = [function.__module__, function.__qualname__, *imports]
    command = python_command("-c", _BOUNDED, json.dumps(call), str(memory), str(seconds), *arguments)
    environment = python_environment()
    try:
        done = subprocess.run(command, input=data, env=environment, capture_output=True, check=False, timeout=seconds)
    except subprocess.TimeoutExpired as error:
        return Ended(None, error.stdout or b"", f"did not end within {seconds:.0f} s")
    if done.returncode == 0:
        return Ended(0, done.stdout, "")
    lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
    if lines and done.returncode > 0:
        return Ended(done.returncode, done.stdout, lines[-1])
    return Ended(done.returncode, done.stdout, f"stopped with status {done.returncode}")


def run_function() -> None:
    """Run the function that the command line names, and end this process: the child's part of :func:`run_bounded`."""
    call, memory, seconds, *arguments = sys.argv[1:]
    signal.alarm(math.ceil(float(seconds) + _SETTLING))  # ends this process if its parent cannot
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    module, name, *imports = json.loads(call)
    function = getattr(importlib.import_module(module), name)
    for needed in imports:
        importlib.import_module(needed)
    data = sys.stdin.buffer.read()
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries print to stdout
    bound = _held() + int(memory)
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    if most == resource.RLIM_INFINITY or bound < most:
        resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
    try:
        function(output, data, *arguments)
        output.flush()
    except Exception as error:  # noqa: BLE001 - the parent tells of it
        said = str(error).strip().splitlines() or [type(error).__name__]
        sys.stderr.write(f"\n{said[-1]}\n")
        sys.stderr.flush()
        os._exit(REFUSED if isinstance(error, InputError) else 1)
    os._exit(0)  # within the bound, what ends a driver may never end


def limit_memory(memory: int) -> None:
    """Lower the bound of a child for what follows: this much address space more than it holds now [bytes]."""
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    bound = _held() + memory
    resource.setrlimit(resource.RLIMIT_AS, (bound if most == resource.RLIM_INFINITY else min(bound, most), most))


def _held() -> int:
    """Address space of this process [bytes]; a driver of a GPU may have set aside any amount."""
    with open("/proc/self/statm") as pages:  # noqa: PTH123 - a file of the system
        return int(pages.read().split()[0]) * resource.getpagesize()
