"""Run frames here or in worker processes: any worker, any order, the same bytes.

A frame is decided by (seed, frame index) alone, so the engine is free to order them. It gives each worker all frames
of one layout in turn, which lets different layouts settle side by side and a worker keep what its layout needs.
"""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Protocol, TypeVar

from mitsplat.errors import InputError

Made = TypeVar("Made", covariant=True)
Result = TypeVar("Result")
Note = Callable[[str], None]
"""Takes a few words on what is being done now."""


class MakeFrame(Protocol[Made]):
    """Makes one frame; picklable where worker processes are used."""

    def __call__(self, index: int, note: Note, /) -> Made:
        """Make frame ``index``."""


class FrameError(RuntimeError):
    """A worker process failed; the sentence names the frame, and a note holds the worker's traceback."""


def run_frames(
    make: MakeFrame[Result], layouts: Mapping[int, Sequence[int]], *, workers: int = 1, note: Note
) -> Generator[Result]:
    """Results of ``make`` for every frame, in the order in which they are finished.

    Args:
        make: Makes one frame. With workers it is sent to each of them once, by spawning: a script that gets here must
            guard its main part by ``if __name__ == "__main__"``.
        layouts: The frames to make, by layout.
        workers: Processes to use; 1 makes the frames in this process.
        note: Hears what is being done.

    Raises:
        InputError: If a frame finds its input at fault.
        FrameError: If a worker fails otherwise or dies. Workers are stopped before anything is raised, and when the
            iterator is closed.
    """
    if workers < 1:
        raise InputError(f"workers must be at least 1 (got {workers})")
    waiting = {layout: deque(frames) for layout, frames in layouts.items() if frames}
    workers = min(workers, sum(map(len, waiting.values())))
    if workers <= 1:
        for frames in waiting.values():
            for index in frames:
                yield make(index, note)
        return
    with closing(_run_in_processes(make, waiting, workers, note)) as results:
        yield from results


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    layout: int | None = None
    frame: int | None = None

    def give(self, waiting: dict[int, deque[int]], taken: set[int]) -> None:
        """Send the next frame: of this worker's layout, of one nobody has taken, or of that with most left to do."""
        self.frame = None
        if not waiting:
            return
        if self.layout not in waiting:
            free = [layout for layout in waiting if layout not in taken]
            self.layout = free[0] if free else max(waiting, key=lambda layout: len(waiting[layout]))
            taken.add(self.layout)
        frames = waiting[self.layout]
        self.frame = frames.popleft()
        if not frames:
            del waiting[self.layout]
        with suppress(BrokenPipeError):  # a worker that died is found, and named, when its answer is received
            self.pipe.send(self.frame)


def _run_in_processes(
    make: MakeFrame[Result], waiting: dict[int, deque[int]], count: int, note: Note
) -> Generator[Result]:
    spawn = multiprocessing.get_context("spawn")
    workers: list[_Worker] = []
    taken: set[int] = set()
    try:
        for number in range(count):
            pipe, far_end = spawn.Pipe()
            process = spawn.Process(target=_work, args=(far_end, make), name=f"mitsplat-{number}", daemon=True)
            process.start()
            far_end.close()  # so that the death of the worker ends the pipe
            workers.append(_Worker(process, pipe))
            workers[-1].give(waiting, taken)
        while busy := [worker for worker in workers if worker.frame is not None]:
            ready = wait([worker.pipe for worker in busy])
            for worker in busy:
                if worker.pipe not in ready:
                    continue
                answer: str | tuple[Result] = _receive(worker)
                if isinstance(answer, str):
                    note(answer)
                    continue
                worker.give(waiting, taken)
                yield answer[0]
    finally:
        for worker in workers:
            worker.process.terminate()
        for worker in workers:
            worker.process.join()
            worker.pipe.close()


def _receive(worker: _Worker) -> str | tuple[Result]:
    """A note, or the result of a frame in a tuple."""
    try:
        answer = worker.pipe.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join()
        code = worker.process.exitcode or 0
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
        raise FrameError(
            f"the process making frame {worker.frame} {how} (out of memory?); finished frames are kept"
        ) from None
    if isinstance(answer, _Failure):
        raise answer.error(worker.frame)
    return answer  # type: ignore[no-any-return]


@dataclass(frozen=True)
class _Failure:
    """What went wrong in a worker, as text: not every exception can be pickled."""

    bad_input: bool
    kind: str
    message: str
    trace: str

    def error(self, frame: int | None) -> Exception:
        if self.bad_input:
            return InputError(self.message)
        error = FrameError(f"frame {frame} failed: {self.kind}: {self.message}")
        error.add_note(self.trace)
        return error


def _work(pipe: Connection, make: MakeFrame[Result]) -> None:
    """Main function of a worker: frames come in, notes and results go out, until it is stopped."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which stops its workers
    with suppress(EOFError, BrokenPipeError):
        while True:
            index = pipe.recv()
            try:
                result = make(index, pipe.send)
            except Exception as error:  # noqa: BLE001 - the parent raises it
                pipe.send(
                    _Failure(isinstance(error, InputError), type(error).__name__, str(error), traceback.format_exc())
                )
            else:
                pipe.send((result,))
