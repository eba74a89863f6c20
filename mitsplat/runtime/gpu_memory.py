"""Unused GPU memory from NVIDIA's management library (NVML), which does not start CUDA.

When Dr.Jit is imported, it starts CUDA on every visible GPU. It ends the process if a GPU has no memory for that, even
if the process computes on the CPU. GPUs with full memory are therefore hidden before the import.
"""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass

VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
GPU_ORDER = "CUDA_DEVICE_ORDER"

MIN_UNUSED_MEMORY = 2**30
"""GPU memory for the start of a process [bytes]; on an H200, half of it is used before any computation."""


class _Memory(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_ulonglong) for name in ("total", "unused", "used"))


@dataclass(frozen=True)
class GpuMemory:
    """Memory of one GPU: its model, and unused memory [bytes]."""

    model: str
    unused: int


def gpu_memory() -> dict[str, GpuMemory]:
    """Return the memory of every GPU of this machine by its id, in the order of PCI buses; {} if unknown."""
    try:
        library = ctypes.CDLL("libnvidia-ml.so.1")
    except OSError:
        return {}
    if library.nvmlInit_v2():
        return {}
    count, found = ctypes.c_uint(0), {}
    library.nvmlDeviceGetCount_v2(ctypes.byref(count))
    for index in range(count.value):
        handle, memory = ctypes.c_void_p(), _Memory()
        name, model = ctypes.create_string_buffer(96), ctypes.create_string_buffer(96)
        if not (
            library.nvmlDeviceGetHandleByIndex_v2(index, ctypes.byref(handle))
            or library.nvmlDeviceGetUUID(handle, name, len(name))
            or library.nvmlDeviceGetName(handle, model, len(model))
            or library.nvmlDeviceGetMemoryInfo(handle, ctypes.byref(memory))
        ):
            found[name.value.decode()] = GpuMemory(model.value.decode(errors="replace"), int(memory.unused))
    library.nvmlShutdown()
    return found


def unused_gpu_memory() -> dict[str, int]:
    """Return the unused memory [bytes] of every GPU by its id, in the order of PCI buses; {} if unknown."""
    return {name: memory.unused for name, memory in gpu_memory().items()}


def hide_full_gpus() -> None:
    """Hide GPUs with less than :data:`MIN_UNUSED_MEMORY` from this process; CUDA must not have been started."""
    found = gpu_memory()
    full = {name for name, one in found.items() if one.unused < MIN_UNUSED_MEMORY}
    if not full:
        return
    ids = list(found)
    named = os.environ.get(VISIBLE_GPUS, ",".join(ids)).split(",")
    by_bus = os.environ.get(GPU_ORDER) == "PCI_BUS_ID" or len({one.model for one in found.values()}) == 1
    numbered = {str(number): name for number, name in enumerate(ids)} if by_bus else {}
    usable = [name for name in named if numbered.get(name.strip(), name.strip()) not in full]
    os.environ[VISIBLE_GPUS] = ",".join(usable)
