"""Gaussian splatting on Dr.Jit: tile lists, sorting, ray march, instance votes.

In: clouds of Gaussians, their placements and a view. Out: colour, opacity, depth and instance ids per pixel.
"""
