"""Benchmarks of the wing: labels."""
