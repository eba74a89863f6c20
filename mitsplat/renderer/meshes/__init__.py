"""Visible meshes, and the splats that they reflect.

In: meshes with materials. Out: the radiance of visible meshes, and of splats along reflected rays.
"""
