"""Benchmarks of rendering."""
