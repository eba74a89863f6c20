"""Scheduler of frames: in this process, in worker processes or on a cluster, with identical bytes in every case.

A frame depends only on (seed, frame index), so the scheduler may choose any order. Each worker gets all frames of one
layout in turn. Different layouts thus settle in parallel, and a worker can cache the data of its layout. A frame whose
worker is lost is made again by another worker.

Helper processes of low priority prepare later layouts on cores that the workers leave idle. Their results only save
time: a worker that needs an unprepared layout prepares it.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from heapq import heapify, heappop, heappush, heapreplace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from statistics import median
from typing import Any, Generic, Protocol, TypeVar

from mitsplat.engine.mps import MAX_CLIENTS, SharedGpu
from mitsplat.engine.resources import TYPICAL_MEMORY, WorkerMemory, unused_memory
from mitsplat.engine.shared_arrays import SharedArrays
from mitsplat.errors import (
    InputError,
    MissingResourceError,
    PartialResultError,
    exit_status,
    is_out_of_memory,
    sentence_of,
)
from mitsplat.progress import Note
from mitsplat.runtime.child_process import safe_path_children
from mitsplat.runtime.cores import usable_cores
from mitsplat.runtime.device import Device, Gpu, Kind, children_on_gpu, current_device, use_device, use_shared_device
from mitsplat.runtime.gpu_memory import VISIBLE_GPUS
from mitsplat.storage.cache import prepare_caches

MadeFrame = TypeVar("MadeFrame", covariant=True)
Result = TypeVar("Result")

MAX_LOSSES = 3
"""Maximum number of workers that one frame may terminate before the run is aborted."""

MIN_SPEED_UP = 1.1
"""Minimum speed-up for keeping another worker, if the engine chooses the number of workers."""

_SPEED_WINDOW = 8
"""Frames per worker over which speed is measured."""

_HELPER_MEMORY = 2**30
"""Maximum memory of a helper process [bytes]."""

_HELPER_NICENESS = 5
"""Lower priority of helper processes. The lowest one could delay a worker that waits for a layout on a busy machine."""


CORES_PER_WORKER = 2
"""Cores that the threads of a worker on a CPU keep busy. On two cores, two workers were not faster than one."""

_MAX_SERIAL_FRAMES = 16
"""Number of frames up to which worker processes are not worth their start-up time."""

_START_TIMEOUT = 300.0
"""Time limit for the start of a worker [s]. On an idle machine, imports take about two seconds."""

_POLL_INTERVAL = 1.0
"""Polling interval while workers start [s]."""

_MAX_ARGUMENTS = 1 << 14
"""Maximum length of a command line that is part of a worker's start data [bytes]."""

_END_TIMEOUT = 30.0
"""Time limit for the end of a worker that has closed its pipe [s]."""

_SENTENCES: tuple[type[Exception], ...] = (InputError, MissingResourceError, PartialResultError)


class MakeFrame(Protocol[MadeFrame]):
    """Function that makes one frame; must be picklable if worker processes are used."""

    def __call__(self, index: int, note: Note, /) -> MadeFrame:
        """Make frame ``index``."""


Prepare = Callable[[Sequence[int]], object]
"""Function that prepares layouts in the given order and skips those in preparation elsewhere; must be picklable."""

_Jobs = tuple[MakeFrame[Any], Callable[[], object] | None]
"""Functions of workers and helpers, which share the arrays of the scene."""


class FrameError(RuntimeError):
    """Failure of a frame in a worker. The message names the frame, and a note holds the worker's traceback."""


class LostWorkersError(PartialResultError):
    """Loss of every worker process that tried a frame; finished frames are kept."""


@dataclass(frozen=True)
class Status:
    """Status message of a worker."""

    text: str


@dataclass(frozen=True)
class Finished(Generic[Result]):
    """Result of a worker's frame."""

    result: Result


@dataclass(frozen=True)
class Failure:
    """Exception of a worker as text, because not every exception can be pickled.

    Attributes:
        sentence: Exception class, if its message is meant for the user.
        exhausted: True if memory is exhausted.
    """

    sentence: type[Exception] | None
    kind: str
    message: str
    trace: str
    exhausted: bool = False

    @classmethod
    def of(cls, error: Exception) -> Failure:
        """Build a failure from the exception that is being handled."""
        sentence = next((kind for kind in _SENTENCES if isinstance(error, kind)), None)
        if sentence is None:  # classes with the same exit status of the command line
            sentence = {2: InputError, 3: MissingResourceError}.get(exit_status(error) or 0)
        return cls(sentence, type(error).__name__, sentence_of(error), traceback.format_exc(), is_out_of_memory(error))

    def error(self, frame: int) -> Exception:
        """Return the exception to raise in the calling process."""
        if self.sentence is not None:
            return self.sentence(self.message)
        error = FrameError(f"frame {frame} failed: {self.kind}: {self.message}")
        error.add_note(self.trace)
        return error


@dataclass(frozen=True)
class Lost:
    """Loss of a worker with its frame; ``how`` continues "the worker of frame 3 ..."."""

    how: str


@dataclass(frozen=True)
class Started:
    """Message of a worker that is ready for frames."""


Answer = Status | Finished[Result] | Failure | Lost


class Pool(Protocol[Result]):
    """Pool of numbered workers, each of which makes one frame at a time."""

    def start(self) -> int:
        """Start a worker and return its number."""

    def stop(self, worker: int) -> None:
        """Stop a worker."""

    def send_frame(self, worker: int, frame: int, layout: int) -> None:
        """Send a frame to an idle worker."""

    def wait(self) -> Iterator[tuple[int, Answer[Result]]]:
        """Wait for answers and yield those that arrived; there may be none."""

    def free_slots(self) -> int:
        """Return the number of workers that can be started on newly available resources; each is reported once."""

    def close(self) -> None:
        """Stop all workers."""


def check_workers(workers: int | None) -> None:
    """Check that a number of workers is None or at least 1.

    Raises:
        InputError: If it is less than 1.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1 (got {workers})")


def run_frames(
    make: MakeFrame[Result],
    layouts: Mapping[int, Sequence[int]],
    *,
    workers: int | None = 1,
    note: Note,
    memory: WorkerMemory = TYPICAL_MEMORY,
    device: Device | None = None,
    prepare: Prepare | None = None,
) -> Generator[Result]:
    """Call ``make`` for every frame and yield the results in order of completion.

    Args:
        make: Function that makes one frame. It is sent once to each worker, which is spawned. A script that calls this
            function must therefore guard its main part by ``if __name__ == "__main__"``.
        layouts: Frame indices by layout.
        workers: Number of processes; 1 makes the frames in this process if it can compute on the device. None selects
            the number automatically: on CPUs, as long as another worker speeds up the run; on GPUs, immediately the
            number that cores and memory allow.
        note: Callback that receives a short description of the current operation.
        memory: Memory of a worker, which limits an automatic number of workers.
        device: Device for the frames; each worker selects it first, and several GPUs are assigned in turn. None for
            work without a device.
        prepare: Function that helper processes call with the layouts that the first workers do not begin with. Its
            failures are ignored, because ``make`` prepares what is missing.

    Raises:
        InputError: If the input of a frame is invalid.
        MissingResourceError: If the memory does not suffice for a frame in a single worker.
        FrameError: If a frame fails otherwise in a worker.
        LostWorkersError: If :data:`MAX_LOSSES` workers died while making the same frame. Workers are stopped before an
            exception is raised, and when the iterator is closed.
    """
    check_workers(workers)
    total = sum(map(len, layouts.values()))
    max_workers = affordable_workers(memory, device) if workers is None else workers
    # On a GPU, starting workers one by one would take longer than most runs.
    grow = workers is None and (device is None or not device.gpus)
    later = list(layouts)[1 if grow else max_workers :]  # the first workers begin with the others
    worthwhile = prepare is not None and total > _MAX_SERIAL_FRAMES and workers != 1
    helpers = min(len(later), _affordable_helpers(max_workers, memory)) if worthwhile else 0
    serial = total <= 1 or max_workers + helpers <= 1 or (workers is None and total <= _MAX_SERIAL_FRAMES)
    if serial and (device is None or device.is_usable_here):
        if device is not None and device != current_device():
            use_device(device)
        for frames in layouts.values():
            for index in frames:
                try:
                    made = make(index, note)
                except (RuntimeError, MemoryError) as error:
                    if is_out_of_memory(error):
                        raise _memory_error(index, sentence_of(error)) from error
                    raise
                yield made
        return
    if serial:
        max_workers = 1
    shares = device is not None and 0 < len(device.gpus) < min(max_workers, total)
    with closing(SharedGpu()) if shares else nullcontext() as shared:
        if shared is not None and shared.problem:
            note(f"workers take turns on the GPU, because {shared.problem}")
        environment = {} if shared is None else shared.environment
        with (
            closing(
                _Processes(
                    make,
                    device,
                    environment,
                    partial(prepare, later) if prepare else None,
                    None if workers is None else max(1, usable_cores() // workers),
                )
            ) as pool,
            closing(run_pool(pool, layouts, max_workers, note, grow=grow)) as found,
        ):
            for _ in range(helpers):
                pool.start_helper()
            yield from found


def run_in_process(make: MakeFrame[Result], device: Device | None = None) -> Generator[Result]:
    """Call ``make`` for frame 0 in a separate process and yield the result.

    Raises:
        InputError, MissingResourceError, FrameError, LostWorkersError: As :func:`run_frames`.
    """
    with closing(_Processes(make, device)) as pool:
        yield from run_pool(pool, {0: [0]}, 1, lambda text: None)


def affordable_workers(memory: WorkerMemory, device: Device | None = None) -> int:
    """Return the number of workers for which cores, unused memory and GPU memory suffice, at least 1."""
    on_cpu = device is not None and not device.gpus
    cores = usable_cores() // (CORES_PER_WORKER if on_cpu else 1)
    max_workers = min(cores, int((unused_memory() * 2**30 - memory.shared) / memory.own))
    if device is not None and device.gpus:
        fitting = int(min(gpu.memory for gpu in device.gpus) / memory.gpu)
        max_workers = min(max_workers, len(device.gpus) * min(fitting, MAX_CLIENTS))
    return max(1, max_workers)


def _affordable_helpers(workers: int, memory: WorkerMemory) -> int:
    """Return the number of helpers for which cores and unused memory suffice beside the workers."""
    room = (unused_memory() * 2**30 - memory.shared - workers * memory.own) / _HELPER_MEMORY
    return min(max(1, usable_cores() - workers), max(0, int(room)))


def run_pool(
    pool: Pool[Result], layouts: Mapping[int, Sequence[int]], max_workers: int, note: Note, *, grow: bool = False
) -> Generator[Result]:
    """Distribute all frames over the pool's workers and yield the results in order of completion.

    A worker gets its next frame when it has finished one, so that results do not accumulate while the caller is busy. A
    lost worker is replaced only if it was the last one, because exhausted memory is the most likely cause, or on newly
    joined machines. A worker that reports exhausted memory is replaced only if another worker has gone since it began
    the frame.

    Args:
        pool: Pool that starts the workers and receives their answers.
        layouts: Frame indices by layout.
        max_workers: Maximum number of workers; at most one per frame is started.
        note: Callback that receives a short description of the current operation.
        grow: Begin with one worker, and start the next one only while the last one sped up the run.

    Raises:
        InputError, MissingResourceError, FrameError, LostWorkersError: As :func:`run_frames`.
    """
    plan = _Plan(layouts)
    max_workers = min(max_workers, plan.left)
    growth = _Growth(max_workers)
    losses: Counter[int] = Counter()
    at_work: dict[int, tuple[int, float]] = {}  # frame, and the time when it was assigned
    gone = 0
    live_workers: dict[int, int] = {}  # value: number of lost workers when it got its frame

    def assign(worker: int) -> None:
        live_workers[worker] = gone
        if (task := plan.take(worker)) is not None:
            at_work[worker] = task[1], time.monotonic()
            pool.send_frame(worker, task[1], task[0])

    for _ in range(min(1, max_workers) if grow else max_workers):
        assign(pool.start())
    while at_work:
        for worker, answer in pool.wait():
            if isinstance(answer, Status):
                note(answer.text)
                continue
            if worker not in at_work:
                live_workers.pop(worker, None)  # died while idle
                continue
            frame, begin = at_work.pop(worker)
            if isinstance(answer, Failure) and not answer.exhausted:
                raise answer.error(frame)
            if isinstance(answer, Failure):
                plan.put_back(worker, frame)
                pool.stop(worker)
                grow = False
                if live_workers.pop(worker) < gone:  # the missing memory may be free now
                    assign(pool.start())
                    continue
                if not live_workers:
                    raise _memory_error(frame, answer.message)
                gone += 1
                left = f"{len(live_workers)} worker{'s' * (len(live_workers) > 1)}"
                note(f"memory ran out in frame {frame}, which is repeated with {left}")
                if not at_work:
                    assign(next(iter(live_workers)))
                continue
            if isinstance(answer, Lost):
                del live_workers[worker]
                gone += 1
                losses[frame] += 1
                if losses[frame] == MAX_LOSSES:
                    raise LostWorkersError(
                        f"the worker of frame {frame} {answer.how}, {MAX_LOSSES} times in a row (out of memory?); "
                        "finished frames are kept"
                    )
                plan.put_back(worker, frame)
                note(f"the worker of frame {frame} {answer.how}: the frame is repeated")
                grow = False
                if not at_work:
                    assign(pool.start())
                continue
            if grow:
                match growth.judge(worker, len(at_work) + 1, begin, time.monotonic()):
                    case "start" if plan.left:
                        assign(pool.start())
                    case "stop":
                        grow = False
                        plan.leave(worker)
                        pool.stop(worker)
                        del live_workers[worker]
                        yield answer.result
                        continue
                    case "stay":
                        grow = False
            assign(worker)
            yield answer.result
        for _ in range(pool.free_slots()):
            if plan.left:
                assign(pool.start())


def _memory_error(frame: int, why: str) -> MissingResourceError:
    return MissingResourceError(f"frame {frame} cannot be made: {why}; finished frames are kept")


class _Plan:
    """Frames that are not yet assigned to a worker, by layout.

    A worker stays with its layout while that has frames. Then it takes the first unassigned layout. If there is none,
    it helps with the layout that has most frames left. Each operation costs O(log layouts): heap entries may be
    outdated, and are checked when they reach the top.

    Args:
        layouts: Frames of each layout, in order.
    """

    def __init__(self, layouts: Mapping[int, Sequence[int]]) -> None:
        self.waiting = {layout: deque(frames) for layout, frames in layouts.items() if frames}
        self.left = sum(map(len, self.waiting.values()))
        self._layouts: dict[int, int] = {}
        self._workers: Counter[int] = Counter()
        self._order = {layout: order for order, layout in enumerate(self.waiting)}
        self._entered = len(self._order)
        self._free = [(order, layout) for layout, order in self._order.items()]
        self._longest = [(-len(self.waiting[layout]), order, layout) for order, layout in self._free]
        heapify(self._longest)

    def take(self, worker: int) -> tuple[int, int] | None:
        """Return the next (layout, frame) for a worker, or None if all frames are assigned."""
        if not self.waiting:
            return None
        layout = self._layouts.get(worker)
        if layout is None or layout not in self.waiting:
            if layout is not None:
                self._workers[layout] -= 1
            layout = self._first_free() if self._free else None
            if layout is None:
                layout = self._longest_left()
            self._layouts[worker] = layout
            self._workers[layout] += 1
        frames = self.waiting[layout]
        frame = frames.popleft()
        self.left -= 1
        if not frames:
            del self.waiting[layout], self._order[layout]
        return layout, frame

    def put_back(self, worker: int, frame: int) -> None:
        """Return the frame of a lost worker to the plan."""
        layout = self._layouts[worker]
        if layout not in self.waiting:  # append the layout at the end
            self.waiting[layout] = deque()
            self._order[layout] = self._entered
            self._entered += 1
        self.waiting[layout].appendleft(frame)
        self.left += 1
        heappush(self._longest, (-len(self.waiting[layout]), self._order[layout], layout))
        self.leave(worker)

    def leave(self, worker: int) -> None:
        """Remove a worker that has gone."""
        layout = self._layouts.pop(worker)
        self._workers[layout] -= 1
        if layout in self.waiting and not self._workers[layout]:
            heappush(self._free, (self._order[layout], layout))

    def _first_free(self) -> int | None:
        while self._free:
            order, layout = heappop(self._free)
            if self._order.get(layout) == order and not self._workers[layout]:
                return layout
        return None

    def _longest_left(self) -> int:
        while True:
            length, order, layout = self._longest[0]
            if self._order.get(layout) != order:
                heappop(self._longest)
            elif -length != (left := len(self.waiting[layout])):
                heapreplace(self._longest, (-left, order, layout))
            else:
                return layout


class _Growth:
    """Decision about another worker, from the speeds with n and with n - 1 workers.

    The speed is the number of workers over the median time of a frame. The median ignores frames that take longer
    because they are the first of a layout or compile kernels.
    """

    def __init__(self, max_workers: int) -> None:
        self._max_workers = max_workers
        self._speed = 0.0
        self._count = 0
        self._warm: set[int] = set()
        self._since = 0.0
        self._seconds: list[float] = []

    def judge(self, worker: int, count: int, begin: float, now: float) -> str:
        """Evaluate a frame that one of ``count`` workers began at ``begin`` and has finished.

        Frames that began before every worker had finished its first one are ignored.

        Returns:
            "start", "stop", "stay" or "" (undecided).
        """
        if count != self._count:
            self._count, self._since, self._seconds = count, math.inf, []
        self._warm.add(worker)
        if len(self._warm) < count:
            return ""
        self._since = min(self._since, now)
        if begin >= self._since:
            self._seconds.append(now - begin)
        if len(self._seconds) < _SPEED_WINDOW * count:
            return ""
        speed = count / median(self._seconds)
        if speed < MIN_SPEED_UP * self._speed:
            return "stop"
        self._speed = speed
        return "start" if count < self._max_workers else "stay"


class _Processes(Generic[Result]):
    """Worker processes on this machine.

    Nothing here waits for a worker that does not start. :mod:`multiprocessing` writes a process's start data into a
    pipe. It would wait forever for a process that dies before reading more than the pipe's capacity (64 KiB). The start
    data are therefore small, and the job itself is in a file, see :class:`SharedArrays`.
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
        pipe, far_end = self._spawn.Pipe()
        worker, self._count = self._count, self._count + 1
        load = Counter(self._taken.values())
        gpu = min(self._gpus, key=load.__getitem__, default=None)
        arguments = far_end, self._kind, self._threads, self._jobs
        with children_on_gpu(gpu, **self._environment):
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
        with children_on_gpu(None, **{VISIBLE_GPUS: ""}):
            self._helpers.append(self._start_process(name, _help, (self._jobs,)))

    def _start_process(self, name: str, target: Callable[..., None], arguments: Any) -> BaseProcess:
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
        process, pipe = self._workers.pop(worker)
        self._taken.pop(worker, None)
        self._starting.pop(worker, None)
        process.kill()  # SIGKILL also ends a suspended process
        process.join()
        pipe.close()

    def send_frame(self, worker: int, frame: int, layout: int) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # a dead worker is detected when its answer is received
            self._workers[worker][1].send(frame)

    def wait(self) -> Iterator[tuple[int, Answer[Result]]]:
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
                how = _describe_end(process)
                self.stop(worker)
                yield worker, Lost(how)
                continue
            if isinstance(answer, Started):
                self._starting.pop(worker, None)
            else:
                yield worker, answer

    def free_slots(self) -> int:
        return 0

    def close(self) -> None:
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
