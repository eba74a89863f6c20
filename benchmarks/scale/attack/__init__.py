"""Hostile input for every command that reads files of others: each attack must fail in one sentence, or do nothing.

One module for each kind of input; :mod:`benchmarks.scale.attack.attack` runs an attack and judges it.
"""
