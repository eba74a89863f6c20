"""Primary visibility and complete silhouettes of instances.

In: tile lists and visible meshes. Out: the instance that each pixel shows, and the mask that each instance would have
without occluders.
"""
