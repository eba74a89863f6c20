"""Sorting on the device and on the host."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
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
