"""Synthetic layouts and frames, without physics and renderer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from mitsplat.frames.frame import Frame
from mitsplat.images.masks import Silhouette
from mitsplat.labels.labels import LabelRules, Labels, Truth, label_instances
from mitsplat.renderer.layers import Layers
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.streams import random_stream

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


def settle(scene, index, *, progress):
    """Place three objects at random positions, without physics."""
    rng = random_stream(scene.spec.seed, "synthetic layout", index)
    instances = []
    for i in range(3):
        pose = np.eye(4)
        pose[:3, 3] = rng.uniform(-1, 1, 3)
        instances.append(Instance(i + 1, i % len(scene.assets), i % len(scene.class_names), pose))
    return Layout(index, tuple(instances), CERTIFICATE)


def render(scene, index, *, layout):
    """Draw a disc per object on noise."""
    plan = plan_frame(scene, index, layout)
    camera = plan.camera
    rng = np.random.default_rng(plan.seed)
    ids = np.zeros((camera.height, camera.width), dtype=np.int32)
    for instance in layout.instances:
        x, y = (instance.world_from_object[:2, 3] * 0.4 + 0.5) * (camera.width, camera.height)
        cv2.circle(ids, (int(x), int(y)), 7, instance.id, cv2.FILLED)
    image = rng.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
    silhouettes = {int(i): Silhouette.cropped(ids == i, 0, 0) for i in np.unique(ids[ids > 0])}
    labels = label_instances(Truth(ids, ids, silhouettes, ids), layout.instances, scene.class_names, LabelRules())
    normal = np.stack(np.meshgrid(range(camera.width), range(camera.height), [0.5]), -1)[:, :, 0].astype(np.float32)
    return frame_around(plan, layout, labels, image=image, ids=ids, depth=ids, normal=normal)
