"""Benchmarks of the wing: render."""
