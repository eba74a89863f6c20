"""Worker and helper processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, Protocol, TypeVar

from mitsplat.engine.answers import Answer, Failure, Finished, Lost, Result, Started, Status
from mitsplat.engine.shared_arrays import SharedArrays
from mitsplat.errors import MissingResourceError
from mitsplat.progress import Note
from mitsplat.runtime.child_process import changed_environment, safe_path_children
from mitsplat.runtime.device import Device, Gpu, Kind, gpu_environment, use_shared_device
from mitsplat.runtime.gpu_memory import VISIBLE_GPUS
from mitsplat.storage.cache import prepare_caches

MadeFrame = TypeVar("MadeFrame", covariant=True)

_HELPER_NICENESS = 5
"""Lower priority of helper processes. The lowest one could delay a worker that waits for a layout on a busy machine."""

_START_TIMEOUT = 300.0
"""Time limit for the start of a worker [s]. On an idle machine, imports take about two seconds."""

_POLL_INTERVAL = 1.0
"""Polling interval while workers start [s]."""

_MAX_ARGUMENTS = 1 << 14
"""Maximum length of a command line that is part of a worker's start data [bytes]."""

_CAUSES_AT_START = 'out of memory, or does the script start workers outside of `if __name__ == "__main__":`?'
"""Possible causes of workers that end before their start; without the guard, each of them runs the script again."""

_END_TIMEOUT = 30.0
"""Time limit for the end of a worker that has closed its pipe [s]."""


class MakeFrame(Protocol[MadeFrame]):
    """Function that makes one frame; must be picklable if worker processes are used."""

    def __call__(self, index: int, note: Note, /) -> MadeFrame:
        """Make frame ``index``."""


_Jobs = tuple[MakeFrame[Any], Callable[[], object] | None]
"""Functions of workers and helpers, which share the arrays of the scene."""


class WorkerProcesses(Generic[Result]):
    """Worker processes on this machine.

    Nothing here waits for a worker that does not start. :mod:`multiprocessing` writes a process's start data into a
    pipe. It would wait forever for a process that dies before reading more than the pipe's capacity (64 KiB). The start
    data are therefore small, and the job itself is in a file, see :class:`SharedArrays`.

    Args:
        make: Function that makes a frame.
        device: Device that each worker selects; several GPUs are assigned in turn. None for work without a device.
        environment: Further environment variables of workers.
        prepare: Function that each helper calls once.
        threads: Number of threads that Dr.Jit uses in a worker on a CPU; None for its default.
    """

    def __init__(
        self,
        make: MakeFrame[Result],
        device: Device | None,
        environment: Mapping[str, str] | None = None,
        prepare: Callable[[], object] | None = None,
        threads: int | None = None,
    ) -> None:
        prepare_caches()  # workers inherit the folders
        self._jobs = SharedArrays((make, prepare))
        self._environment = environment or {}
        self._kind = None if device is None else device.kind
        self._threads = threads
        self._gpus = () if device is None else device.gpus
        self._taken: dict[int, Gpu] = {}
        self._spawn = multiprocessing.get_context("spawn")
        self._workers: dict[int, tuple[BaseProcess, Connection]] = {}
        self._helpers: list[BaseProcess] = []
        self._starting: dict[int, float] = {}
        self._count = 0

    def start(self) -> int:
        """Start a worker on the GPU with the fewest workers and return its number."""
        pipe, far_end = self._spawn.Pipe()
        worker, self._count = self._count, self._count + 1
        load = Counter(self._taken.values())
        gpu = min(self._gpus, key=load.__getitem__, default=None)
        arguments = far_end, self._kind, self._threads, self._jobs
        with changed_environment({**self._environment, **gpu_environment(gpu)}):
            process = self._start_process(f"mitsplat-{worker}", _work, arguments)
        far_end.close()  # so that the worker's death closes the pipe
        self._workers[worker] = process, pipe
        self._starting[worker] = _START_TIMEOUT
        if gpu is not None:
            self._taken[worker] = gpu
        return worker

    def start_helper(self) -> None:
        """Start a process without a GPU that runs ``prepare`` once. It needs no attention and may die."""
        name = f"mitsplat-helper-{len(self._helpers)}"
        with changed_environment({VISIBLE_GPUS: ""}):
            self._helpers.append(self._start_process(name, _help, (self._jobs,)))

    def _start_process(self, name: str, target: Callable[..., None], arguments: tuple[object, ...]) -> BaseProcess:
        process = self._spawn.Process(target=target, args=arguments, name=name, daemon=True)
        with safe_path_children(), _short_arguments():
            resource_tracker.ensure_running()  # its start together with the first worker would unblock SIGINT
            # Ctrl-C reaches all processes of a terminal, but only this one must handle it: workers inherit the blocked
            # signal.
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                process.start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        return process

    def stop(self, worker: int) -> None:
        """Kill a worker, even if it is suspended."""
        process, pipe = self._workers.pop(worker)
        self._taken.pop(worker, None)
        self._starting.pop(worker, None)
        process.kill()
        process.join()
        pipe.close()

    def send_frame(self, worker: int, frame: int, layout: int) -> None:
        """Send a frame to an idle worker."""
        with suppress(BrokenPipeError, ConnectionResetError):  # a dead worker is detected when its answer is received
            self._workers[worker][1].send(frame)

    def wait(self) -> Iterator[tuple[int, Answer[Result]]]:
        """Wait for answers and yield those that arrived; there may be none."""
        begun = time.monotonic()
        ready = set(wait([pipe for _, pipe in self._workers.values()], _POLL_INTERVAL if self._starting else None))
        # At most one interval counts, because this process and its workers may have been suspended.
        waited = min(time.monotonic() - begun, _POLL_INTERVAL)
        for worker, (process, pipe) in list(self._workers.items()):
            if pipe not in ready:
                if worker in self._starting:
                    self._starting[worker] -= waited
                    if self._starting[worker] <= 0:
                        self.stop(worker)
                        yield worker, Lost(f"did not start within {_START_TIMEOUT:g} s")
                continue
            try:
                answer = pipe.recv()
            except (EOFError, OSError):
                lost = Lost(_describe_end(process))
                if worker in self._starting and (process.exitcode or 0) > 0:
                    lost = Lost(f"{lost.how} before its start", _CAUSES_AT_START)
                self.stop(worker)
                yield worker, lost
                continue
            if isinstance(answer, Started):
                self._starting.pop(worker, None)
            else:
                yield worker, answer

    def free_slots(self) -> int:
        """Return 0, because this machine gets no new resources."""
        return 0

    def close(self) -> None:
        """Kill all workers and helpers."""
        for process in (*self._helpers, *(process for process, _ in self._workers.values())):
            process.kill()
        for helper in self._helpers:
            helper.join()
        for worker in list(self._workers):
            self.stop(worker)
        self._jobs.close()


@contextmanager
def _short_arguments() -> Iterator[None]:
    """Omit the arguments of a long command line from the start data of processes that start in this context."""
    arguments = list(sys.argv)
    if sum(len(os.fsencode(argument)) for argument in arguments) > _MAX_ARGUMENTS:
        del sys.argv[1:]
    try:
        yield
    finally:
        sys.argv[:] = arguments


def _describe_end(process: BaseProcess) -> str:
    """Describe the end of a process that has closed its pipe."""
    process.join(_END_TIMEOUT)
    code = process.exitcode
    if code is None:
        return "stopped responding"
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"


def _help(jobs: _Jobs) -> None:
    """Run a helper. Its failures are ignored, because the workers find them again."""
    _, prepare = jobs
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(_HELPER_NICENESS)
    if prepare is not None:
        with suppress(Exception):
            prepare()


def _work(pipe: Connection, device: Kind | None, threads: int | None, jobs: _Jobs) -> None:
    """Run a worker: receive frame indices, send notes and results, until the process is stopped."""
    make, _ = jobs
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, BrokenPipeError):
        pipe.send(Started())
        while True:
            index = pipe.recv()
            try:
                if device is not None:
                    try:
                        use_shared_device(device, threads)
                    except (ImportError, RuntimeError, MissingResourceError) as error:
                        if device == "cpu":
                            raise
                        # Other processes may have taken the GPU's memory since the run began, or one may have crashed a
                        # shared service.
                        pipe.send(replace(Failure.of(error), exhausted=True))
                        continue
                    device = None
                pipe.send(Finished(make(index, lambda text: pipe.send(Status(text)))))
            except Exception as error:  # noqa: BLE001 - the parent raises it
                pipe.send(Failure.of(error))


def _end_with_parent() -> None:
    """End this process when its parent is killed, because another run may then use the output folder."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
