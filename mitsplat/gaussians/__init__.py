"""Gaussian splats in memory and on disk.

In: splat files (PLY, SPZ, SOG, SPLAT, KSPLAT) or arrays. Out: :class:`~mitsplat.gaussians.splat_cloud.Splats`, their
spherical harmonics, and flat Gaussians on a surface.
"""
