"""NVIDIA's Multi-Process Service (MPS): processes that compute on a GPU at the same time.

Without it they take turns in slices of time, and an H200 is busy for less than half of it, however many they are
(``python -m benchmarks.scale.gpu``, and the same with ``--turns``). It comes with NVIDIA's driver for Linux, needs no
rights of an administrator, and is a daemon: started here for as long as it is used, unless one runs already.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

CONTROL = "nvidia-cuda-mps-control"
"""The program that starts the service and ends it."""

PIPES = "CUDA_MPS_PIPE_DIRECTORY"
"""Environment variable: where the service is found by processes that are to use it."""

_LOGS = "CUDA_MPS_LOG_DIRECTORY"

_TRIAL = """
import mitsplat
import mitsuba as mi
mitsplat.use_device("cuda")
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
hit = scene.ray_test(mi.Ray3f([0, 0, 1], [0, 0, -1]))
assert hit[0]
"""
"""A ray traced by a process of its own: whether the service serves is known when it has."""

_PATIENCE = 60.0
"""How long a trial may take [s]."""


class SharedGpu:
    """The service, started if it can be had; :meth:`close` ends it.

    Attributes:
        environment: Variables with which processes start that use it; none if they take turns, or find it by
            themselves.
        lack: Why it cannot be had, for "because ..."; empty if it can.
    """

    def __init__(self) -> None:
        self.environment: dict[str, str] = {}
        self.lack = ""
        if shutil.which(CONTROL) is None:
            self.lack = f"{CONTROL} of NVIDIA's driver is absent"
        elif _control("get_server_list"):
            return  # somebody else's serves us
        else:
            self._start()

    def _start(self) -> None:
        folder = tempfile.mkdtemp(prefix="mitsplat-mps-", dir="/tmp")  # a socket's path must be short
        self.environment = {PIPES: folder, _LOGS: folder}
        try:
            started = subprocess.run(
                [CONTROL, "-d"], env=os.environ | self.environment, capture_output=True, text=True, check=False
            )
            if started.returncode:
                raise OSError(_last_line(started.stdout + started.stderr))
            trial = subprocess.run(
                [sys.executable, "-c", _TRIAL],
                env=os.environ | self.environment,
                capture_output=True,
                text=True,
                check=False,
                timeout=_PATIENCE,
            )
            if trial.returncode:
                raise OSError(_last_line(trial.stderr))
        except (OSError, subprocess.TimeoutExpired) as error:
            self.close()
            self.lack = f"{CONTROL} does not serve ({error})"

    def close(self) -> None:
        """End the service, when the processes that use it have ended."""
        if self.environment:
            end_service(self.environment)
            shutil.rmtree(self.environment[PIPES], ignore_errors=True)
            self.environment = {}


def end_service(environment: dict[str, str] | os._Environ[str] = os.environ) -> None:
    """End the service that an environment names, if :class:`SharedGpu` started it."""
    if Path(environment.get(PIPES, "")).name.startswith("mitsplat-mps-"):
        _control("quit -t 5", dict(environment))


def _control(command: str, environment: dict[str, str] | None = None) -> bool:
    """Whether the service is there and does as it is told."""
    with suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            [CONTROL],
            input=f"{command}\n",
            env=os.environ | (environment or {}),
            capture_output=True,
            text=True,
            check=False,
            timeout=_PATIENCE,
        )
        return done.returncode == 0
    return False


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it says nothing"])[-1]
