"""NVIDIA's Multi-Process Service (MPS), with which processes compute on a GPU at the same time.

Without MPS, processes share the GPU by time slices. An H200 is then busy for less than half of the time, for any number
of processes (``python -m benchmarks.scale.gpu``, and the same with ``--turns``). MPS is part of NVIDIA's driver for
Linux and needs no administrator rights. It is a daemon, which is started here for the duration of its use, unless one
is already running.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress

from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.runtime.gpu_memory import VISIBLE_GPUS

CONTROL = "nvidia-cuda-mps-control"
"""Program that starts and stops the service."""

PIPES = "CUDA_MPS_PIPE_DIRECTORY"
"""Environment variable: folder through which client processes find the service."""

MAX_CLIENTS = 48
"""Maximum number of processes per GPU; the service refuses more (NVIDIA, "Multi-Process Service")."""

_LOGS = "CUDA_MPS_LOG_DIRECTORY"

_TRIAL = """
import mitsplat
import mitsuba as mi
mitsplat.use_device("cuda")
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
hit = scene.ray_test(mi.Ray3f([0, 0, 1], [0, 0, -1]))
assert hit[0]
"""
"""Test program that traces one ray in a separate process, to verify that the service works."""

_STOP_AT_END = """
read nothing
echo quit -t 5 | {control}
rm -rf {folder}
"""
"""Shell script that stops the service when its input is closed, also if this process is killed."""

_TIMEOUT = 60.0
"""Time limit of a trial [s]."""


class SharedGpu:
    """The MPS service, started if available. It ends with :meth:`close` or with this process.

    Attributes:
        environment: Environment variables of processes that use the service; empty if it is unavailable, or if
            processes find it by default.
        problem: Reason why the service is unavailable, as the rest of "because ..."; empty if it is available.
    """

    def __init__(self) -> None:
        self.environment: dict[str, str] = {}
        self.problem = ""
        self._stopper: subprocess.Popen[bytes] | None = None
        if shutil.which(CONTROL) is None:
            self.problem = f"{CONTROL}, which is part of NVIDIA's driver, is missing"
        elif _control("get_server_list"):
            return  # an already running service is used
        else:
            self._start()

    def _start(self) -> None:
        folder = tempfile.mkdtemp(prefix="mitsplat-mps-", dir="/tmp")  # a socket's path must be short
        service = {PIPES: folder, _LOGS: folder}
        self.environment = service | _renumbered(os.environ.get(VISIBLE_GPUS, ""))
        try:
            self._stopper = subprocess.Popen(
                ["/bin/sh", "-c", _STOP_AT_END.format(control=CONTROL, folder=folder)],
                env=os.environ | service,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in a terminal must not reach it
            )
            started = subprocess.run(
                [CONTROL, "-d"], env=os.environ | service, capture_output=True, text=True, check=False
            )
            if started.returncode:
                raise OSError(_last_line(started.stdout + started.stderr))
            trial = subprocess.run(
                python_command("-c", _TRIAL),
                env=python_environment(self.environment),
                capture_output=True,
                text=True,
                check=False,
                timeout=_TIMEOUT,
            )
            if trial.returncode:
                raise OSError(_last_line(trial.stderr))
        except BaseException as error:
            self.close()
            if not isinstance(error, OSError | subprocess.TimeoutExpired):
                raise
            self.problem = f"{CONTROL} does not work ({error})"

    def close(self) -> None:
        """Stop the service after its client processes have ended."""
        stopper, self._stopper, self.environment = self._stopper, None, {}
        if stopper is not None:
            with suppress(subprocess.TimeoutExpired):
                stopper.communicate(timeout=_TIMEOUT)


def _renumbered(visible: str) -> dict[str, str]:
    """Renumber GPUs that are selected by index for clients, because the service counts its visible GPUs from 0."""
    names = visible.split(",")
    if all(name.strip().isdigit() for name in names):
        return {VISIBLE_GPUS: ",".join(map(str, range(len(names))))}
    return {}


def _control(command: str) -> bool:
    """Return True if the service is running and executes the command."""
    with suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            [CONTROL], input=f"{command}\n", capture_output=True, text=True, check=False, timeout=_TIMEOUT
        )
        return done.returncode == 0
    return False


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no output"])[-1]
