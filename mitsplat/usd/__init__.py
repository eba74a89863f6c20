"""Exchange with simulators: OpenUSD stages in and out, and MJCF out.

In: a USD stage with particle fields of Gaussian splats, or an asset or a frame of a scene. Out: an
:class:`~mitsplat.asset.Asset`, or a USD stage or an MJCF model with splats, colliders, masses, cameras, lights and
labels. USD needs the extra ``usd`` (usd-core).
"""
