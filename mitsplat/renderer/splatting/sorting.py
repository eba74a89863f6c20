"""Sorting of 64-bit keys on the device and on the host. Module `tiles` sorts the Gaussians of tiles with it."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np


def stable_order(key: mi.UInt32, bits: int) -> mi.UInt32:
    """Return the stable sort order of keys with ``bits`` bits, as positions in ``key``.

    This is a radix sort like Dr.Jit's own, which always sorts 32 bits or more.
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
"""Linux file with the processor description."""


@cache
def numpy_sorts_slowly() -> bool:
    """Return True if NumPy's sort takes three times as long as :func:`stable_order` on this processor.

    On AMD's Zen 4 (family 25 with AVX-512), the compress-store instruction of NumPy's sort is microcoded:
    https://github.com/numpy/x86-simd-sort/issues/6. Zen 5 executes it in hardware, and Zen 3 has no AVX-512.
    """
    try:
        with CPUINFO.open() as file:
            first = file.read(1 << 14).split("\n\n")[0]
    except OSError:
        return False
    family = re.search(r"^cpu family\s*: (\d+)$", first, re.MULTILINE)
    return "AuthenticAMD" in first and family is not None and int(family[1]) == 25 and " avx512f " in first


def sort_in_threads(values: np.ndarray, threads: int) -> None:
    """Sort in place; large arrays are partitioned into halves that several threads sort.

    All threads together take more CPU time than one thread, so small arrays are sorted by one.
    """
    if threads == 1 or len(values) < 1 << 16:
        values.sort()
        return
    middle = len(values) // 2
    values.partition(middle)
    with ThreadPoolExecutor(1) as pool:
        half = pool.submit(sort_in_threads, values[:middle], threads // 2)
        sort_in_threads(values[middle:], threads - threads // 2)
        half.result()
