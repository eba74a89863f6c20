"""Where objects come to rest.

In: a :class:`~mitsplat.scene.scene.Scene` and the index of a layout. Out: a :class:`~mitsplat.scene.layout.Layout`
with a certificate of what was measured of its rest on the true meshes. A layout is drawn, dropped and certified in
:mod:`.drop`, declared at rest by :func:`.rest.run_to_rest`, and kept by the hash of all that decides it in
:mod:`.settle`.
"""

from __future__ import annotations

from mitsplat.physics.settle import replay_layout, settle_layout, settle_layouts

__all__ = ["replay_layout", "settle_layout", "settle_layouts"]
