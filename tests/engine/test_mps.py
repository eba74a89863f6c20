"""NVIDIA's Multi-Process Service, mocked by a script: start, trial, end, and fallback without it."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mitsplat.engine import mps
from mitsplat.engine.mps import CONTROL, PIPES, SharedGpu
from mitsplat.engine.pool import run_frames
from mitsplat.runtime.device import VISIBLE_GPUS, Device, Gpu

SERVICE = """#!/bin/sh
# Notes what it is told; serves once it was started, where its environment says.
echo "$1" >> {log}
if [ "$1" = -d ]; then {start}; fi
read command
echo "$command" >> {log}
[ -n "$CUDA_MPS_PIPE_DIRECTORY" ] && [ -e "$CUDA_MPS_PIPE_DIRECTORY/control" ]
"""


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file with the commands that the service received."""
    monkeypatch.delenv(PIPES, raising=False)
    monkeypatch.delenv(VISIBLE_GPUS, raising=False)
    monkeypatch.setattr(mps, "_TRIAL", "pass")
    return tmp_path / "log"


def install(
    log: Path, monkeypatch: pytest.MonkeyPatch, start: str = "touch $CUDA_MPS_PIPE_DIRECTORY/control; exit"
) -> None:
    program = log.parent / CONTROL
    program.write_text(SERVICE.format(log=log, start=start))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{log.parent}{os.pathsep}{os.environ['PATH']}")


def told(log: Path) -> list[str]:
    return [line for line in log.read_text().splitlines() if line]


def test_the_service_is_started_and_stopped(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(log, monkeypatch)
    shared = SharedGpu()
    assert shared.problem == ""
    folder = Path(shared.environment[PIPES])
    assert (folder / "control").exists()
    shared.close()
    assert told(log) == ["get_server_list", "-d", "quit -t 5"]
    assert not folder.exists()
    shared.close()
    assert len(told(log)) == 3


def test_a_running_service_is_used_and_not_stopped(log: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install(log, monkeypatch)
    (tmp_path / "control").touch()
    monkeypatch.setenv(PIPES, str(tmp_path))
    shared = SharedGpu()
    assert (shared.environment, shared.problem) == ({}, "")
    shared.close()
    assert told(log) == ["get_server_list"]


def test_a_machine_without_the_service_is_reported(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(log.parent))
    shared = SharedGpu()
    assert shared.environment == {}
    assert shared.problem == "nvidia-cuda-mps-control, which is part of NVIDIA's driver, is missing"


def test_a_service_that_does_not_start_is_reported(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(log, monkeypatch, start="echo no permission >&2; exit 1")
    shared = SharedGpu()
    assert shared.environment == {}
    assert shared.problem == "nvidia-cuda-mps-control does not work (no permission)"


def test_a_service_on_which_the_trial_fails_is_stopped(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(log, monkeypatch)
    monkeypatch.setattr(mps, "_TRIAL", "raise SystemExit('CUDA_ERROR_MPS_SERVER_NOT_READY')")
    shared = SharedGpu()
    assert shared.environment == {}
    assert shared.problem == "nvidia-cuda-mps-control does not work (CUDA_ERROR_MPS_SERVER_NOT_READY)"
    assert told(log)[-1] == "quit -t 5"


def test_the_service_is_stopped_if_workers_cannot_start(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(log, monkeypatch)
    device = Device("cuda", (Gpu("One", 2**40, 0, "", ""),))
    with pytest.raises((AttributeError, pickle.PicklingError)):
        list(run_frames(lambda index, note: index, {0: range(4)}, workers=2, note=print, device=device))
    assert told(log) == ["get_server_list", "-d", "quit -t 5"]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_service_ends_with_the_process_that_started_it(
    log: Path, monkeypatch: pytest.MonkeyPatch, how: int
) -> None:
    """No other process would end the service. It ends for every signal."""
    install(log, monkeypatch)
    code = (
        "import time, mitsplat.engine.mps as mps; mps._TRIAL = 'pass'; shared = mps.SharedGpu(); "
        "print(shared.environment[mps.PIPES], flush=True); time.sleep(300)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        # Jobs in the background of a shell ignore Ctrl-C, and would sleep to their end.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    with process:
        assert process.stdout is not None
        folder = Path(process.stdout.readline().decode().strip())
        assert (folder / "control").exists()
        os.killpg(process.pid, how)  # sent to the process group, as a terminal does
    end = time.monotonic() + 60
    while folder.exists():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert told(log) == ["get_server_list", "-d", "quit -t 5"]


@pytest.mark.parametrize(("visible", "own"), [("1", "0"), ("2,3", "0,1"), ("GPU-5e0b", None), ("", None)])
def test_gpus_are_numbered_as_the_service_numbers_them(
    log: Path, monkeypatch: pytest.MonkeyPatch, visible: str, own: str | None
) -> None:
    """The service sees the GPUs that are visible here, numbered from 0.

    If only the second GPU is visible, clients with the outer number would request a second GPU of the service.
    """
    monkeypatch.setenv(VISIBLE_GPUS, visible)
    install(log, monkeypatch, start=f'[ "$CUDA_VISIBLE_DEVICES" = "{visible}" ] && touch {log.parent}/started; exit')
    shared = SharedGpu()
    assert (log.parent / "started").exists()
    assert shared.environment.get(VISIBLE_GPUS) == own
    shared.close()
