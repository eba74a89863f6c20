"""Benchmarks of the wing: scale."""
