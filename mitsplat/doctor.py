"""What this machine has of all that mitsplat needs, and what to do about the rest."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mitsplat.llvm import OLDEST_USABLE, VARIABLE

NEEDED_MEMORY = 4.0
"""Peak of the default scene [GiB]."""

_CGROUP = Path("/sys/fs/cgroup")

TRIAL = """
import mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
scene = mi.cornell_box()
scene["sensor"]["film"] |= {"width": 16, "height": 16}
dr.eval(mi.render(mi.load_dict(scene), spp=1))
dr.sync_thread()
print(".".join(map(str, dr.detail.llvm_version())))
"""
"""A tiny picture in a process of its own, because an unusable LLVM does not raise: it aborts."""


@dataclass(frozen=True)
class Finding:
    """One line of the report; ``remedy`` says what to do where ``ok`` is false."""

    name: str
    ok: bool
    text: str
    remedy: str = ""


def examine() -> Iterator[Finding]:
    """The findings, one after the other as they are made."""
    yield Finding("Python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer")
    for package in ("mitsuba", "drjit", "newton"):
        yield _package(package)
    yield _llvm()
    yield _warp()
    yield _memory()


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, version(name))
    except PackageNotFoundError:
        return Finding(name, False, "is not installed", f"pip install {name}")


def _llvm() -> Finding:
    path = os.environ.get(VARIABLE) or "the system's libLLVM"
    remedy = f"pip install karellen-llvm-core, or set {VARIABLE} to a libLLVM of version {OLDEST_USABLE} or newer"
    trial = subprocess.run([sys.executable, "-c", TRIAL], capture_output=True, text=True, check=False)
    if trial.returncode == 0:
        return Finding("LLVM", True, f"{trial.stdout.split()[-1]} from {path} renders")
    said = (trial.stderr.strip().splitlines() or [f"exit status {trial.returncode}"])[-1]
    return Finding("LLVM", False, f"{path} does not render ({said})", remedy)


def _warp() -> Finding:
    remedy = "pip install warp-lang"
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR
        devices = ", ".join(str(device) for device in warp.get_devices())
    except (ImportError, RuntimeError) as error:
        return Finding("warp", False, str(error), remedy)
    return Finding("warp", True, f"{version('warp-lang')} on {devices}")


def unused_memory() -> float:
    """Memory that programs can still have [GiB], within what a container is limited to."""
    free = {"MemAvailable": os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30}
    with suppress(OSError):
        lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
        free |= {words[0].rstrip(":"): int(words[1]) / 2**20 for words in lines}
    with suppress(OSError, ValueError):  # no limit is "max", which is no number
        limit, used = (int((_CGROUP / name).read_text()) for name in ("memory.max", "memory.current"))
        return min(free["MemAvailable"], (limit - used) / 2**30)
    return free["MemAvailable"]


def _memory() -> Finding:
    available = unused_memory()
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    remedy = f"have {NEEDED_MEMORY:g} GiB for each worker: close programs, or render with fewer workers"
    return Finding("memory", total >= NEEDED_MEMORY, f"{available:.1f} of {total:.1f} GiB unused", remedy)
