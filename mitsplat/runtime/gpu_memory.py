"""What of a GPU's memory no program has taken, by NVIDIA's management library, which starts nothing on a GPU.

Dr.Jit starts CUDA on every visible GPU as it is imported, and ends the process where one has no memory for that, even
one that is to compute on the CPU. So GPUs that are full are hidden from it before.
"""

from __future__ import annotations

import ctypes
import os

VISIBLE = "CUDA_VISIBLE_DEVICES"

NEEDED = 2**30
"""Memory that a process takes before it has computed anything [bytes]: half of it on an H200."""


class _Memory(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_ulonglong) for name in ("total", "unused", "used"))


def unused_gpu_memory() -> dict[str, int]:
    """Unused memory [bytes] of every GPU of this machine, by its id and in the order of PCI buses; {} if unknown."""
    try:
        library = ctypes.CDLL("libnvidia-ml.so.1")
    except OSError:
        return {}
    if library.nvmlInit_v2():
        return {}
    count, found = ctypes.c_uint(0), {}
    library.nvmlDeviceGetCount_v2(ctypes.byref(count))
    for index in range(count.value):
        handle, name, memory = ctypes.c_void_p(), ctypes.create_string_buffer(96), _Memory()
        if not (
            library.nvmlDeviceGetHandleByIndex_v2(index, ctypes.byref(handle))
            or library.nvmlDeviceGetUUID(handle, name, len(name))
            or library.nvmlDeviceGetMemoryInfo(handle, ctypes.byref(memory))
        ):
            found[name.value.decode()] = int(memory.unused)
    library.nvmlShutdown()
    return found


def hide_full_gpus() -> None:
    """Make GPUs with less than :data:`NEEDED` unused invisible to this process, which must not have begun with CUDA."""
    memory = unused_gpu_memory()
    if all(unused >= NEEDED for unused in memory.values()):
        return
    ids = list(memory)
    named = os.environ.get(VISIBLE, ",".join(ids)).split(",")
    numbered = {str(number): name for number, name in enumerate(ids)}
    kept = [name for name in named if memory.get(numbered.get(name.strip(), name.strip()), NEEDED) >= NEEDED]
    os.environ[VISIBLE] = ",".join(kept)
