"""Distribution of frames over the workers of a pool, and their repetition after a loss."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from typing import Generic

from mitsplat.engine.answers import Failure, Lost, LostWorkersError, Result, Status, WorkerPool
from mitsplat.engine.frame_queue import FrameQueue
from mitsplat.errors import MissingResourceError
from mitsplat.progress import Note

MAX_LOSSES = 3
"""Maximum number of workers that one frame may terminate before the run is aborted."""


def run_pool(
    pool: WorkerPool[Result], layouts: Mapping[int, Sequence[int]], max_workers: int, note: Note
) -> Generator[Result]:
    """Distribute all frames over the pool's workers and yield the results in order of completion.

    A worker gets its next frame when it has finished one, so that results do not accumulate while the caller is busy. A
    lost worker is replaced only if no other worker has a frame, or if a machine has joined, because exhausted memory is
    the most likely cause. A worker that reports exhausted memory is replaced only if another worker has gone since it
    began the frame.

    Args:
        pool: Pool that starts the workers and receives their answers.
        layouts: Frame indices by layout.
        max_workers: Maximum number of workers; at most one per frame is started.
        note: Callback that receives a short description of the current operation.

    Raises:
        InputError, MissingResourceError, FrameError, LostWorkersError: As :func:`mitsplat.engine.pool.run_frames`.
    """
    yield from _Scheduler(pool, layouts, max_workers, note).run()


class _Scheduler(Generic[Result]):
    """State of a run, see :func:`run_pool`."""

    def __init__(
        self,
        pool: WorkerPool[Result],
        layouts: Mapping[int, Sequence[int]],
        max_workers: int,
        note: Note,
    ) -> None:
        self._pool, self._note = pool, note
        self._queue = FrameQueue(layouts)
        self._max_workers = min(max_workers, self._queue.left)
        self._losses: Counter[int] = Counter()
        self._at_work: dict[int, int] = {}  # frame by worker
        self._gone = 0
        self._gone_at_start: dict[int, int] = {}  # by live worker: number of workers gone when it got its frame

    def run(self) -> Generator[Result]:
        """Yield the results."""
        for _ in range(self._max_workers):
            self._assign(self._pool.start())
        while self._at_work:
            for worker, answer in self._pool.wait():
                if isinstance(answer, Status):
                    self._note(answer.text)
                elif worker not in self._at_work:
                    self._gone_at_start.pop(worker, None)  # died while idle
                elif isinstance(answer, Lost):
                    self._repeat_lost(worker, answer)
                elif isinstance(answer, Failure):
                    self._handle_failure(worker, answer)
                else:
                    del self._at_work[worker]
                    self._assign(worker)
                    yield answer.result
            for _ in range(self._pool.free_slots()):
                if self._queue.left:
                    self._assign(self._pool.start())

    def _assign(self, worker: int) -> None:
        """Send the next frame to an idle worker, if there is one."""
        self._gone_at_start[worker] = self._gone
        if (task := self._queue.take(worker)) is not None:
            layout, frame = task
            self._at_work[worker] = frame
            self._pool.send_frame(worker, frame, layout)

    def _repeat_lost(self, worker: int, lost: Lost) -> None:
        """Return the frame of a lost worker to the queue.

        Raises:
            LostWorkersError: If the frame has terminated :data:`MAX_LOSSES` workers.
        """
        frame = self._at_work.pop(worker)
        del self._gone_at_start[worker]
        self._gone += 1
        self._losses[frame] += 1
        if self._losses[frame] == MAX_LOSSES:
            raise LostWorkersError(
                f"the worker of frame {frame} {lost.how}, {MAX_LOSSES} times in a row ({lost.cause}); finished frames "
                "are kept"
            )
        self._queue.put_back(worker, frame)
        self._note(f"the worker of frame {frame} {lost.how}: the frame is repeated")
        if not self._at_work:
            self._assign(self._pool.start())

    def _handle_failure(self, worker: int, failure: Failure) -> None:
        """Repeat a frame for which memory did not suffice, with fewer workers; raise any other failure."""
        frame = self._at_work.pop(worker)
        if not failure.exhausted:
            raise failure.error(frame)
        self._queue.put_back(worker, frame)
        self._pool.stop(worker)
        if self._gone_at_start.pop(worker) < self._gone:  # the missing memory may be free now
            self._assign(self._pool.start())
            return
        if not self._gone_at_start:
            raise memory_error(frame, failure.message)
        self._gone += 1
        left = f"{len(self._gone_at_start)} worker{'s' * (len(self._gone_at_start) > 1)}"
        self._note(f"memory ran out in frame {frame}, which is repeated with {left}")
        if not self._at_work:
            self._assign(next(iter(self._gone_at_start)))


def memory_error(frame: int, why: str) -> MissingResourceError:
    """Return the exception for a frame for which memory does not suffice."""
    return MissingResourceError(f"frame {frame} cannot be made: {why}; finished frames are kept")
