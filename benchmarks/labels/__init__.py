"""Benchmarks of labels."""
