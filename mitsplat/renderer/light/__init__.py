"""Traced light on splats: shadow rays, one bounce, reflections, filtering.

In: visible surface points, proxy meshes and emitters. Out: irradiance with and without occluders, and reflected light
per pixel.
"""
