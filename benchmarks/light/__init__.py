"""Benchmarks of light."""
