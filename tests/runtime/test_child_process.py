"""Python child processes: isolation from the current folder, memory and time limits, and errors."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mitsplat.errors import InputError
from mitsplat.runtime.child_process import (
    REFUSED_STATUS,
    SAFE_PATH,
    leave_current_folder,
    limit_memory,
    python_command,
    python_environment,
    run_bounded,
    safe_path_children,
)

GIB = 1 << 30


def echo(output, data, *arguments):
    os.write(1, b"a library's own words")
    output.write(data[::-1] + "/".join(arguments).encode())


def refuse(output, data):
    output.write(b"so far")
    output.flush()
    raise InputError("first line\nit holds nothing")


def fill(output, data, amount):
    output.write(b"%d" % len(bytearray(int(amount))))


def fill_twice(output, data, small, large):
    limit_memory(int(small) * 2, final=False)
    bytearray(int(small))
    output.write(b"small ")
    output.flush()
    bytearray(int(large))
    output.write(b"large")


def exceed(output, data, amount):
    limit_memory(4 * int(amount), final=False)
    bytearray(int(amount))


def die(output, data):
    os.abort()


def sleep(output, data):
    time.sleep(60)


def show_settings(output, data):
    import resource

    values = sys.flags.safe_path, os.environ[SAFE_PATH], resource.getrlimit(resource.RLIMIT_CORE)
    output.write(repr(values).encode())


def show_memory(output, data):
    import resource

    output.write(repr(resource.getrlimit(resource.RLIMIT_AS)).encode())


class TestBounded:
    @pytest.fixture(autouse=True)
    def importable(self, monkeypatch):
        monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))

    def test_the_output_is_that_of_the_function(self):
        ended = run_bounded(echo, "a", Path("/b c"), data=b"123", imports=["numpy"], memory=GIB, seconds=30)
        assert ended == (0, b"321a//b c", "")

    def test_an_input_error_returns_its_sentence(self):
        assert run_bounded(refuse, memory=GIB, seconds=30) == (REFUSED_STATUS, b"so far", "it holds nothing")

    def test_memory_is_bounded_beyond_that_of_the_imports(self):
        assert run_bounded(fill, str(GIB // 2), imports=["numpy"], memory=GIB, seconds=30).output == b"%d" % (GIB // 2)
        # Some of the address space of the imports is free again after them.
        too_much = str(GIB + GIB // 16)
        assert run_bounded(fill, too_much, imports=["numpy"], memory=GIB, seconds=30) == (1, b"", "MemoryError")

    def test_a_part_may_have_a_lower_bound(self):
        ended = run_bounded(fill_twice, str(GIB // 8), str(GIB // 2), memory=GIB, seconds=30)
        assert ended == (1, b"small ", "MemoryError")

    def test_the_function_cannot_raise_the_bound(self):
        ended = run_bounded(exceed, str(GIB), memory=GIB // 2, seconds=30)
        assert ended == (1, b"", "MemoryError")

    def test_a_lower_limit_of_the_user_stays(self):
        """A shell limits its children by ``ulimit -S -v``, which a process may raise to the hard limit."""
        code = (
            "import resource\n"
            "from tests.runtime.test_child_process import GIB, run_bounded, show_memory\n"
            "resource.setrlimit(resource.RLIMIT_AS, (8 * GIB, resource.RLIM_INFINITY))\n"
            "print(run_bounded(show_memory, memory=32 * GIB, seconds=30).output.decode())"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout == f"({8 * GIB}, {8 * GIB})\n"

    def test_a_signal_is_reported_by_its_number(self):
        assert run_bounded(die, memory=GIB, seconds=30) == (-6, b"", "stopped with status -6")

    def test_time_is_bounded(self):
        begun = time.monotonic()
        assert run_bounded(sleep, memory=GIB, seconds=1) == (None, b"", "did not end within 1 s")
        assert time.monotonic() - begun < 10

    def test_the_process_runs_in_safe_path_mode_without_core_dumps(self):
        assert run_bounded(show_settings, memory=GIB, seconds=30).output == b"(True, '1', (0, 0))"


class TestSafePath:
    def test_every_command_runs_in_safe_path_mode(self):
        assert python_command("-m", Path("a")) == [sys.executable, "-P", "-m", "a"]
        assert python_environment({"A": "b"}) == {**os.environ, "A": "b", SAFE_PATH: "1"}

    @pytest.mark.parametrize("before", [None, "", "1"])
    def test_the_environment_and_the_path_are_restored(self, monkeypatch, before):
        monkeypatch.delenv(SAFE_PATH, raising=False)
        if before is not None:
            monkeypatch.setenv(SAFE_PATH, before)
        monkeypatch.setattr(sys, "path", ["", "/somewhere"])
        with pytest.raises(OSError, match="x"), safe_path_children():
            assert (os.environ[SAFE_PATH], sys.path) == ("1", ["/somewhere"])
            raise OSError("x")
        assert (os.environ.get(SAFE_PATH), sys.path) == (before, ["", "/somewhere"])

    @pytest.mark.skipif(sys.flags.safe_path, reason="Python was started in safe-path mode")
    @pytest.mark.parametrize(("first", "kept"), [("", False), ("{cwd}", False), ("/usr/bin", True)])
    def test_the_current_folder_is_removed_from_the_path(self, monkeypatch, tmp_path, first, kept):
        monkeypatch.setenv(SAFE_PATH, "0")
        monkeypatch.chdir(tmp_path)
        first = first.format(cwd=tmp_path)
        monkeypatch.setattr(sys, "path", [first, "/somewhere"])
        leave_current_folder()
        assert (os.environ[SAFE_PATH], sys.path) == ("1", [first, "/somewhere"] if kept else ["/somewhere"])

    @pytest.mark.skipif(sys.flags.safe_path, reason="Python was started in safe-path mode")
    def test_a_deleted_current_folder_is_removed_from_the_path(self, monkeypatch, tmp_path):
        monkeypatch.setenv(SAFE_PATH, "0")
        (tmp_path / "gone").mkdir()
        monkeypatch.chdir(tmp_path / "gone")
        (tmp_path / "gone").rmdir()
        monkeypatch.setattr(sys, "path", ["", "/somewhere"])
        leave_current_folder()
        assert sys.path == ["/somewhere"]

    def test_the_folder_of_mitsplat_stays_on_the_path(self, monkeypatch):
        monkeypatch.setenv(SAFE_PATH, "0")
        monkeypatch.chdir(Path(__file__).parents[2])
        monkeypatch.setattr(sys, "path", ["", "/somewhere"])
        leave_current_folder()
        assert sys.path == ["", "/somewhere"]
