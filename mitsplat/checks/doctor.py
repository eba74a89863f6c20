"""Check of this machine: software, processor, GPU, caches, memory and disk, with a remedy for each problem."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mitsplat.engine.resources import unused_memory
from mitsplat.findings import Finding
from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.runtime.device import MissingPrerequisite, gpu_environment, visible_gpus
from mitsplat.runtime.llvm import MIN_LLVM, VARIABLE
from mitsplat.runtime.warp_start import quiet_warp
from mitsplat.storage.cache import cache_folder, drjit_folder, unusable_reason, warp_folder

NEEDED_MEMORY = 2.5
"""Memory of a worker of the default scene by :func:`mitsplat.frames.budget.worker_memory`, rounded up [GiB].

``python -m benchmarks.scale.workers budget`` prints it beside the memory that is used.
"""

NEEDED_DISK = 0.5
"""Twice the size of a dataset of a thousand frames of 0.25 MB [GiB].

Compiled kernels of a first run are small in comparison, see ``python -m benchmarks.scale.first_run``.
"""


def examine() -> Iterator[Finding]:
    """Run all checks of the machine and yield their findings one by one."""
    yield Finding("Python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer")
    for package in ("mitsuba", "drjit", "newton"):
        yield _package(package)
    yield _processor()
    yield _llvm()
    yield _cuda()
    yield _cache()
    yield _warp()
    yield _memory()
    yield _disk()


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, version(name))
    except PackageNotFoundError:
        return Finding(name, False, "is not installed", f"pip install {name}")


def _llvm() -> Finding:
    path = os.environ.get(VARIABLE) or "the system's libLLVM"
    remedy = f"pip install karellen-llvm-core, or set {VARIABLE} to a libLLVM of version {MIN_LLVM} or newer"
    number, fault = _render_trial_on("cpu", {})
    if fault:
        return Finding("LLVM", False, f"{number} from {path} {fault}" if number else f"{path} {fault}", remedy)
    return Finding("LLVM", True, f"{number} from {path} renders the trial scene correctly")


def _render_trial_on(device: str, environment: Mapping[str, str]) -> tuple[str, str]:
    """Render the trial scene on a device, and return the LLVM version and the fault, or an empty text."""
    command = python_command("-m", "mitsplat.checks.trial", device)
    environment = python_environment(environment)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        message = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        return "", f"does not render ({re.sub('^mitsplat[.]errors[.][A-Za-z]+: ', '', message)})"
    found = json.loads(done.stdout.splitlines()[-1])
    faults = "; ".join(found["faults"])
    return found["llvm"], f"renders the trial scene incorrectly ({faults})" if faults else ""


def _processor() -> Finding:
    """Check that the processor has AVX2: kernels are compiled for its features, and are slow without 8 float lanes."""
    machine, cores = platform.machine(), os.cpu_count()
    found = re.search(r"^(?:flags|Features)\s*:(.*)", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    flags = found[1].split() if found else []
    present = [name for name in ("sse4_2", "avx", "avx2", "fma", "avx512f", "asimd", "sve") if name in flags]
    text = f"{machine}, {cores} cores, {' '.join(present) or 'features unknown'}"
    remedy = "use a processor with AVX2: without it rendering takes several times as long"
    return Finding("processor", machine != "x86_64" or not flags or "avx2" in flags, text, remedy)


def _cuda() -> Finding:
    """Check the GPUs, which are optional; report a GPU without OptiX or with a wrong picture as a problem."""
    gpus = visible_gpus()
    if isinstance(gpus, MissingPrerequisite):
        return Finding("GPU", "OptiX" not in gpus.what, f"{gpus.what} (optional)", gpus.remedy)
    driver, texts, ok = _driver(), [], True
    for gpu in gpus:
        _, fault = _render_trial_on("cuda", gpu_environment(gpu))
        texts.append(f"{gpu.name} {fault or 'renders the trial scene as the CPU does'}")
        ok = ok and not fault
    remedy = "update NVIDIA's driver; until this check passes, render on the CPU"
    return Finding("GPU", ok, f"{'; '.join(texts)} (driver {driver} with OptiX; optional)", remedy)


def _driver() -> str:
    """Return the release of NVIDIA's driver."""
    with suppress(OSError):
        found = re.search(r" (\d+\.[\d.]+) ", Path("/proc/driver/nvidia/version").read_text())
        if found:
            return found[1]
    return "of unknown version"


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    return Finding("disk", free >= NEEDED_DISK, f"{free:.1f} GiB free here", f"free at least {NEEDED_DISK:g} GiB")


def _cache() -> Finding:
    folders = (cache_folder(), warp_folder(), drjit_folder())
    unusable = [f"{folder}: {reason}" for folder in folders if (reason := unusable_reason(folder))]
    if unusable:
        remedy = (
            "set HOME or XDG_CACHE_HOME to a writable folder with free space; otherwise "
            "every run computes kernels and layouts again"
        )
        return Finding("cache", False, "; ".join(unusable), remedy)
    return Finding("cache", True, f"{', '.join(map(str, folders))} can be written")


def _warp() -> Finding:
    remedy = "pip install warp-lang"
    try:
        import warp  # the import itself is tested

        with quiet_warp():
            devices = ", ".join(str(device) for device in warp.get_devices())
    except (ImportError, RuntimeError) as error:
        return Finding("warp", False, str(error), remedy)
    return Finding("warp", True, f"{version('warp-lang')} on {devices}")


def _memory() -> Finding:
    available = unused_memory()
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    remedy = f"a worker of the default scene needs {NEEDED_MEMORY:g} GiB: close programs, or render with fewer workers"
    return Finding("memory", total >= NEEDED_MEMORY, f"{available:.1f} of {total:.1f} GiB unused", remedy)
