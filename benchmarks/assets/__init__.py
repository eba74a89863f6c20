"""Benchmarks of the wing: assets."""
