"""Scripts that time and compare; run them from the repository's root as ``python -m benchmarks.NAME``."""
