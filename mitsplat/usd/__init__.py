"""Exchange with simulators: OpenUSD stages in and out, MJCF out, and live poses.

In: a USD stage with particle fields of Gaussian splats, an asset or a frame of a scene, or the state of a simulation.
Out: an :class:`~mitsplat.asset.Asset`, a USD stage or an MJCF model with splats, colliders, masses, cameras, lights and
labels, or a :class:`~mitsplat.scene.layout.Layout`. USD needs the extra ``usd`` (usd-core).
"""
