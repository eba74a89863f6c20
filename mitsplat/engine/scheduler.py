"""Distribution of frames over the workers of a pool, and their repetition after a loss."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Generator, Mapping, Sequence

from mitsplat.engine.answers import Failure, Lost, LostWorkersError, Pool, Result, Status
from mitsplat.engine.frame_queue import FrameQueue
from mitsplat.engine.worker_growth import WorkerGrowth
from mitsplat.errors import MissingResourceError
from mitsplat.progress import Note

MAX_LOSSES = 3
"""Maximum number of workers that one frame may terminate before the run is aborted."""


def run_pool(
    pool: Pool[Result], layouts: Mapping[int, Sequence[int]], max_workers: int, note: Note, *, grow: bool = False
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
        grow: Begin with one worker, and start the next one only while the last one sped up the run.

    Raises:
        InputError, MissingResourceError, FrameError, LostWorkersError: As :func:`mitsplat.engine.pool.run_frames`.
    """
    queue = FrameQueue(layouts)
    max_workers = min(max_workers, queue.left)
    growth = WorkerGrowth(max_workers)
    losses: Counter[int] = Counter()
    at_work: dict[int, tuple[int, float]] = {}  # frame, and the time when it was assigned
    gone = 0
    gone_at_start: dict[int, int] = {}  # by live worker: number of workers gone when it got its frame

    def assign(worker: int) -> None:
        gone_at_start[worker] = gone
        if (task := queue.take(worker)) is not None:
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
                gone_at_start.pop(worker, None)  # died while idle
                continue
            frame, begin = at_work.pop(worker)
            if isinstance(answer, Failure) and not answer.exhausted:
                raise answer.error(frame)
            if isinstance(answer, Failure):
                queue.put_back(worker, frame)
                pool.stop(worker)
                grow = False
                if gone_at_start.pop(worker) < gone:  # the missing memory may be free now
                    assign(pool.start())
                    continue
                if not gone_at_start:
                    raise memory_error(frame, answer.message)
                gone += 1
                left = f"{len(gone_at_start)} worker{'s' * (len(gone_at_start) > 1)}"
                note(f"memory ran out in frame {frame}, which is repeated with {left}")
                if not at_work:
                    assign(next(iter(gone_at_start)))
                continue
            if isinstance(answer, Lost):
                del gone_at_start[worker]
                gone += 1
                losses[frame] += 1
                if losses[frame] == MAX_LOSSES:
                    raise LostWorkersError(
                        f"the worker of frame {frame} {answer.how}, {MAX_LOSSES} times in a row (out of memory?); "
                        "finished frames are kept"
                    )
                queue.put_back(worker, frame)
                note(f"the worker of frame {frame} {answer.how}: the frame is repeated")
                grow = False
                if not at_work:
                    assign(pool.start())
                continue
            if grow:
                match growth.decide(worker, len(at_work) + 1, begin, time.monotonic()):
                    case "start" if queue.left:
                        assign(pool.start())
                    case "stop":
                        grow = False
                        queue.leave(worker)
                        pool.stop(worker)
                        del gone_at_start[worker]
                        yield answer.result
                        continue
                    case "stay":
                        grow = False
            assign(worker)
            yield answer.result
        for _ in range(pool.free_slots()):
            if queue.left:
                assign(pool.start())


def memory_error(frame: int, why: str) -> MissingResourceError:
    """Return the exception for a frame for which memory does not suffice."""
    return MissingResourceError(f"frame {frame} cannot be made: {why}; finished frames are kept")
