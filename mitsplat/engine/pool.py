"""Scheduler of frames: in this process, in worker processes or on a cluster, with identical bytes in every case.

A frame depends only on (seed, frame index), so the scheduler may choose any order. Each worker gets all frames of one
layout in turn. Different layouts thus settle in parallel, and a worker can cache the data of its layout. A frame whose
worker is lost is made again by another worker.

Helper processes of low priority prepare later layouts on cores that the workers leave idle. Their results only save
time: a worker that needs an unprepared layout prepares it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, nullcontext
from functools import partial

from mitsplat.arguments import check_whole_number
from mitsplat.engine.answers import Result
from mitsplat.engine.mps import MAX_CLIENTS, SharedGpu
from mitsplat.engine.resources import TYPICAL_MEMORY, WorkerMemory, unused_memory
from mitsplat.engine.scheduler import memory_error, run_pool
from mitsplat.engine.worker_processes import MakeFrame, WorkerProcesses
from mitsplat.errors import InputError, is_out_of_memory, sentence_of
from mitsplat.progress import Note, discard_note
from mitsplat.runtime.cores import usable_cores
from mitsplat.runtime.device import Device, current_device, use_device

_HELPER_MEMORY = 2**30
"""Maximum memory of a helper process [bytes]."""

CORES_PER_WORKER = 2
"""Cores that the threads of a worker on a CPU keep busy. On two cores, two workers were not faster than one.

Threads wait for work by repeated tests. A worker with four threads for each core takes 2.2 times the CPU time per frame
(``scenes/workcell.yaml``).
"""

_MAX_SERIAL_FRAMES = 16
"""Number of frames up to which worker processes are not worth their start-up time."""

Prepare = Callable[[Sequence[int]], object]
"""Function that prepares layouts in the given order and skips those in preparation elsewhere; must be picklable."""


def check_workers(workers: int | None) -> None:
    """Check that a number of workers is None or at least 1.

    Raises:
        InputError: If it is less than 1.
    """
    if workers is None:
        return
    check_whole_number(workers, "workers")
    if workers < 1:
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
            the number that cores and memory allow. Workers on a CPU share the cores.
        note: Callback that receives a short description of the current operation.
        memory: Memory of a worker, which limits an automatic number of workers.
        device: Device for the frames; each worker selects it first, and several GPUs are assigned in turn. None for
            work without a device.
        prepare: Function that helper processes call with the layouts that the workers do not begin with. Its
            failures are ignored, because ``make`` prepares what is missing.

    Raises:
        InputError: If the input of a frame is invalid.
        MissingResourceError: If the memory does not suffice for a frame in a single worker.
        FrameError: If a frame fails otherwise in a worker.
        LostWorkersError: If :data:`mitsplat.engine.scheduler.MAX_LOSSES` workers died while making the same frame.

    Workers are stopped before any exception is raised, and when the iterator is closed.
    """
    check_workers(workers)
    total = sum(map(len, layouts.values()))
    max_workers = min(affordable_workers(memory, device) if workers is None else workers, max(1, total))
    later = list(layouts)[max_workers:]  # the workers begin with the others
    worthwhile = prepare is not None and total > _MAX_SERIAL_FRAMES and workers != 1
    helpers = min(len(later), _affordable_helpers(max_workers, memory)) if worthwhile else 0
    serial = total <= 1 or max_workers + helpers <= 1 or (workers is None and total <= _MAX_SERIAL_FRAMES)
    if serial and (device is None or device.is_usable_here):
        yield from _make_here(make, layouts, note, device)
        return
    if serial:
        max_workers = 1
    shares = device is not None and 0 < len(device.gpus) < max_workers
    with closing(SharedGpu()) if shares else nullcontext() as shared:
        if shared is not None and shared.problem:
            note(f"workers take turns on the GPU, because {shared.problem}")
        environment = {} if shared is None else shared.environment
        with (
            closing(
                WorkerProcesses(
                    make,
                    device,
                    environment,
                    partial(prepare, later) if prepare else None,
                    max(1, usable_cores() // max_workers),
                )
            ) as pool,
            closing(run_pool(pool, layouts, max_workers, note)) as found,
        ):
            for _ in range(helpers):
                pool.start_helper()
            yield from found


def _make_here(
    make: MakeFrame[Result], layouts: Mapping[int, Sequence[int]], note: Note, device: Device | None
) -> Generator[Result]:
    """Make the frames one after the other in this process."""
    if device is not None and device != current_device():
        use_device(device)
    for frames in layouts.values():
        for index in frames:
            try:
                made = make(index, note)
            except (RuntimeError, MemoryError) as error:
                if is_out_of_memory(error):
                    raise memory_error(index, sentence_of(error)) from error
                raise
            yield made


def run_in_process(make: MakeFrame[Result], device: Device | None = None) -> Result:
    """Call ``make`` for frame 0 in a separate process and return the result.

    Raises:
        InputError, MissingResourceError, FrameError, LostWorkersError: As :func:`run_frames`.
    """
    with closing(WorkerProcesses(make, device)) as pool, closing(run_pool(pool, {0: [0]}, 1, discard_note)) as results:
        return next(results)


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
