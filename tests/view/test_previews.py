"""Worker thread that processes only the newest request."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from queue import Queue

import pytest

from mitsplat.errors import InputError
from mitsplat.view.previews import LatestRequestWorker, presets_up_to

LONG = 20  # seconds; normally instant


class Steps:
    """Work in three steps, each of which waits for a signal."""

    def __init__(self) -> None:
        self.begun, self.told, self.refused = Queue[str](), Queue[str](), Queue[str]()
        self.go = threading.Semaphore(0)
        self.worker = LatestRequestWorker[str, str](
            self.work, lambda request, result: self.told.put(result), lambda error: self.refused.put(str(error))
        )

    def work(self, request: str) -> Iterator[str]:
        for step in range(3):
            self.begun.put(f"{request}{step}")
            if not self.go.acquire(timeout=LONG):
                raise TimeoutError
            if request == "bad":
                raise InputError("must be good")
            if request == "worse":
                raise RuntimeError("a fault")
            yield f"{request}{step}"


@pytest.fixture
def steps() -> Iterator[Steps]:
    made = Steps()
    yield made
    made.go.release(100)
    made.worker.close()


def test_a_request_sharpens_step_by_step(steps):
    steps.go.release(3)
    steps.worker.submit("a")
    assert [steps.told.get(timeout=LONG) for _ in range(3)] == ["a0", "a1", "a2"]


def test_the_newest_request_replaces_earlier_ones(steps):
    steps.worker.submit("a")
    assert steps.begun.get(timeout=LONG) == "a0"
    steps.worker.submit("b")
    steps.worker.submit("c")
    steps.go.release(4)
    assert [steps.told.get(timeout=LONG) for _ in range(4)] == ["a0", "c0", "c1", "c2"]


def test_an_input_error_is_reported_and_the_next_request_handled(steps):
    steps.go.release(4)
    steps.worker.submit("bad")
    assert steps.refused.get(timeout=LONG) == "must be good"
    steps.worker.submit("d")
    assert steps.told.get(timeout=LONG) == "d0"
    steps.worker.check()


def test_an_exception_of_the_worker_is_raised_by_check(steps):
    steps.go.release(1)
    steps.worker.submit("worse")
    steps.worker._thread.join(LONG)
    with pytest.raises(RuntimeError, match="a fault"):
        steps.worker.check()


def test_a_waiting_request_is_ended_by_a_newer_one(steps):
    assert steps.worker.wait(0)
    steps.worker.submit("a")
    steps.begun.get(timeout=LONG)
    steps.worker.submit("b")
    assert not steps.worker.wait(LONG)


def test_presets_go_from_the_fastest_to_the_requested_one():
    assert presets_up_to("fast") == ["fast"]
    assert presets_up_to("exact") == ["fast", "balanced", "exact"]
