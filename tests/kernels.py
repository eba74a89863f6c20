"""What Dr.Jit's kernels trace, read from the code that it generates: no GPU is needed to see what one would refuse."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr

TRACE = re.compile(r"call void %rd\d+\(ptr %u\d+_in_0_\w+, ptr (%rd\d+), ptr %u\d+_in_ctx")
"""A call of Embree in LLVM's language: context, the register that holds the scene, rays."""


@contextmanager
def traced_scenes() -> Iterator[list[int]]:
    """Count the ray-tracing scenes of each kernel that is launched in the block; of the variant llvm_ad_rgb.

    On CUDA, rays of a second one are left out.
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
