"""Emitters as sources of direct light: sampling, lamps along rays, and the irradiance of the sky.

In: a Mitsuba scene and points. Out: sampled directions with their light and density.
"""
