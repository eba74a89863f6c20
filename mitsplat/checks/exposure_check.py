"""Check of a small picture of a scene for black or clipped surfaces."""

from __future__ import annotations

import warnings

import numpy as np

from mitsplat.findings import Finding
from mitsplat.frames.frame import render_frame
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.images.colour import LUMINANCE
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene

WIDTH = 160
"""Width of the picture [px]."""
MIN_MEAN = 8.0
"""Least mean luminance of surfaces [of 255]."""
MAX_CLIPPED = 0.5
"""Largest share of surface pixels with a channel at 255."""


def check_exposure(scene: Scene) -> Finding:
    """Check a picture of the first frame for black or clipped surfaces.

    One object of each entry is placed at the bottom of a region, because settling a layout takes longer.
    """
    camera = plan_frame(scene, 0).camera
    camera = camera.resized(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))
    with warnings.catch_warnings():  # of a view without objects, which another check reports
        warnings.simplefilter("ignore")
        frame = render_frame(scene, 0, quality="fast", layout=_placed_objects(scene), camera=camera)
    surfaces = frame.image[frame.layers.alpha > 0.5]
    if not len(surfaces):
        return Finding("exposure", True, "the first view shows no surface")
    mean, clipped = float((surfaces @ LUMINANCE).mean()), float((surfaces == 255).any(axis=-1).mean())
    ok = mean >= MIN_MEAN and clipped <= MAX_CLIPPED
    text = f"surfaces have a mean luminance of {mean:.0f} of 255, and {clipped:.0%} of their pixels are clipped"
    return Finding("exposure", ok, text, "set composite.exposure to auto or another exposure, or change the lights")


def _placed_objects(scene: Scene) -> Layout:
    """Return a layout with one object of each entry, side by side at the bottom of its first region."""
    poses: dict[str | int, list[np.ndarray | None]] = {}
    for number, (entry, pool) in enumerate(zip(scene.spec.objects, scene.pools, strict=True)):
        region, _ = scene.spec.all_regions[scene.spec.regions_of(entry)[0]]
        share = (number + 0.5) / len(scene.pools)
        x, y = np.add(region.min[:2], share * np.subtract(region.max[:2], region.min[:2]))
        pose = homogeneous_matrix(np.eye(3), (x, y, region.min[2]))
        absent = (len(entry.poses) or entry.count[0]) - 1
        poses.setdefault(pool[0], []).extend([pose, *[None] * absent])
    return Layout.from_poses(scene, poses)
