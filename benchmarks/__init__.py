"""Benchmark scripts; run them from the repository's root as ``python -m benchmarks.NAME``."""

import mitsplat  # noqa: F401 - points Dr.Jit to its LLVM before a script imports Mitsuba
