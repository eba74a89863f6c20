"""Benchmarks of scale and robustness."""
