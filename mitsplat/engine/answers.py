"""Answers of workers, the exceptions that follow from them, and the interface of a pool of workers."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from mitsplat.errors import (
    InputError,
    MissingResourceError,
    PartialResultError,
    exit_status,
    is_out_of_memory,
    sentence_of,
)

Result = TypeVar("Result")

_SENTENCES: tuple[type[Exception], ...] = (InputError, MissingResourceError, PartialResultError)


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
        user_error: Exception class, if its message is meant for the user.
        kind, message, trace: Name of the exception's class, its message, and the traceback.
        exhausted: True if memory is exhausted.
    """

    user_error: type[Exception] | None
    kind: str
    message: str
    trace: str
    exhausted: bool = False

    @classmethod
    def of(cls, error: Exception) -> Failure:
        """Build a failure from the exception that is being handled."""
        user_error = next((kind for kind in _SENTENCES if isinstance(error, kind)), None)
        if user_error is None:  # classes with the same exit status of the command line
            user_error = {2: InputError, 3: MissingResourceError}.get(exit_status(error) or 0)
        return cls(
            user_error, type(error).__name__, sentence_of(error), traceback.format_exc(), is_out_of_memory(error)
        )

    def error(self, frame: int) -> Exception:
        """Return the exception to raise in the calling process."""
        if self.user_error is not None:
            return self.user_error(self.message)
        error = FrameError(f"frame {frame} failed: {self.kind}: {self.message}")
        error.add_note(self.trace)
        return error


@dataclass(frozen=True)
class Lost:
    """Loss of a worker with its frame.

    Attributes:
        how: Description of its end, which continues "the worker of frame 3 ...".
        cause: Possible cause, as a question.
    """

    how: str
    cause: str = "out of memory?"


@dataclass(frozen=True)
class Started:
    """Message of a worker that is ready for frames."""


Answer = Status | Finished[Result] | Failure | Lost


class WorkerPool(Protocol[Result]):
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
