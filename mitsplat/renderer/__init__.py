"""Renderer of splats and proxy meshes, called through the integrator ``splat_proxy``.

In: Gaussians, meshes and lights as Mitsuba's shapes and emitters, and a camera. Out: :class:`Layers` as arrays (linear
colour, depth, instance ids, light and highlight), and the unoccluded silhouette of every instance. Each stage has a
subpackage; :mod:`mitsplat.plugins` connects them to Mitsuba.

The stages of one frame, called by :mod:`~mitsplat.renderer.composition.layer_renderer`:

1. Rays through the pixel centres (``rays``).
2. Visible meshes and lamps along them (``meshes``, ``emitters``), which limit the depth of the splats.
3. Splats: project, list and sort by tile, and blend (``splatting``). Instances are determined by votes.
4. The nearest proxy mesh of each ray, whose surface receives light.
5. Light at the visible points: shadow rays, reflections and indirect light (``light``, ``interreflection``); paths for
   visible meshes that are not diffuse (``meshes``).
6. Colours times light, composed by visibility (``composition``).
7. Further rays at borders between instances (``instances``).
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
