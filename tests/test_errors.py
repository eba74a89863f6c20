"""Error messages and exit statuses of the command line for errors that are not bugs of mitsplat."""

import errno
from pathlib import Path

import cv2
import numpy as np
import pytest

from mitsplat.errors import InputError, MissingResourceError, exit_status, sentence_of
from mitsplat.storage.files import storage_errors


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("jit_malloc(): out of memory! Could not allocate 4 GiB of device memory."),
        RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory: you tried to"),
    ],
)
def test_out_of_memory_errors_have_status_3(error: Exception) -> None:
    assert exit_status(error) == 3
    assert sentence_of(error).startswith("memory is exhausted")


def test_out_of_memory_errors_of_opencv_have_status_3() -> None:
    with pytest.raises(cv2.error) as told:
        cv2.resize(np.zeros((9, 9, 3), np.uint8), (10**6, 10**6))
    assert exit_status(told.value) == 3
    with pytest.raises(cv2.error) as other:
        cv2.resize(np.zeros((0, 0), np.uint8), (9, 9))
    assert exit_status(other.value) is None


def test_other_errors_are_not_taken_for_out_of_memory() -> None:
    assert exit_status(RuntimeError("out of ideas")) is None
    assert exit_status(InputError("insufficient memory for jokes")) == 2


def test_a_full_disk_is_named_by_the_file_that_is_written(tmp_path: Path) -> None:
    """``shutil.copyfile`` names its source first."""
    error = OSError(errno.ENOSPC, "No space left on device", "source.jpg", None, "copy.jpg")
    assert sentence_of(error) == "copy.jpg: No space left on device"
    message = r"^copy\.jpg: No space left on device: free disk space"
    with pytest.raises(MissingResourceError, match=message), storage_errors(tmp_path):
        raise error
    assert sentence_of(OSError(errno.ENOENT, "No such file", "source.jpg", None, "copy.jpg")).startswith("source.jpg")


def test_an_error_that_is_its_own_cause_has_a_status() -> None:
    """Such an error once kept the command line in an endless loop."""
    error, interrupt = InputError("a mesh without its material file"), RuntimeError("a wrapped interrupt")
    error.__cause__, interrupt.__cause__ = error, KeyboardInterrupt()
    assert exit_status(error) == 2
    assert exit_status(interrupt) == 130
