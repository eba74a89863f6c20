"""Jobs of the engine's tests. Workers import this module, which imports little so that they start fast."""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.storage.files import write_text


@dataclass(frozen=True)
class Make:
    """Job that returns (index, process id), and fails in a chosen way at one frame."""

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


@dataclass(frozen=True)
class CommandLine:
    """Job that returns the command line of its process."""

    def __call__(self, index, note, /):
        return tuple(sys.argv)


@dataclass(frozen=True)
class KillOnce:
    """Job that kills its process once at each of the given frames."""

    folder: Path
    frames: tuple[int, ...]

    def __call__(self, index, note, /):
        mark = self.folder / str(index)
        if index in self.frames and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return index


class Dies:
    """Job that takes any arguments and aborts its process."""

    def __init__(self, *args):
        pass

    def __call__(self, index, note, /):
        os.abort()


@dataclass(frozen=True)
class Greedy:
    """Job that raises Dr.Jit's out-of-memory error if more than ``room`` processes live, and always at one frame."""

    folder: Path
    room: int
    too_large: int = -1

    def __call__(self, index, note, /):
        (self.folder / str(os.getpid())).touch()
        if index == self.too_large or sum(not ended(path.name) for path in self.folder.iterdir()) > self.room:
            raise RuntimeError("jit_malloc(): out of memory! Could not allocate 4 GiB of device memory.\n(and more)")
        time.sleep(0.1)  # the other workers are busy meanwhile
        return index, os.getpid()


@dataclass(frozen=True)
class Variant:
    """Job that returns Mitsuba's variant and the visible GPU."""

    def __call__(self, index, note, /):
        import mitsuba as mi

        return index, mi.variant(), os.environ.get("CUDA_VISIBLE_DEVICES")


@dataclass(frozen=True)
class Threads:
    """Job that returns the numbers of Dr.Jit's and OpenCV's threads."""

    def __call__(self, index, note, /):
        import cv2
        import drjit as dr

        return dr.thread_count(), cv2.getNumThreads()


@dataclass(frozen=True)
class Linger:
    """Job that records its process id and blocks."""

    folder: Path

    def __call__(self, index, note, /):
        (self.folder / str(os.getpid())).touch()
        time.sleep(300)


def ended(process):
    """Return True if a process has ended or is a zombie; it may end during the call."""
    try:
        return "Z" in Path("/proc", process, "stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True


@dataclass(frozen=True)
class Prepare:
    """Function of a helper process that records its layouts and visible GPUs, and fails."""

    folder: Path

    def __call__(self, layouts):
        write_text(self.folder / str(os.getpid()), f"{layouts} {os.environ.get('CUDA_VISIBLE_DEVICES')!r}")
        raise RuntimeError("ignored")


@dataclass(frozen=True)
class WaitForHelper:
    """Job that waits until a helper process has prepared layouts."""

    folder: Path

    def __call__(self, index, note, /):
        wait_for(lambda: list(self.folder.iterdir()))
        return index


def wait_for(condition, seconds=300):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)
