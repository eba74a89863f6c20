"""Splats and proxy meshes to layers, by the integrator ``splat_proxy``.

In: Gaussians, meshes and lights as Mitsuba's shapes and emitters, and a camera. Out: :class:`Layers`, as arrays:
linear colour, depth, instance ids, light and highlight; and the silhouette of every instance alone. The work is done
by :mod:`mitsplat.plugins`, one stage a module.
"""

from __future__ import annotations

from mitsplat.renderer.layers import (
    Layers,
    make_integrator,
    make_splats_shape,
    render_layers,
    render_silhouettes,
    render_splats,
)
from mitsplat.renderer.scene_emitters import emitter_dict

__all__ = [
    "Layers",
    "emitter_dict",
    "make_integrator",
    "make_splats_shape",
    "render_layers",
    "render_silhouettes",
    "render_splats",
]
