"""NVIDIA's Multi-Process Service (MPS): processes that compute on a GPU at the same time.

Without it they take turns in slices of time, and an H200 is busy for less than half of it, however many they are
(``python -m benchmarks.scale.gpu``, and the same with ``--turns``). It comes with NVIDIA's driver for Linux, needs no
rights of an administrator, and is a daemon: started here for as long as it is used, unless one runs already.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from contextlib import suppress

from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.runtime.gpu_memory import VISIBLE

CONTROL = "nvidia-cuda-mps-control"
"""The program that starts the service and ends it."""

PIPES = "CUDA_MPS_PIPE_DIRECTORY"
"""Environment variable: where the service is found by processes that are to use it."""

MOST_CLIENTS = 48
"""Processes that may share a GPU: another one is refused by the service (NVIDIA, "Multi-Process Service")."""

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

_KEEPER = """
read nothing
echo quit -t 5 | {control}
rm -rf {folder}
"""
"""Ends the service when its input ends: when that is closed, or this process is gone, however it went."""

_PATIENCE = 60.0
"""How long a trial may take [s]."""


class SharedGpu:
    """The service, started if it can be had; :meth:`close` ends it, and so does the end of this process.

    Attributes:
        environment: Variables with which processes start that use it; none if they take turns, or find it by
            themselves.
        lack: Why it cannot be had, for "because ..."; empty if it can.
    """

    def __init__(self) -> None:
        self.environment: dict[str, str] = {}
        self.lack = ""
        self._keeper: subprocess.Popen[bytes] | None = None
        if shutil.which(CONTROL) is None:
            self.lack = f"{CONTROL} of NVIDIA's driver is absent"
        elif _control("get_server_list"):
            return  # somebody else's serves us
        else:
            self._start()

    def _start(self) -> None:
        folder = tempfile.mkdtemp(prefix="mitsplat-mps-", dir="/tmp")  # a socket's path must be short
        service = {PIPES: folder, _LOGS: folder}
        self.environment = service | _renumbered(os.environ.get(VISIBLE, ""))
        try:
            self._keeper = subprocess.Popen(
                ["/bin/sh", "-c", _KEEPER.format(control=CONTROL, folder=folder)],
                env=os.environ | service,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in a terminal is not for it
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
                timeout=_PATIENCE,
            )
            if trial.returncode:
                raise OSError(_last_line(trial.stderr))
        except BaseException as error:
            self.close()
            if not isinstance(error, OSError | subprocess.TimeoutExpired):
                raise
            self.lack = f"{CONTROL} does not serve ({error})"

    def close(self) -> None:
        """End the service, when the processes that use it have ended."""
        keeper, self._keeper, self.environment = self._keeper, None, {}
        if keeper is not None:
            with suppress(subprocess.TimeoutExpired):
                keeper.communicate(timeout=_PATIENCE)


def _renumbered(visible: str) -> dict[str, str]:
    """GPUs that are made visible by their numbers, as clients must call them: the service counts those it sees anew."""
    names = visible.split(",")
    return {VISIBLE: ",".join(map(str, range(len(names))))} if all(name.strip().isdigit() for name in names) else {}


def _control(command: str) -> bool:
    """Whether the service is there and does as it is told."""
    with suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            [CONTROL],
            input=f"{command}\n",
            capture_output=True,
            text=True,
            check=False,
            timeout=_PATIENCE,
        )
        return done.returncode == 0
    return False


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it says nothing"])[-1]
