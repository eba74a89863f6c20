"""Selection of the compute device: the CPU by ``llvm_ad_rgb``, an NVIDIA GPU by ``cuda_ad_rgb``.

Device names are ``cpu``, ``cuda`` (CUDA's first GPU), ``cuda:N`` (one of several, from 0), ``cuda:all`` (all GPUs, if
several processes make a dataset) and ``auto`` (``cuda`` if the driver and OptiX are complete, else ``cpu``). N is the
position in ``CUDA_VISIBLE_DEVICES``. Without this variable, N follows the order of PCI buses, as in ``nvidia-smi``;
CUDA itself begins with the fastest GPU.

A process computes on its first visible GPU. This GPU is fixed when Mitsuba is imported, because Dr.Jit then starts
CUDA. Another GPU needs a process that is started with :func:`gpu_environment`.
"""

from __future__ import annotations

import ctypes
import os
import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import mitsuba as mi

from mitsplat.errors import InputError, LateDeviceError, MissingResourceError
from mitsplat.runtime.gpu_memory import MIN_UNUSED_MEMORY, VISIBLE_GPUS, unused_gpu_memory
from mitsplat.runtime.threads import MIN_THREADS, ensure_threads
from mitsplat.runtime.variant import VARIANTS, choose_variant

Kind = Literal["cpu", "cuda"]

GPU_NUMBER = "MITSPLAT_GPU"
"""Environment variable: N of the ``cuda:N`` that is the only visible GPU of this process."""

_DEVICE = re.compile(r"cpu|auto|cuda(:all|:[0-9]{1,4})?")


@dataclass(frozen=True)
class Gpu:
    """An NVIDIA GPU that is visible to this process.

    Attributes:
        name: Product name.
        memory: Unused memory [bytes], or total memory if the unused part is unknown.
        ordinal: CUDA device index in this process; Dr.Jit computes on 0.
        bus: PCI bus id.
        id: Value of ``CUDA_VISIBLE_DEVICES`` that selects only this GPU; empty if it is already the only one.
    """

    name: str
    memory: int
    ordinal: int
    bus: str
    id: str


@dataclass(frozen=True)
class Device:
    """Compute device.

    Attributes:
        kind: Kind of processor, which determines the output bytes.
        gpus: GPUs to use, each by separate processes.
        reason: Reason of the choice, if ``auto`` was requested.
    """

    kind: Kind
    gpus: tuple[Gpu, ...] = ()
    reason: str = ""

    def __str__(self) -> str:
        names = ", ".join(gpu.name for gpu in self.gpus)
        return f"{self.kind} ({names})" if names else self.kind

    @property
    def is_usable_here(self) -> bool:
        """True if this process can compute on the device."""
        return self.kind == "cpu" or any(gpu.ordinal == 0 for gpu in self.gpus)


CPU = Device("cpu")


class MissingPrerequisite(NamedTuple):
    """Missing prerequisite of a GPU.

    Attributes:
        what: The prerequisite, as the rest of "because ...".
        remedy: Recommended action.
    """

    what: str
    remedy: str


def use_device(device: str | Device) -> Device:
    """Select the device of this process, by setting Mitsuba's variant.

    Args:
        device: ``cpu``, ``cuda``, ``cuda:N`` or ``auto``. For ``cuda:all``, a process uses the first GPU.

    Returns:
        The device; its ``reason`` explains the choice of ``auto``.

    Raises:
        InputError: If there is no such device, or another GPU than the named one is the first visible one.
        MissingResourceError: If there is no GPU, or no complete driver, or no usable LLVM for the CPU.
    """
    found = find_device(device)
    if not found.is_usable_here:
        gpu = found.gpus[0]
        raise LateDeviceError(
            f"{device} must be the first visible GPU when mitsplat is imported: set {VISIBLE_GPUS}={gpu.id} before the "
            "import, and use the device cuda",
            {**gpu_environment(gpu), GPU_NUMBER: str(device).partition(":")[2]},
        )
    choose_variant(VARIANTS[found.kind == "cuda"])
    return found


def use_shared_device(kind: Kind, threads: int | None = None) -> None:
    """Select a device like :func:`use_device`, in one of several processes that share its cores.

    On a GPU, Dr.Jit's threads only build scenes. Few threads do this in a tenth of the time of sixteen threads. OpenCV
    uses one thread: by default, it would keep one busy for each core in every process.

    Args:
        kind: Kind of the device.
        threads: Number of threads on a CPU, at least MIN_THREADS; None for one per core.
    """
    import cv2  # takes a tenth of a second, which only processes of a pool need

    use_device(kind)
    cv2.setNumThreads(1)
    ensure_threads(MIN_THREADS if kind == "cuda" else threads)


def current_device() -> Device:
    """Return the device of Mitsuba's current variant, or ``cpu`` if none is set."""
    return find_device("cuda") if mi.variant() == VARIANTS[1] else CPU


def find_device(device: str | Device) -> Device:
    """Return a device of this machine by its name, without selecting it.

    Raises:
        InputError, MissingResourceError: As :func:`use_device`.
    """
    if isinstance(device, Device):
        return device
    if not isinstance(device, str) or not _DEVICE.fullmatch(device):
        raise InputError(f"device must be cpu, cuda, cuda:N, cuda:all or auto (got {device})")
    if device == "cpu":
        return CPU
    gpus = visible_gpus()
    if isinstance(gpus, MissingPrerequisite):
        if device == "auto":
            return Device("cpu", reason=gpus.what)
        raise MissingResourceError(
            f"{device} cannot be used, because {gpus.what}: {gpus.remedy}, or use the device cpu"
        )
    first = tuple(gpu for gpu in gpus if gpu.ordinal == 0)
    if device == "auto":
        return Device("cuda", first, "NVIDIA's driver and OptiX are complete")
    if device == "cuda":
        return Device("cuda", first)
    which = device.partition(":")[2]
    if which == "all":
        return Device("cuda", gpus)
    if which == os.environ.get(GPU_NUMBER):
        return Device("cuda", first)
    if int(which) >= len(gpus):
        numbers = f"cuda:0 to cuda:{len(gpus) - 1}" if len(gpus) > 1 else "cuda:0"
        raise InputError(f"device must be one of the visible GPUs, {numbers} (got {device})")
    return Device("cuda", (gpus[int(which)],))


def gpu_environment(gpu: Gpu | None) -> dict[str, str]:
    """Return the environment variables of a process for which this GPU is the only visible one; None changes none."""
    return {VISIBLE_GPUS: gpu.id} if gpu is not None and gpu.id else {}


def visible_gpus() -> tuple[Gpu, ...] | MissingPrerequisite:
    """Return the GPUs on which Mitsuba can trace rays (at least one), or the missing prerequisite."""
    driver = _library("libcuda.so.1")
    if driver is None:
        return MissingPrerequisite("NVIDIA's driver is missing (libcuda.so.1)", "install it")
    count = ctypes.c_int(0)
    status = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count))
    unused = unused_gpu_memory()
    if (status or not count.value) and any(memory < MIN_UNUSED_MEMORY for memory in unused.values()):
        most = max(unused.values()) / 2**30
        return MissingPrerequisite(
            f"the GPU has only {most:.1f} GiB of unused memory", "end a program on it (`nvidia-smi` lists them)"
        )
    if status or not count.value:
        problem = f"NVIDIA's driver finds no GPU (status {status})"
        return MissingPrerequisite(problem, f"check `nvidia-smi` and {VISIBLE_GPUS}")
    if _library("libnvoptix.so.1") is None:
        return MissingPrerequisite(
            "NVIDIA's driver lacks OptiX, which traces rays (libnvoptix.so.1)",
            "install the complete driver (in a container, set NVIDIA_DRIVER_CAPABILITIES=all)",
        )
    found = [_gpu(driver, ordinal, unused, alone=count.value == 1) for ordinal in range(count.value)]
    return tuple(found if os.environ.get(VISIBLE_GPUS) else sorted(found, key=lambda gpu: gpu.bus))


def _gpu(driver: ctypes.CDLL, ordinal: int, unused: Mapping[str, int], *, alone: bool) -> Gpu:
    """Return the GPU with an index of the driver, and its memory from ``unused`` [bytes], by id."""
    name, bus, number = (ctypes.create_string_buffer(size) for size in (256, 64, 16))
    handle, memory = ctypes.c_int(0), ctypes.c_size_t(0)
    driver.cuDeviceGet(ctypes.byref(handle), ordinal)
    driver.cuDeviceGetName(name, len(name), handle)
    driver.cuDeviceGetPCIBusId(bus, len(bus), handle)
    driver.cuDeviceGetUuid(number, handle)
    driver.cuDeviceTotalMem_v2(ctypes.byref(memory), handle)
    own = f"GPU-{uuid.UUID(bytes=number.raw)}"
    return Gpu(
        name.value.decode(errors="replace"),
        unused.get(own, memory.value),
        ordinal,
        bus.value.decode(errors="replace"),
        "" if alone else own,  # a partition of a GPU has another name
    )


def _library(name: str) -> ctypes.CDLL | None:
    """Load a library of the driver, or return None."""
    try:
        return ctypes.CDLL(name)
    except OSError:
        return None
