"""Frames in worker processes: order, notes, and what happens when a worker fails or dies."""

import os
import signal
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from mitsplat.engine import FrameError, run_frames
from mitsplat.errors import InputError

LAYOUTS = {0: [0, 1, 2], 1: [3, 4, 5], 2: [6, 7, 8]}


@dataclass(frozen=True)
class Make:
    """Returns (index, process id); fails in a chosen way at one frame."""

    fail_at: int = -1
    how: str = ""
    folder: Path = Path()

    def __call__(self, index, note, /):
        note(f"working on {index}")
        if index == self.fail_at:
            if self.how == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "exits":
                os._exit(3)
            raise {"input": InputError, "bug": Unpicklable}[self.how](f"no {index}")
        if self.how == "slow":
            time.sleep(60)
        return index, os.getpid()


class Unpicklable(RuntimeError):
    def __reduce__(self):
        raise TypeError("not this one")


def run(make, workers=1, layouts=LAYOUTS, note=lambda text: None):
    with closing(run_frames(make, layouts, workers=workers, note=note)) as results:
        return list(results)


def test_one_worker_stays_in_this_process_and_in_order():
    assert run(Make()) == [(index, os.getpid()) for index in range(9)]


@pytest.mark.parametrize("workers", [2, 4])
def test_workers_make_every_frame_once_and_nothing_remains(workers):
    notes = []
    made = run(Make(), workers, note=notes.append)
    assert sorted(index for index, _ in made) == list(range(9))
    processes = {process for _, process in made}
    assert os.getpid() not in processes
    assert sorted(notes) == [f"working on {index}" for index in range(9)]
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def test_a_worker_keeps_to_its_layout_while_there_are_others():
    made = run(Make(), 2, {0: [0, 1, 2, 3], 1: [4, 5, 6, 7]})
    first = {index: process for index, process in made if index in (0, 4)}
    assert first[0] != first[4]


def test_no_more_workers_than_frames_and_none_for_no_frames():
    assert run(Make(), 8, {0: [5]}) == [(5, os.getpid())]
    assert run(Make(), 8, {0: []}) == []


@pytest.mark.parametrize("workers", [1, 2])
def test_bad_input_keeps_its_sentence(workers):
    with pytest.raises(InputError, match=r"^no 4$"):
        run(Make(fail_at=4, how="input"), workers)


def test_any_other_failure_names_the_frame_and_has_the_trace():
    with pytest.raises(FrameError, match=r"^frame 4 failed: Unpicklable: no 4") as caught:
        run(Make(fail_at=4, how="bug"), 2)
    assert "in __call__" in caught.value.__notes__[0]


@pytest.mark.parametrize(("how", "words"), [("killed", "was killed by SIGKILL"), ("exits", "ended with status 3")])
def test_a_dead_worker_is_reported_with_its_frame(how, words):
    with pytest.raises(FrameError, match=f"making frame 4 {words}"):
        run(Make(fail_at=4, how=how), 2)


def test_closing_stops_the_workers_at_once():
    results = run_frames(Make(how="slow"), LAYOUTS, workers=2, note=lambda text: stop())

    def stop():
        raise KeyboardInterrupt

    start = time.monotonic()
    with closing(results), pytest.raises(KeyboardInterrupt):
        next(results)
    assert time.monotonic() - start < 30


def test_workers_must_be_positive():
    with pytest.raises(InputError, match=r"workers must be at least 1 \(got 0\)"):
        run(Make(), 0)
