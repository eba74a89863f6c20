"""Benchmarks of assets."""
