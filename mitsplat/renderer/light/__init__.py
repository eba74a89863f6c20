"""Traced light on splats: emitter sampling, shadow rays, one bounce, highlights, filtering.

In: visible surface points, proxy meshes and emitters. Out: irradiance with and without occluders, and a highlight per
pixel.
"""
