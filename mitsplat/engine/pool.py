"""Run frames here, in worker processes or on a cluster: any worker, any order, the same bytes.

A frame is decided by (seed, frame index) alone, so the engine is free to order them. It gives each worker all frames
of one layout in turn, which lets different layouts settle side by side and a worker keep what its layout needs. A frame
whose worker is lost is made again by another.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush, heapreplace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, Protocol, TypeVar

from mitsplat.engine.mps import MOST_CLIENTS, SharedGpu
from mitsplat.engine.resources import TYPICAL, WorkerMemory, unused_memory
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
from mitsplat.runtime.child_process import starting_safely
from mitsplat.runtime.cores import usable_cores
from mitsplat.runtime.device import Device, Gpu, Kind, current_device, starting_on, use_device, use_share
from mitsplat.storage.cache import prepare_caches

Made = TypeVar("Made", covariant=True)
Result = TypeVar("Result")

MOST_LOSSES = 3
"""Workers that one frame may cost before the run gives up."""

WORTHWHILE = 1.1
"""Gain in speed for which another worker stays, when their number is left to the engine."""

_WINDOW = 6
"""Frames of each worker over which speed is measured."""
_FEW = 16
"""Frames up to which starting worker processes does not pay."""

_START = 300.0
"""Time limit for the start of a worker [s]: on an idle machine it takes about two seconds of imports."""

_LOOK = 1.0
"""Interval at which the start of workers is timed [s]."""

_END = 30.0
"""Time limit for the end of a worker that has closed its pipe [s]."""

_SENTENCES: tuple[type[Exception], ...] = (InputError, MissingResourceError, PartialResultError)


class MakeFrame(Protocol[Made]):
    """Makes one frame; picklable where worker processes are used."""

    def __call__(self, index: int, note: Note, /) -> Made:
        """Make frame ``index``."""


class FrameError(RuntimeError):
    """Making a frame failed in a worker; the sentence names the frame, and a note holds the worker's traceback."""


class LostWorkersError(PartialResultError):
    """A frame ended the process of every worker that tried it; finished frames are kept."""


@dataclass(frozen=True)
class Status:
    """What a worker is doing."""

    text: str


@dataclass(frozen=True)
class Finished(Generic[Result]):
    """A worker's frame is made."""

    result: Result


@dataclass(frozen=True)
class Failure:
    """What went wrong in a worker, as text: not every exception can be pickled.

    Attributes:
        sentence: The class, if it is one whose message is for the user.
        exhausted: Whether memory has run out.
    """

    sentence: type[Exception] | None
    kind: str
    message: str
    trace: str
    exhausted: bool = False

    @classmethod
    def of(cls, error: Exception) -> Failure:
        """The failure that the exception being handled is."""
        sentence = next((kind for kind in _SENTENCES if isinstance(error, kind)), None)
        if sentence is None:  # what ends the command line with the same status
            sentence = {2: InputError, 3: MissingResourceError}.get(exit_status(error) or 0)
        return cls(sentence, type(error).__name__, sentence_of(error), traceback.format_exc(), is_out_of_memory(error))

    def error(self, frame: int) -> Exception:
        """The exception to raise for it where the frames are wanted."""
        if self.sentence is not None:
            return self.sentence(self.message)
        error = FrameError(f"frame {frame} failed: {self.kind}: {self.message}")
        error.add_note(self.trace)
        return error


@dataclass(frozen=True)
class Lost:
    """A worker is gone, with its frame; ``how`` continues "the process making frame 3 ..."."""

    how: str


@dataclass(frozen=True)
class Started:
    """A worker has been started, and takes frames now."""


Answer = Status | Finished[Result] | Failure | Lost


class Pool(Protocol[Result]):
    """Workers, known by their numbers, each of which makes one frame at a time."""

    def start(self) -> int:
        """Start a worker."""

    def stop(self, worker: int) -> None:
        """Stop a worker."""

    def give(self, worker: int, frame: int, layout: int) -> None:
        """Have an idle worker make a frame."""

    def wait(self) -> Iterator[tuple[int, Answer[Result]]]:
        """Wait for answers; those that came, perhaps none."""

    def openings(self) -> int:
        """How many workers there is room for that there was not before; each is told of once."""

    def close(self) -> None:
        """Stop all workers."""


def check_workers(workers: int | None) -> None:
    """Refuse fewer than one.

    Raises:
        InputError: If there are.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1 (got {workers})")


def run_frames(
    make: MakeFrame[Result],
    layouts: Mapping[int, Sequence[int]],
    *,
    workers: int | None = 1,
    note: Note,
    memory: WorkerMemory = TYPICAL,
    device: Device | None = None,
) -> Generator[Result]:
    """Results of ``make`` for every frame, in the order in which they are finished.

    Args:
        make: Makes one frame. With workers it is sent to each of them once, by spawning: a script that gets here must
            guard its main part by ``if __name__ == "__main__"``.
        layouts: The frames to make, by layout.
        workers: Processes to use; 1 makes the frames in this process if that can compute on the device. None is as many
            as turn out to pay on CPUs, and at once as many as there are cores and memory for on GPUs.
        note: Hears what is being done.
        memory: What a worker takes, by which their number is limited if it is left to the engine.
        device: What frames are computed on; each worker takes it first, one of the GPUs in turn. None for work that
            does without.

    Raises:
        InputError: If a frame finds its input at fault.
        MissingResourceError: If a frame does not fit into memory that a worker has for itself.
        FrameError: If a frame fails otherwise in a worker.
        LostWorkersError: If :data:`MOST_LOSSES` workers died of one frame. Workers are stopped before anything is
            raised, and when the iterator is closed.
    """
    check_workers(workers)
    total = sum(map(len, layouts.values()))
    most = affordable_workers(memory, device) if workers is None else workers
    few = min(most, total) <= 1 or (workers is None and total <= _FEW)
    if few and (device is None or device.is_here):
        if device is not None and device != current_device():
            use_device(device)
        for frames in layouts.values():
            for index in frames:
                try:
                    made = make(index, note)
                except (RuntimeError, MemoryError) as error:
                    if is_out_of_memory(error):
                        raise _too_large(index, sentence_of(error)) from error
                    raise
                yield made
        return
    if few:
        most = 1
    # Starting workers one by one would take longer on a GPU than most runs do.
    grow = workers is None and (device is None or not device.gpus)
    shares = device is not None and 0 < len(device.gpus) < min(most, total)
    with closing(SharedGpu()) if shares else nullcontext() as shared:
        if shared is not None and shared.lack:
            note(f"workers take turns on the GPU, because {shared.lack}")
        with (
            closing(_Processes(make, device, {} if shared is None else shared.environment)) as pool,
            closing(run_pool(pool, layouts, most, note, grow=grow)) as found,
        ):
            yield from found


def run_apart(make: MakeFrame[Result], device: Device | None = None) -> Generator[Result]:
    """The result of ``make`` for frame 0, in a process of its own.

    Raises:
        InputError, MissingResourceError, FrameError, LostWorkersError: As :func:`run_frames`.
    """
    with closing(_Processes(make, device)) as pool:
        yield from run_pool(pool, {0: [0]}, 1, lambda text: None)


def affordable_workers(memory: WorkerMemory, device: Device | None = None) -> int:
    """Most worker processes that this machine has cores and unused memory for, and its GPUs memory, at least 1."""
    most = min(usable_cores(), int((unused_memory() * 2**30 - memory.shared) / memory.own))
    if device is not None and device.gpus:
        held = int(min(gpu.memory for gpu in device.gpus) / memory.gpu)
        most = min(most, len(device.gpus) * min(held, MOST_CLIENTS))
    return max(1, most)


def run_pool(
    pool: Pool[Result], layouts: Mapping[int, Sequence[int]], most: int, note: Note, *, grow: bool = False
) -> Generator[Result]:
    """Results of the pool's workers for every frame, in the order in which they are finished.

    A worker gets its next frame when it has finished one, so results do not pile up while the caller is busy. A lost
    one is replaced only if it was the last, because memory is what it most likely died of, or where machines join. One
    that says that memory has run out is replaced only if another one has gone since it began the frame.

    Args:
        pool: Starts and hears the workers.
        layouts: The frames to make, by layout.
        most: Workers to start, at most one per frame.
        note: Hears what is being done.
        grow: Begin with one worker, and start the next only when the last one made the run faster.

    Raises:
        InputError, MissingResourceError, FrameError, LostWorkersError: As :func:`run_frames`.
    """
    plan = _Plan(layouts)
    most = min(most, plan.left)
    growth = _Growth(most)
    losses: Counter[int] = Counter()
    at_work: dict[int, int] = {}
    gone = 0
    staff: dict[int, int] = {}  # and how many others had gone when each was given its frame

    def assign(worker: int) -> None:
        staff[worker] = gone
        if (task := plan.take(worker)) is not None:
            at_work[worker] = task[1]
            pool.give(worker, task[1], task[0])

    for _ in range(min(1, most) if grow else most):
        assign(pool.start())
    while at_work:
        for worker, answer in pool.wait():
            if isinstance(answer, Status):
                note(answer.text)
                continue
            if worker not in at_work:
                staff.pop(worker, None)  # died while there was nothing to do for it
                continue
            frame = at_work.pop(worker)
            if isinstance(answer, Failure) and not answer.exhausted:
                raise answer.error(frame)
            if isinstance(answer, Failure):
                plan.put_back(worker, frame)
                pool.stop(worker)
                grow = False
                if staff.pop(worker) < gone:  # what it lacked may be free by now
                    assign(pool.start())
                    continue
                if not staff:
                    raise _too_large(frame, answer.message)
                gone += 1
                left = f"{len(staff)} worker{'s' * (len(staff) > 1)}"
                note(f"memory has run out for frame {frame}: it is made again with {left}")
                if not at_work:
                    assign(next(iter(staff)))
                continue
            if isinstance(answer, Lost):
                del staff[worker]
                gone += 1
                losses[frame] += 1
                if losses[frame] == MOST_LOSSES:
                    raise LostWorkersError(
                        f"the process making frame {frame} {answer.how}, {MOST_LOSSES} times (out of memory?); "
                        "finished frames are kept"
                    )
                plan.put_back(worker, frame)
                note(f"the process making frame {frame} {answer.how}: it is made again")
                grow = False
                if not at_work:
                    assign(pool.start())
                continue
            if grow:
                match growth.judge(worker, len(at_work) + 1, time.monotonic()):
                    case "start" if plan.left:
                        assign(pool.start())
                    case "stop":
                        grow = False
                        plan.leave(worker)
                        pool.stop(worker)
                        del staff[worker]
                        yield answer.result
                        continue
                    case "stay":
                        grow = False
            assign(worker)
            yield answer.result
        for _ in range(pool.openings()):
            if plan.left:
                assign(pool.start())


def _too_large(frame: int, why: str) -> MissingResourceError:
    return MissingResourceError(f"frame {frame} cannot be made: {why}; finished frames are kept")


class _Plan:
    """Which frames are still to be given to a worker, by layout.

    A worker keeps to its layout while that has frames, then takes the first that nobody has, and when there is none
    helps with that which has most left. Each costs O(log layouts): heaps hold what was so when it was entered, which is
    looked at again when it comes to the top.

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
        """Layout and frame: of the worker's layout, of one nobody has taken, or of that with most left to do."""
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
        """The worker is gone, and its frame is to be made again."""
        layout = self._layouts[worker]
        if layout not in self.waiting:  # now the last
            self.waiting[layout] = deque()
            self._order[layout] = self._entered
            self._entered += 1
        self.waiting[layout].appendleft(frame)
        self.left += 1
        heappush(self._longest, (-len(self.waiting[layout]), self._order[layout], layout))
        self.leave(worker)

    def leave(self, worker: int) -> None:
        """The worker is gone."""
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
    """Whether another worker pays, by the frames finished per second with so many and with one fewer."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._speed = 0.0
        self._count = 0
        self._warm: set[int] = set()
        self._finished = 0
        self._since = 0.0

    def judge(self, worker: int, count: int, now: float) -> str:
        """What follows from a frame that one of ``count`` workers finished: start, stop, stay or "" for nothing yet.

        The first frame of each is not counted: it waits for imports, compilation and a layout.
        """
        if count != self._count:
            self._count, self._finished = count, -1
        self._warm.add(worker)
        if len(self._warm) < count:
            return ""
        self._finished += 1
        if self._finished == 0:
            self._since = now
        if self._finished < _WINDOW * count:
            return ""
        speed = self._finished / (now - self._since)
        if speed < WORTHWHILE * self._speed:
            return "stop"
        self._speed = speed
        return "start" if count < self._most else "stay"


class _Processes(Generic[Result]):
    """Workers that are processes of this machine.

    Nothing here waits for a worker that does not start. :mod:`multiprocessing` writes what a process begins with into a
    pipe, and would wait for ever for a process that is gone before it has read more than the pipe holds (64 KiB): so
    that is little, and the work itself is in a file, see :class:`SharedArrays`.
    """

    def __init__(
        self, make: MakeFrame[Result], device: Device | None, environment: Mapping[str, str] | None = None
    ) -> None:
        prepare_caches()  # workers inherit the folders
        self._make = SharedArrays(make)
        self._environment = environment or {}
        self._kind = None if device is None else device.kind
        self._gpus = () if device is None else device.gpus
        self._taken: dict[int, Gpu] = {}
        self._spawn = multiprocessing.get_context("spawn")
        self._workers: dict[int, tuple[BaseProcess, Connection]] = {}
        self._starting: dict[int, float] = {}
        self._count = 0

    def start(self) -> int:
        pipe, far_end = self._spawn.Pipe()
        worker, self._count = self._count, self._count + 1
        arguments = far_end, self._kind, self._make
        process = self._spawn.Process(target=_work, args=arguments, name=f"mitsplat-{worker}", daemon=True)
        load = Counter(self._taken.values())
        gpu = min(self._gpus, key=load.__getitem__, default=None)
        with starting_safely(), starting_on(gpu, **self._environment):
            resource_tracker.ensure_running()  # starting it with the first worker would unblock what is blocked here
            # Ctrl-C goes to all processes of a terminal, but is for this one only: workers inherit what is blocked.
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                process.start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        far_end.close()  # so that the death of the worker ends the pipe
        self._workers[worker] = process, pipe
        self._starting[worker] = _START
        if gpu is not None:
            self._taken[worker] = gpu
        return worker

    def stop(self, worker: int) -> None:
        process, pipe = self._workers.pop(worker)
        self._taken.pop(worker, None)
        self._starting.pop(worker, None)
        process.kill()  # a signal that also ends a stopped process
        process.join()
        pipe.close()

    def give(self, worker: int, frame: int, layout: int) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # a worker that died is found when its answer is received
            self._workers[worker][1].send(frame)

    def wait(self) -> Iterator[tuple[int, Answer[Result]]]:
        begun = time.monotonic()
        ready = set(wait([pipe for _, pipe in self._workers.values()], _LOOK if self._starting else None))
        # No more than an interval counts: this process may have been stopped, and its workers with it.
        waited = min(time.monotonic() - begun, _LOOK)
        for worker, (process, pipe) in list(self._workers.items()):
            if pipe not in ready:
                if worker in self._starting:
                    self._starting[worker] -= waited
                    if self._starting[worker] <= 0:
                        self.stop(worker)
                        yield worker, Lost(f"did not start within {_START:g} s")
                continue
            try:
                answer = pipe.recv()
            except (EOFError, OSError):
                how = _ending(process)
                self.stop(worker)
                yield worker, Lost(how)
                continue
            if isinstance(answer, Started):
                self._starting.pop(worker, None)
            else:
                yield worker, answer

    def openings(self) -> int:
        return 0

    def close(self) -> None:
        for process, _ in self._workers.values():
            process.kill()
        for worker in list(self._workers):
            self.stop(worker)
        self._make.close()


def _ending(process: BaseProcess) -> str:
    """How a process has ended that has closed its pipe."""
    process.join(_END)
    code = process.exitcode
    if code is None:
        return "answers no more"
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"


def _work(pipe: Connection, device: Kind | None, make: MakeFrame[Result]) -> None:
    """Main function of a worker: frames come in, notes and results go out, until it is stopped."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, BrokenPipeError):
        pipe.send(Started())
        while True:
            index = pipe.recv()
            try:
                if device is not None:
                    try:
                        use_share(device)
                    except (ImportError, RuntimeError, MissingResourceError) as error:
                        if device == "cpu":
                            raise
                        # Others have taken its memory since the run began, or one has brought it down for all.
                        pipe.send(replace(Failure.of(error), exhausted=True))
                        continue
                    device = None
                pipe.send(Finished(make(index, lambda text: pipe.send(Status(text)))))
            except Exception as error:  # noqa: BLE001 - the parent raises it
                pipe.send(Failure.of(error))


def _end_with_parent() -> None:
    """End this process when its parent is killed: its folder is another run's from then on."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
