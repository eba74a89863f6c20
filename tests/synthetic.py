"""Synthetic data without physics and renderer: a certificate, and frames from given maps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mitsplat.frames.frame import Frame
from mitsplat.labels.labels import Labels
from mitsplat.renderer.layers import Layers
from mitsplat.scene.layout import NO_PHYSICS

CERTIFICATE = replace(NO_PHYSICS, time_to_rest=1.5, collider_penetration=1e-5, attempts=2, refused=("too deep",))


def frame_around(plan: Any, layout: Any, labels: Labels, *, image: Any, ids: Any, depth: Any, normal: Any) -> Frame:
    """Build a frame from given maps, with equal maps of splats and proxies and the captured light."""
    colour, ids, depth = image.astype(np.float32) / 255, ids.astype(np.uint16), depth.astype(np.float32)
    layers = Layers(
        rgb=colour,
        alpha=np.ones(ids.shape, dtype=np.float32),
        captured=colour,
        depth=depth,
        instance=ids,
        proxy_depth=depth,
        proxy_instance=ids,
        normal=normal,
        light=np.ones_like(colour),
        highlight=np.zeros_like(colour),
    )
    return Frame(plan, layout, layers, colour, image, labels, {"march": 0.01}, {"largest": 0.004, "mean": 2e-5})
