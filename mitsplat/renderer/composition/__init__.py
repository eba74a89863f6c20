"""Composition of all layers of a view from splats, meshes and light.

In: a Mitsuba scene, a sensor and the settings of the integrator. Out: layers as device arrays, and silhouettes.
"""
