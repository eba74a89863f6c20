"""Benchmarks of the wing: physics."""
