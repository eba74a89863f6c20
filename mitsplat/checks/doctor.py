"""What this machine has of all that mitsplat needs, and what to do about the rest."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mitsplat.cache import cache_folder
from mitsplat.engine.resources import unused_memory
from mitsplat.findings import Finding
from mitsplat.llvm import OLDEST_USABLE, VARIABLE
from mitsplat.warp_start import quiet_warp

NEEDED_MEMORY = 2.5
"""What :func:`mitsplat.frames.budget.worker_memory` allows a worker of the default scene, rounded up [GiB];
``python -m benchmarks.scale.workers budget`` has it beside what is used."""

NEEDED_DISK = 0.5
"""Twice a dataset of a thousand frames of 0.25 MB [GiB]. What a first run compiles and keeps is little beside it, see
``python -m benchmarks.scale.first_run``."""


TRIAL = """
import hashlib
import mitsuba as mi, drjit as dr, numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.cornell_box()
scene["sensor"]["film"] |= {"width": 16, "height": 16}
picture = mi.util.convert_to_bitmap(mi.render(mi.load_dict(scene), spp=4))
print(".".join(map(str, dr.detail.llvm_version())), hashlib.sha256(np.array(picture)).hexdigest()[:16])
"""
"""A tiny picture in a process of its own, because an unusable LLVM does not raise: it aborts."""


def examine() -> Iterator[Finding]:
    """The findings, one after the other as they are made."""
    yield Finding("Python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer")
    for package in ("mitsuba", "drjit", "newton"):
        yield _package(package)
    yield _processor()
    yield _llvm()
    yield _cuda()
    yield _warp()
    yield _memory()
    yield _disk()
    yield _cache()


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
        number, digest = trial.stdout.split()[-2:]
        return Finding("LLVM", True, f"{number} from {path} renders a picture with the SHA-256 {digest}...")
    said = (trial.stderr.strip().splitlines() or [f"exit status {trial.returncode}"])[-1]
    return Finding("LLVM", False, f"{path} does not render ({said})", remedy)


def _processor() -> Finding:
    """Kernels are compiled for what the processor has; without 8 lanes of floats they are slow."""
    machine, cores = platform.machine(), os.cpu_count()
    flags: set[str] = set()
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                flags = set(line.partition(":")[2].split())
                break
    present = [name for name in ("sse4_2", "avx", "avx2", "fma", "avx512f", "asimd", "sve") if name in flags]
    text = f"{machine}, {cores} cores, {' '.join(present) or 'features unknown'}"
    remedy = "use a processor with AVX2: without it rendering takes several times as long"
    return Finding("processor", machine != "x86_64" or not flags or "avx2" in flags, text, remedy)


def _cuda() -> Finding:
    """A GPU is not needed; half of one is worth a word."""
    found = {name: _loads(library) for name, library in (("CUDA", "libcuda.so.1"), ("OptiX", "libnvoptix.so.1"))}
    text = ", ".join(f"{name} {'found' if there else 'absent'}" for name, there in found.items())
    remedy = "install the whole driver: without libnvoptix.so.1 the variant cuda_ad_rgb cannot trace rays"
    return Finding("GPU", found["OptiX"] or not found["CUDA"], f"{text} (optional)", remedy)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    return Finding("disk", free >= NEEDED_DISK, f"{free:.1f} GiB free here", f"make room: have {NEEDED_DISK:g} GiB")


def _cache() -> Finding:
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        remedy = "make it writable, or set XDG_CACHE_HOME: layouts are settled and pieces made in every run else"
        return Finding("cache", False, f"{folder}: {error.strerror}", remedy)
    return Finding("cache", True, f"{folder} can be written")


def _warp() -> Finding:
    remedy = "pip install warp-lang"
    try:
        import warp  # whether it can be imported is the question

        with quiet_warp():
            devices = ", ".join(str(device) for device in warp.get_devices())
    except (ImportError, RuntimeError) as error:
        return Finding("warp", False, str(error), remedy)
    return Finding("warp", True, f"{version('warp-lang')} on {devices}")


def _memory() -> Finding:
    available = unused_memory()
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    remedy = (
        f"have {NEEDED_MEMORY:g} GiB for a worker of the default scene: close programs, or render with fewer workers"
    )
    return Finding("memory", total >= NEEDED_MEMORY, f"{available:.1f} of {total:.1f} GiB unused", remedy)
