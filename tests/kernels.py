"""Ray-tracing scenes in Dr.Jit kernels, read from generated code.

Without a GPU, this finds kernels that CUDA does not support.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr

TRACE = re.compile(r"call void %rd\d+\(ptr %u\d+_in_0_\w+, ptr (%rd\d+), ptr %u\d+_in_ctx")
"""Call of Embree in LLVM IR: context, the register that holds the scene, rays."""


@contextmanager
def traced_scenes() -> Iterator[list[int]]:
    """Count the ray-tracing scenes of each kernel launched in the block, for the variant llvm_ad_rgb.

    CUDA omits the rays of a second scene in a kernel.
    """
    numbers: list[int] = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield numbers
        for kernel in dr.kernel_history():
            if kernel["type"] == dr.KernelType.JIT:
                scenes = set(TRACE.findall(_text(kernel["ir"])))
                numbers.append(len(scenes))


def _text(code: object) -> str:
    return code if isinstance(code, str) else code.getvalue()  # type: ignore[attr-defined]
