"""Cameras and triangle meshes.

In: intrinsics, poses and meshes. Out: :class:`~mitsplat.geometry.camera.Camera`, mass properties, signed distances,
normals and convex decompositions.
"""
