"""Primary visibility, complete silhouettes and antialiased borders of instances.

In: tile lists and visible meshes. Out: the instance that each pixel shows, the mask that each instance would have
without occluders, and finer rays at the borders of instances.
"""
