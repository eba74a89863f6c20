"""NVIDIA's Multi-Process Service, played by a script: started, tried, ended, or done without."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mitsplat.engine import mps
from mitsplat.engine.mps import CONTROL, PIPES, SharedGpu, end_service

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
    """What the service was told."""
    monkeypatch.delenv(PIPES, raising=False)
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


def test_it_is_started_and_ended(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(log, monkeypatch)
    shared = SharedGpu()
    assert shared.lack == ""
    folder = Path(shared.environment[PIPES])
    assert (folder / "control").exists()
    shared.close()
    assert told(log) == ["get_server_list", "-d", "quit -t 5"]
    assert not folder.exists()
    shared.close()
    assert len(told(log)) == 3


def test_one_that_runs_already_is_used_and_left_alone(
    log: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install(log, monkeypatch)
    (tmp_path / "control").touch()
    monkeypatch.setenv(PIPES, str(tmp_path))
    shared = SharedGpu()
    assert (shared.environment, shared.lack) == ({}, "")
    shared.close()
    end_service()
    assert told(log) == ["get_server_list"]


def test_a_machine_without_it(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(log.parent))
    shared = SharedGpu()
    assert shared.environment == {}
    assert shared.lack == "nvidia-cuda-mps-control of NVIDIA's driver is absent"


def test_one_that_does_not_start(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(log, monkeypatch, start="echo no permission >&2; exit 1")
    shared = SharedGpu()
    assert shared.environment == {}
    assert shared.lack == "nvidia-cuda-mps-control does not serve (no permission)"


def test_one_on_which_nothing_computes_is_ended(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(log, monkeypatch)
    monkeypatch.setattr(mps, "_TRIAL", "raise SystemExit('CUDA_ERROR_MPS_SERVER_NOT_READY')")
    shared = SharedGpu()
    assert shared.environment == {}
    assert shared.lack == "nvidia-cuda-mps-control does not serve (CUDA_ERROR_MPS_SERVER_NOT_READY)"
    assert told(log)[-1] == "quit -t 5"
