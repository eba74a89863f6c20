"""Which processor computes: the CPU by ``llvm_ad_rgb``, an NVIDIA GPU by ``cuda_ad_rgb``.

Devices are named ``cpu``, ``cuda`` (the GPU that CUDA counts first), ``cuda:N`` (one of several, from 0), ``cuda:all``
(all of them, where several processes make a dataset) and ``auto`` (``cuda`` if the driver and OptiX are whole, else
``cpu``). N counts as in ``CUDA_VISIBLE_DEVICES``; without it in the order of PCI buses, as in ``nvidia-smi``, where
CUDA itself begins with the fastest.

A process computes on the first GPU that is visible to it, which is settled when Mitsuba is imported: Dr.Jit starts CUDA
then. Another one is for a process that starts with :func:`gpu_environment`.
"""

from __future__ import annotations

import ctypes
import os
import re
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import drjit as dr
import mitsuba as mi

from mitsplat.errors import InputError, LateDeviceError, MissingResourceError
from mitsplat.runtime.gpu_memory import NEEDED, VISIBLE, unused_gpu_memory
from mitsplat.runtime.variant import VARIANTS, choose_variant

Kind = Literal["cpu", "cuda"]

NUMBER = "MITSPLAT_GPU"
"""Environment variable: the N of the ``cuda:N`` that alone is visible to this process."""

_DEVICE = re.compile(r"cpu|auto|cuda(:all|:\d{1,4})?")


@dataclass(frozen=True)
class Gpu:
    """An NVIDIA GPU that is visible to this process.

    Attributes:
        name: As its maker calls it.
        memory: What of it no program has taken [bytes], or all of it where that is unknown.
        ordinal: Its number as CUDA counts in this process; Dr.Jit computes on 0.
        bus: Its place on the PCI bus.
        id: What makes it alone visible to another process by ``CUDA_VISIBLE_DEVICES``; empty if it is alone already.
    """

    name: str
    memory: int
    ordinal: int
    bus: str
    id: str


@dataclass(frozen=True)
class Device:
    """What to compute on.

    Attributes:
        kind: What decides bytes.
        gpus: Those to use, each by processes of its own.
        reason: Why it is this one, if ``auto`` chose it.
    """

    kind: Kind
    gpus: tuple[Gpu, ...] = ()
    reason: str = ""

    def __str__(self) -> str:
        names = ", ".join(gpu.name for gpu in self.gpus)
        return f"{self.kind} ({names})" if names else self.kind

    @property
    def is_here(self) -> bool:
        """Whether this process can compute on it."""
        return self.kind == "cpu" or any(gpu.ordinal == 0 for gpu in self.gpus)


CPU = Device("cpu")


class Lack(NamedTuple):
    """What a GPU is missing, for "as ...", and what to do about it."""

    what: str
    remedy: str


def use_device(device: str | Device) -> Device:
    """Compute on a device from now on, in this process: choose Mitsuba's variant for it.

    Args:
        device: ``cpu``, ``cuda``, ``cuda:N`` or ``auto``. Of ``cuda:all`` a process takes the first.

    Returns:
        The device; its ``reason`` says why ``auto`` chose it.

    Raises:
        InputError: If there is no such device, or this process sees another GPU first than the one named.
        MissingResourceError: If there is no GPU, or no whole driver, or no usable LLVM for the CPU.
    """
    found = find_device(device)
    if not found.is_here:
        raise _too_late(str(device), found.gpus[0])
    choose_variant(VARIANTS[found.kind == "cuda"])
    return found


def use_share(kind: Kind) -> None:
    """As :func:`use_device`, in one of several processes, each of which would have a thread for every core.

    On a GPU Dr.Jit's threads only build scenes, for which one takes a tenth of the time that sixteen do.
    """
    use_device(kind)
    if kind == "cuda":
        dr.set_thread_count(1)


def current_device() -> Device:
    """The device that this process computes on: that of Mitsuba's variant, ``cpu`` if none is chosen yet."""
    return find_device("cuda") if mi.variant() == VARIANTS[1] else CPU


def find_device(device: str | Device) -> Device:
    """A device of this machine by its name; nothing is chosen yet.

    Raises:
        InputError, MissingResourceError: As :func:`use_device`.
    """
    if isinstance(device, Device):
        return device
    text = check_name(device)
    if text == "cpu":
        return CPU
    gpus = visible_gpus()
    if isinstance(gpus, Lack):
        if text == "auto":
            return Device("cpu", reason=gpus.what)
        raise MissingResourceError(f"{text} cannot be used, as {gpus.what}: {gpus.remedy}, or use the device cpu")
    first = tuple(gpu for gpu in gpus if gpu.ordinal == 0)
    if text == "auto":
        return Device("cuda", first, "NVIDIA's driver and OptiX are whole")
    if text == "cuda":
        return Device("cuda", first)
    which = text.partition(":")[2]
    if which == "all":
        return Device("cuda", gpus)
    if which == os.environ.get(NUMBER):
        return Device("cuda", first)
    if int(which) >= len(gpus):
        numbers = f"cuda:0 to cuda:{len(gpus) - 1}" if len(gpus) > 1 else "cuda:0"
        raise InputError(f"the GPUs that are visible here are {numbers} (got {text})")
    return Device("cuda", (gpus[int(which)],))


def _too_late(text: str, gpu: Gpu) -> LateDeviceError:
    return LateDeviceError(
        f"{text} must be the first GPU that a process sees when it imports mitsplat: set {VISIBLE}={gpu.id} "
        "before, and use the device cuda",
        {**gpu_environment(gpu), NUMBER: text.partition(":")[2]},
    )


def check_name(device: str) -> str:
    """The name of a device, which need not be here.

    Raises:
        InputError: If it is none.
    """
    if not _DEVICE.fullmatch(device):
        raise InputError(f"device must be cpu, cuda, cuda:N, cuda:all or auto (got {device})")
    return device


def gpu_environment(gpu: Gpu) -> dict[str, str]:
    """Variables with which a process starts to which a GPU alone is visible."""
    return {VISIBLE: gpu.id} if gpu.id else {}


@contextmanager
def starting_on(gpu: Gpu | None, **variables: str) -> Iterator[None]:
    """Processes that are started meanwhile see this GPU alone, or what this one does if None, and more variables."""
    changes = variables if gpu is None else variables | gpu_environment(gpu)
    kept = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def visible_gpus() -> tuple[Gpu, ...] | Lack:
    """GPUs on which Mitsuba can trace rays, at least one."""
    driver = _library("libcuda.so.1")
    if driver is None:
        return Lack("NVIDIA's driver is absent (libcuda.so.1)", "install it")
    count = ctypes.c_int(0)
    status = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count))
    unused = unused_gpu_memory()
    if (status or not count.value) and any(memory < NEEDED for memory in unused.values()):
        most = max(unused.values()) / 2**30
        return Lack(f"programs have taken all but {most:.1f} GiB of the GPU's memory", "end one (`nvidia-smi` tells)")
    if status or not count.value:
        return Lack(f"NVIDIA's driver finds no GPU (status {status})", f"see what `nvidia-smi` and {VISIBLE} say")
    if _library("libnvoptix.so.1") is None:
        return Lack(
            "NVIDIA's driver lacks OptiX, which traces rays (libnvoptix.so.1)",
            "install all of the driver (of a container: run it with NVIDIA_DRIVER_CAPABILITIES=all)",
        )
    found = [_gpu(driver, ordinal, unused, alone=count.value == 1) for ordinal in range(count.value)]
    return tuple(found if os.environ.get(VISIBLE) else sorted(found, key=lambda gpu: gpu.bus))


def _gpu(driver: Any, ordinal: int, unused: Mapping[str, int], *, alone: bool) -> Gpu:
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
        "" if alone else own,  # that of a part of a GPU would be another name
    )


def _library(name: str) -> Any:
    """A library of the driver, or None."""
    try:
        return ctypes.CDLL(name)
    except OSError:
        return None
