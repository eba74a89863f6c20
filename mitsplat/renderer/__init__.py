"""Renderer of splats and proxy meshes, called through the integrator ``splat_proxy``.

In: Gaussians, meshes and lights as Mitsuba's shapes and emitters, and a camera. Out: :class:`Layers` as arrays (linear
colour, depth, instance ids, light and highlight), and the unoccluded silhouette of every instance. Each stage has a
subpackage; :mod:`mitsplat.plugins` connects them to Mitsuba.
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
