"""Planning of layouts and frames from the seed: objects, surroundings, cameras, lights and predicted visibility.

In: a :class:`~mitsplat.scene.scene.Scene`, which holds the seed, and the index of a frame. Out: a
:class:`~mitsplat.scene.planning.frame_plan.FramePlan`.
"""
