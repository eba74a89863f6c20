"""Sorting on the device and on the host."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def stable_order(key: Any, bits: int) -> Any:
    """Stable order of keys of so many bits: positions in ``key``.

    A radix sort like Dr.Jit's own, which knows no keys shorter than 32 bits.
    """
    count, order = dr.width(key), None
    radix = 16 if dr.backend_v(key) == dr.JitBackend.LLVM else 8
    passes = -(-bits // radix)
    width = -(-bits // passes)
    for shift in range(0, bits, width):
        digit = mi.UInt32((key if order is None else dr.gather(type(key), key, order)) >> shift) & ((1 << width) - 1)
        dr.eval(digit)
        permutation = dr.detail.block_mkperm(digit, count, 1 << width)
        order = permutation if order is None else dr.gather(mi.UInt32, order, permutation)
        dr.eval(order)
    return order


CPUINFO = Path("/proc/cpuinfo")
"""Where Linux describes its processors."""


@cache
def numpy_sorts_slowly() -> bool:
    """Whether NumPy's sort is slow on this processor: then :func:`stable_order` takes a third of its time.

    On AMD's Zen 4 (family 25 with AVX-512) it stores chosen lanes to memory by an instruction that is microcoded there:
    https://github.com/numpy/x86-simd-sort/issues/6. Zen 5 has it in hardware, and Zen 3 has no AVX-512.
    """
    try:
        with CPUINFO.open() as file:
            first = file.read(1 << 14).split("\n\n")[0]
    except OSError:
        return False
    family = re.search(r"^cpu family\s*: (\d+)$", first, re.MULTILINE)
    return "AuthenticAMD" in first and family is not None and int(family[1]) == 25 and " avx512f " in first


def sort_in_threads(values: np.ndarray, threads: int) -> None:
    """Sort in place, by halves in several threads where that is worth it: all of them take more time than one alone."""
    if threads == 1 or len(values) < 1 << 16:
        values.sort()
        return
    middle = len(values) // 2
    values.partition(middle)
    with ThreadPoolExecutor(1) as pool:
        half = pool.submit(sort_in_threads, values[:middle], threads // 2)
        sort_in_threads(values[middle:], threads - threads // 2)
        half.result()
