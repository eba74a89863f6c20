"""Benchmarks of the wing: light."""
