"""Physics simulation of resting poses.

Input: a :class:`~mitsplat.scene.scene.Scene` and the index of a layout. Output: a
:class:`~mitsplat.scene.layout.Layout` with a certificate of its rest, measured on the original meshes. :mod:`.bodies`
makes rigid bodies of assets, :mod:`.static_scene` what they fall on. :mod:`.drop` draws and drops a layout, and
:mod:`.certificate` checks it. :mod:`.worlds` has the two physics engines, of which the scene selects one.
:mod:`.handling` tosses, pushes and shakes objects. :func:`.rest.run_to_rest` detects rest. :mod:`.friction` and
:mod:`.restitution` state the laws of contacts. :mod:`.settle` caches layouts by the hash of all their inputs.
"""

from __future__ import annotations

from mitsplat.physics.settle import ReplayMoment, replay_layout, settle_layout, settle_layouts

__all__ = ["ReplayMoment", "replay_layout", "settle_layout", "settle_layouts"]
