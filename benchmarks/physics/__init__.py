"""Benchmarks of physics."""
