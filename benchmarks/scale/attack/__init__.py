"""Hostile input for every command that reads files of others.

Each attack must fail with one sentence, or have no effect.

Each kind of input has a module; :mod:`benchmarks.scale.attack.attack` runs an attack and evaluates it.
"""
