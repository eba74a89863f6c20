"""Frames in worker processes: order, notes, and failed or killed workers."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import closing, suppress
from multiprocessing import resource_tracker, spawn
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsplat.engine import pool as engine
from mitsplat.engine import worker_processes
from mitsplat.engine.answers import Failure, Finished, FrameError, LostWorkersError, Started
from mitsplat.engine.frame_queue import FrameQueue
from mitsplat.engine.pool import run_frames
from mitsplat.engine.resources import TYPICAL_MEMORY
from mitsplat.engine.scheduler import run_pool
from mitsplat.engine.worker_processes import WorkerProcesses
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.runtime.device import CPU, Device, Gpu, MissingPrerequisite, visible_gpus
from tests.engine.jobs import (
    CommandLine,
    Greedy,
    KillOnce,
    Linger,
    Make,
    Prepare,
    Threads,
    Variant,
    WaitForHelper,
    ended,
    wait_for,
)

LAYOUTS = {0: [0, 1, 2], 1: [3, 4, 5], 2: [6, 7, 8]}


def run(make, workers=1, layouts=LAYOUTS, note=lambda text: None):
    with closing(run_frames(make, layouts, workers=workers, note=note)) as results:
        return list(results)


def test_one_worker_runs_in_this_process_in_order():
    assert run(Make()) == [(index, os.getpid()) for index in range(9)]


@pytest.mark.parametrize("workers", [2, pytest.param(4, marks=pytest.mark.extended)])
def test_workers_make_every_frame_once_and_leave_no_process(workers):
    notes = []
    made = run(Make(), workers, note=notes.append)
    assert sorted(index for index, _ in made) == list(range(9))
    processes = {process for _, process in made}
    assert os.getpid() not in processes
    assert sorted(notes) == [f"working on {index}" for index in range(9)]
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def test_each_worker_starts_with_its_own_layout():
    made = run(Make(), 2, {0: [0, 1, 2, 3], 1: [4, 5, 6, 7]})
    first = {index: process for index, process in made if index in (0, 4)}
    assert first[0] != first[4]


def test_there_are_no_more_workers_than_frames():
    assert run(Make(), 8, {0: [5]}) == [(5, os.getpid())]
    assert run(Make(), 8, {0: []}) == []


@pytest.mark.parametrize("workers", [1, 2])
def test_an_input_error_of_a_worker_keeps_its_sentence(workers):
    with pytest.raises(InputError, match=r"^no 4$"):
        run(Make(fail_at=4, how="input"), workers)


def test_another_exception_of_a_worker_names_the_frame_with_its_traceback():
    with pytest.raises(FrameError, match=r"^frame 4 failed: Unpicklable: no 4") as caught:
        run(Make(fail_at=4, how="bug"), 2)
    assert "in __call__" in caught.value.__notes__[0]


@pytest.mark.parametrize(("how", "words"), [("killed", "was killed by SIGKILL"), ("exits", "ended with status 3")])
def test_a_frame_that_kills_every_worker_ends_the_run(how, words):
    with pytest.raises(LostWorkersError, match=f"the worker of frame 4 {words}, 3 times"):
        run(Make(fail_at=4, how=how), 2)


@pytest.mark.parametrize("workers", [2, pytest.param(4, marks=pytest.mark.extended)])
def test_frames_of_lost_workers_are_made_by_others(tmp_path, workers):
    """Two frames kill the first process that renders them. Every frame is made once, and the losses are reported."""
    notes = []
    made = run(KillOnce(tmp_path, (1, 7)), workers, note=notes.append)
    assert sorted(made) == list(range(9))
    told = [note for note in notes if "repeated" in note]
    assert sorted(told) == [f"the worker of frame {i} was killed by SIGKILL: the frame is repeated" for i in (1, 7)]


def test_a_helper_prepares_the_layouts_that_no_worker_begins_with(tmp_path):
    layouts = {4: range(8), 5: range(8, 16), 7: [16], 9: [17]}
    with closing(
        run_frames(WaitForHelper(tmp_path), layouts, workers=2, note=print, prepare=Prepare(tmp_path))
    ) as results:
        assert sorted(results) == list(range(18))
    for path in tmp_path.iterdir():
        assert path.read_text() == "[7, 9] ''"
        assert ended(path.name)


@pytest.mark.parametrize(("cores", "gigabytes", "helpers"), [(2, 9, 1), (6, 64, 4), (6, 10.5, 2), (2, 8, 0)])
def test_the_number_of_helpers_is_bounded_by_cores_and_memory(monkeypatch, cores, gigabytes, helpers):
    """Two workers take 4 GiB each. A helper takes 1 GiB, and uses a core that has no worker, if there is one."""
    monkeypatch.setattr(engine, "unused_memory", lambda: float(gigabytes))
    monkeypatch.setattr(engine, "usable_cores", lambda: cores)
    assert engine._affordable_helpers(2, TYPICAL_MEMORY) == helpers


def test_a_worker_on_the_cpu_has_two_cores(monkeypatch):
    """On two cores, one worker renders beside a helper. Without layouts to prepare, no process is started."""
    monkeypatch.setattr(engine, "unused_memory", lambda: 64.0)
    monkeypatch.setattr(engine, "usable_cores", lambda: 2)
    began = []
    monkeypatch.setattr(engine, "run_pool", lambda *args: began.append(args[2]) or (i for i in ()))
    monkeypatch.setattr(WorkerProcesses, "start_helper", lambda pool: began.append("helper"))
    for layouts in ({0: range(20)}, {0: range(10), 1: range(10)}):
        list(run_frames(Variant(), layouts, workers=None, note=print, device=CPU, prepare=Prepare(Path())))
    assert began == [1, "helper"]


@pytest.mark.parametrize(("cores", "gigabytes", "workers", "threads"), [(8, 64, 4, 2), (9, 9, 2, 4), (6, 5, 1, 6)])
def test_automatic_workers_start_at_once_and_share_the_cores(monkeypatch, cores, gigabytes, workers, threads):
    """A worker takes 4 GiB. Threads that wait for work use CPU time, so that all workers together have one per core."""
    monkeypatch.setattr(engine, "unused_memory", lambda: float(gigabytes))
    monkeypatch.setattr(engine, "usable_cores", lambda: cores)
    monkeypatch.setattr(WorkerProcesses, "start_helper", lambda pool: None)
    began = []
    monkeypatch.setattr(engine, "run_pool", lambda *args: began.append((args[2], args[0]._threads)) or (i for i in ()))
    layouts = {0: range(50), 1: range(50)}
    list(run_frames(Variant(), layouts, workers=None, note=print, device=CPU, prepare=Prepare(Path())))
    assert began == [(workers, threads)]


def test_workers_without_a_frame_take_no_share_of_the_cores(monkeypatch):
    """Eight cores run two frames in two processes of four threads, also if there may be eight processes."""
    monkeypatch.setattr(engine, "usable_cores", lambda: 8)
    began = []
    monkeypatch.setattr(engine, "run_pool", lambda *args: began.append((args[2], args[0]._threads)) or (i for i in ()))
    list(run_frames(Variant(), {0: [3], 1: [5]}, workers=8, note=print, device=CPU))
    assert began == [(2, 4)]


@pytest.fixture
def interpreter(tmp_path, monkeypatch):
    """Replace Python by a shell script in worker processes."""
    resource_tracker.ensure_running()  # started by Python

    def use(script):
        path = tmp_path / "python"
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o700)
        monkeypatch.setattr(spawn, "_python_exe", os.fsencode(path))

    return use


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("exit 7", "ended with status 7 before its start"),
        ("kill -9 $$", "was killed by SIGKILL"),
        ("kill -STOP $$", "did not start within 0.5 s"),
    ],
)
def test_a_worker_that_does_not_start_in_time_is_reported(monkeypatch, interpreter, script, words):
    """The start timeout holds for a large job and a large command line that the process does not read.

    Two workers start in any order, so that either frame may be the first to be lost, or to be lost three times.
    """
    monkeypatch.setattr(worker_processes, "_START_TIMEOUT", 0.5)
    monkeypatch.setattr(worker_processes, "_POLL_INTERVAL", 0.1)
    monkeypatch.setattr(sys, "argv", ["run", "x" * 200_000])
    interpreter(script)
    begun, notes = time.monotonic(), []
    large = Make(how="x" * 10_000_000)
    with pytest.raises(LostWorkersError, match=rf"the worker of frame [01] {words}, 3 times in a row \(out of memory"):
        run(large, 2, {0: [0], 1: [1]}, notes.append)
    assert time.monotonic() - begun < 20
    assert re.fullmatch(rf"the worker of frame [01] {re.escape(words)}: the frame is repeated", notes[0])


def test_a_script_without_a_guarded_main_part_is_named(tmp_path):
    """Its workers run the script again and fail, which looks like a lack of memory."""
    script = tmp_path / "script.py"
    script.write_text("from tests.engine.test_pool import Make, run\nrun(Make(), 2)\n")
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, check=False, env=environment, timeout=100
    )
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert re.search(r"ended with status 1 before its start, 3 times in a row \(.* outside of `if __name__ ==", last)


@pytest.mark.parametrize(("arguments", "received"), [(["a", "b"], ("a", "b")), (["a" * 20_000], ())])
def test_workers_receive_a_command_line_only_if_it_is_short(monkeypatch, arguments, received):
    monkeypatch.setattr(sys, "argv", ["run", *arguments])
    assert run(CommandLine(), 2) == [("run", *received)] * 9
    assert sys.argv == ["run", *arguments]


def test_frames_of_a_worker_that_does_not_start_are_made_by_others(monkeypatch, tmp_path, interpreter):
    """The first worker has a second to start, so that the test need not wait for its timeout."""
    start = WorkerProcesses.start

    def start_soon(pool: WorkerProcesses) -> int:
        worker = start(pool)
        if worker == 0:
            wait_for(mark.exists)
            pool._starting[worker] = 1.0
        return worker

    monkeypatch.setattr(WorkerProcesses, "start", start_soon)
    mark = tmp_path / "first"
    interpreter(f'if [ ! -e {mark} ]; then touch {mark}; kill -STOP $$; fi; exec {sys.executable} "$@"')
    notes = []
    made = run(Make(), 2, note=notes.append)
    assert sorted(index for index, _ in made) == list(range(9))
    assert "the worker of frame 0 did not start within 300 s: the frame is repeated" in notes


def test_suspended_workers_are_killed(tmp_path):
    """SIGTERM would have no effect until the processes continue."""
    (tmp_path / "pids").mkdir()
    with closing(WorkerProcesses(Linger(tmp_path / "pids"), None)) as pool:
        for index in range(2):
            pool.send_frame(pool.start(), index, 0)
        wait_for(lambda: len(list((tmp_path / "pids").iterdir())) == 2)
        for path in (tmp_path / "pids").iterdir():
            os.kill(int(path.name), signal.SIGSTOP)
        begun = time.monotonic()
    assert time.monotonic() - begun < 10
    assert all(ended(path.name) for path in (tmp_path / "pids").iterdir())


def test_a_worker_without_memory_is_not_replaced(tmp_path):
    notes = []
    made = run(Greedy(tmp_path, room=2), 5, layouts={0: range(20), 1: range(20, 40)}, note=notes.append)
    assert sorted(index for index, _ in made) == list(range(40))
    told = re.compile(r"memory ran out in frame \d+, which is repeated with (\d) workers?")
    left = [int(told.fullmatch(note)[1]) for note in notes]
    assert left == [4, 3, 2, 1][: len(left)] and left
    assert all(ended(path.name) for path in tmp_path.iterdir())


@pytest.mark.parametrize("workers", [1, 3])
def test_a_frame_that_does_not_fit_into_memory_alone_ends_the_run(tmp_path, workers):
    results, made = run_frames(Greedy(tmp_path, 99, too_large=7), LAYOUTS, workers=workers, note=lambda text: None), []
    with closing(results), pytest.raises(MissingResourceError) as caught:
        made.extend(results)
    assert str(caught.value) == (
        "frame 7 cannot be made: memory is exhausted (jit_malloc(): out of memory! Could not allocate 4 GiB of device "
        "memory.): use smaller images or fewer samples; if it was GPU memory, use --device cpu; finished frames "
        "are kept"
    )


def test_the_last_frame_is_given_to_an_idle_worker():
    """The last frame fits only without other workers. Idle workers take it in turn until one is left."""
    pool = Short(lambda frame, alive: frame < 2 or alive == 1)
    assert list(run_pool(pool, {0: range(3)}, 3, print)) == [0, 1, 2]
    assert (pool.stopped, pool.alive) == ([2, 0], {1})


def test_workers_without_memory_are_restarted_beside_fewer_others():
    """Four workers run out of memory at once. One is stopped, and the other three are restarted."""
    pool = Short(lambda frame, alive: alive <= 3)
    assert sorted(run_pool(pool, {0: range(8)}, 4, print)) == list(range(8))
    assert (len(pool.alive), pool.hired) == (3, 4 + 3)


class Short:
    """Pool without processes, whose workers all answer at once. A frame may not fit beside the other live workers."""

    def __init__(self, fits):
        self.fits, self.hired = fits, 0
        self.alive, self.given, self.stopped = set(), {}, []

    def start(self):
        self.hired += 1
        self.alive.add(self.hired - 1)
        return self.hired - 1

    def stop(self, worker):
        self.alive.remove(worker)
        self.stopped.append(worker)

    def send_frame(self, worker, frame, layout):
        self.given[worker] = frame

    def wait(self):
        given, self.given, alive = self.given, {}, len(self.alive)
        for worker, frame in given.items():
            yield worker, Finished(frame) if self.fits(frame, alive) else EXHAUSTED

    def free_slots(self):
        return 0


EXHAUSTED = Failure(MissingResourceError, "RuntimeError", "memory is exhausted", "", exhausted=True)


def test_workers_select_the_device_first(monkeypatch):
    """The worker reports its variant. GPUs are assigned in turn, and each worker sees only its own GPU."""
    with closing(run_frames(Variant(), LAYOUTS, workers=2, note=print, device=CPU)) as results:
        assert {variant for _, variant, _ in results} == {"llvm_ad_rgb"}
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    gpus = tuple(Gpu(name, 80 * 2**30, number, "", f"GPU-{name}") for number, name in enumerate("ab"))
    monkeypatch.setattr(worker_processes, "use_shared_device", print)
    pool = WorkerProcesses(Variant(), Device("cuda", gpus))
    pool._kind = None  # no device is selected
    with closing(pool):
        workers = [pool.start() for _ in range(3)]
        pool.stop(workers[1])
        workers[1] = pool.start()
        seen = []
        for worker in workers:
            pool.send_frame(worker, 0, 0)
            while not (answers := list(pool.wait())):
                pass
            seen.append(answers[0][1].result[2])
    assert seen == ["GPU-a", "GPU-b", "GPU-a"]
    assert "CUDA_VISIBLE_DEVICES" not in os.environ


@pytest.mark.parametrize(("workers", "threads"), [(2, 3), pytest.param(4, 2, marks=pytest.mark.extended)])
def test_workers_share_the_cores(monkeypatch, workers, threads):
    monkeypatch.setattr(engine, "usable_cores", lambda: 6)
    with closing(run_frames(Threads(), {0: range(workers)}, workers=workers, note=print, device=CPU)) as results:
        assert list(results) == [(threads, 1)] * workers


def test_a_missing_gpu_is_reported_in_one_sentence():
    """An error of device selection in a worker is reported as the error of its frame."""
    lost = Device("cuda", (Gpu("gone", 2**40, 1, "", ""),))
    if isinstance(visible_gpus(), MissingPrerequisite):
        words = (
            "^frame 0 cannot be made: cuda cannot be used, because .*, or use the device cpu; finished frames are kept"
        )
        with pytest.raises(MissingResourceError, match=words):
            list(run_frames(Variant(), {0: [0]}, note=print, device=lost))


@pytest.mark.parametrize(("kind", "exhausted"), [("cuda", True), ("cpu", False)])
def test_a_gpu_that_does_not_start_loses_its_worker(monkeypatch, kind, exhausted):
    """A GPU may fail for all processes just after one of them made it fail, so a later attempt can succeed.

    A CPU that fails would fail again.
    """

    def fail(device, threads):
        raise ImportError("cuInit() failed")

    frames, answers = iter([7, 8]), []

    def receive():
        with suppress(StopIteration):
            return next(frames)
        raise EOFError

    monkeypatch.setattr(worker_processes, "use_shared_device", fail)
    monkeypatch.setattr(worker_processes, "_end_with_parent", lambda: None)
    worker_processes._work(SimpleNamespace(recv=receive, send=answers.append), kind, None, (Variant(), None))
    assert isinstance(answers.pop(0), Started)
    assert [(answer.exhausted, answer.message) for answer in answers] == [(exhausted, "cuInit() failed")] * 2


@pytest.mark.parametrize(("own", "seen"), [("", "0"), ("GPU-a", "GPU-a")])
def test_workers_get_the_environment_of_the_gpu_service(monkeypatch, own, seen):
    """The service's variables are set in the workers only. One of several GPUs has a name of its own."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    gpu = Gpu("a", 80 * 2**30, 0, "", own)
    with closing(WorkerProcesses(Variant(), Device("cuda", (gpu,)), {"CUDA_VISIBLE_DEVICES": "0"})) as pool:
        pool._kind = None  # no device is selected
        pool.send_frame(pool.start(), 0, 0)
        while not (answers := list(pool.wait())):
            pass
    assert answers[0][1].result[2] == seen
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "1"


@pytest.mark.parametrize(("gigabytes", "count"), [((80, 80), 8), ((80, 7), 4), ((7,), 2), ((1,), 1)])
def test_the_number_of_workers_is_bounded_by_gpu_memory(monkeypatch, gigabytes, count):
    """All workers start at once. A GPU of 7 GiB gets two workers of 3 GiB."""
    monkeypatch.setattr(engine, "unused_memory", lambda: 32.0)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    device = Device("cuda", tuple(Gpu("one", size * 2**30, 0, "", "") for size in gigabytes))
    assert engine.affordable_workers(TYPICAL_MEMORY, device) == count
    began = []
    monkeypatch.setattr(engine, "use_device", began.append)
    monkeypatch.setattr(engine, "run_pool", lambda *args: began.append(args[2]) or (i for i in ()))
    list(run_frames(Variant(), {0: range(100)}, workers=None, note=print, device=device))
    assert began == [count if count > 1 else device]


def test_the_number_of_workers_per_gpu_is_bounded(monkeypatch):
    monkeypatch.setattr(engine, "unused_memory", lambda: 4096.0)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(256)), raising=False)
    gpus = tuple(Gpu("large", 288 * 2**30, number, "", "") for number in range(2))
    assert [engine.affordable_workers(TYPICAL_MEMORY, Device("cuda", gpus[:count])) for count in (1, 2)] == [48, 96]


def test_few_frames_on_another_gpu_run_in_one_process(monkeypatch):
    """Another GPU needs a process of its own. More processes would take as long to start as the frames take."""
    began = []
    monkeypatch.setattr(engine, "affordable_workers", lambda memory, device: 8)
    monkeypatch.setattr(engine, "SharedGpu", None)
    monkeypatch.setattr(engine, "run_pool", lambda *args: began.append(args[2]) or (i for i in ()))
    device = Device("cuda", (Gpu("other", 2**40, 1, "", "GPU-other"),))
    list(run_frames(Variant(), {0: range(12)}, workers=None, note=print, device=device))
    assert began == [1]


def test_workers_end_with_their_parent(tmp_path):
    """A killed parent leaves no process that could still write."""
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "from mitsplat.engine.pool import run_frames\n"
        "from tests.engine.jobs import Linger\n"
        "if __name__ == '__main__':\n"
        "    list(run_frames(Linger(Path(sys.argv[2])), {0: [0, 1]}, workers=2, note=print))\n"
    )
    (tmp_path / "parent.py").write_text(script)
    folder = tmp_path / "pids"
    folder.mkdir()
    parent = subprocess.Popen([sys.executable, tmp_path / "parent.py", str(Path(__file__).parents[2]), str(folder)])
    wait_for(lambda: len(list(folder.iterdir())) == 2)
    parent.kill()
    parent.wait()
    for path in folder.iterdir():
        wait_for(lambda path=path: ended(path.name))


class Scripted:
    """Pool whose workers finish their frames in turn, and that other machines join."""

    def __init__(self, joining):
        self.joining, self.hired = list(joining), 0
        self.at_work: dict[int, int] = {}

    def start(self):
        self.hired += 1
        return self.hired - 1

    def send_frame(self, worker, frame, layout):
        self.at_work[worker] = frame

    def wait(self):
        worker = next(iter(self.at_work))
        yield worker, Finished(self.at_work.pop(worker))

    def free_slots(self):
        return self.joining.pop(0) if self.joining else 0


def test_workers_start_on_machines_that_join():
    """No worker starts twice, and none starts without a frame to render."""
    pool = Scripted(joining=[0, 0, 2, 0, 0, 50])
    assert sorted(run_pool(pool, {0: range(20)}, 1, print)) == list(range(20))
    assert pool.hired == 1 + 2 + 11  # by then 9 of 20 frames were assigned


class SlowPlan:
    """Slow reference of the plan.

    Order of choice: the worker's own layout, the first layout without a worker, the layout with the most frames left.
    """

    def __init__(self, layouts):
        self.waiting = {layout: list(frames) for layout, frames in layouts.items() if frames}
        self.layouts = {}

    def take(self, worker):
        if not self.waiting:
            return None
        layout = self.layouts.get(worker)
        if layout not in self.waiting:
            free = [layout for layout in self.waiting if layout not in self.layouts.values()]
            layout = free[0] if free else max(self.waiting, key=lambda layout: len(self.waiting[layout]))
            self.layouts[worker] = layout
        frame = self.waiting[layout].pop(0)
        if not self.waiting[layout]:
            del self.waiting[layout]
        return layout, frame

    def put_back(self, worker, frame):
        self.waiting.setdefault(self.layouts[worker], []).insert(0, frame)
        del self.layouts[worker]


@settings(max_examples=300, deadline=None)
@given(
    sizes=st.lists(st.integers(0, 6), max_size=9),
    events=st.lists(st.tuples(st.integers(0, 4), st.sampled_from(["take"] * 6 + ["lost"])), max_size=80),
)
def test_the_plan_agrees_with_its_slow_twin(sizes, events):
    """Workers take frames and are lost with their frame, in any order."""
    layouts = {7 * number: [100 * number + view for view in range(size)] for number, size in enumerate(sizes)}
    fast, slow = FrameQueue(layouts), SlowPlan(layouts)
    at_work = {}
    for worker, event in events:
        if event == "take":
            task = slow.take(worker)
            assert fast.take(worker) == task
            at_work[worker] = task
        elif at_work.get(worker) is not None:
            _, frame = at_work.pop(worker)
            fast.put_back(worker, frame)
            slow.put_back(worker, frame)
        assert fast.left == sum(map(len, slow.waiting.values()))
    rest = [(fast.take(9), slow.take(9)) for _ in range(fast.left + 1)]
    assert all(one == other for one, other in rest) and rest[-1] == (None, None)


class Counted(int):
    """Layout number that counts its comparisons and hash calls."""

    looks = 0

    def __hash__(self):
        Counted.looks += 1
        return int.__hash__(self)

    def __eq__(self, other):
        Counted.looks += 1
        return int.__eq__(self, other)


def test_the_cost_of_a_frame_grows_with_the_logarithm_of_layouts():
    """The number of layout accesses per frame hardly grows from 100 to 3200 layouts.

    A layout goes to one worker, the last ones go to several.
    """
    looks = {}
    for count in (100, 3200):
        plan = FrameQueue({Counted(layout): range(3) for layout in range(count)})
        Counted.looks = 0
        for turn in range(plan.left):
            plan.take(turn % 50)
        looks[count] = Counted.looks / (3 * count)
    assert looks[3200] < 1.2 * looks[100] < 15


def test_few_frames_run_in_this_process():
    assert run(Make(), None) == [(index, os.getpid()) for index in range(9)]


def test_closing_stops_workers_at_once():
    results = run_frames(Make(how="slow"), LAYOUTS, workers=2, note=lambda text: stop())
    stopped = []

    def stop():
        stopped.append(time.monotonic())  # excludes the start-up time
        raise KeyboardInterrupt

    with closing(results), pytest.raises(KeyboardInterrupt):
        next(results)
    assert time.monotonic() - stopped[0] < 30


def test_workers_must_be_positive():
    with pytest.raises(InputError, match=r"workers must be at least 1 \(got 0\)"):
        run(Make(), 0)
