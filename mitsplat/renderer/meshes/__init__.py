"""Visible meshes, and splats that they mirror.

In: meshes with materials. Out: the radiance of visible meshes, and of splats along reflected rays.
"""
