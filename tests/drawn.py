"""Frames of boxes drawn without a renderer, with consistent masks, depths, poses and cameras."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.asset import Asset
from mitsplat.images.masks import Silhouette
from mitsplat.labels.labels import LabelRules, Truth, label_instances
from mitsplat.scene.layout import Instance, Layout
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.streams import random_stream
from tests.conftest import box_asset
from tests.synthetic import CERTIFICATE, frame_around

MARGIN = 80
"""Margin of silhouettes beyond the image [px]."""


def large_boxes() -> list[Asset]:
    """Build two assets with a size of at least a dozen pixels and one keypoint each."""
    boxes = box_asset("nut", (0.12, 0.16, 0.08)), box_asset("bolt", (0.06, 0.07, 0.25))
    return [replace(box, keypoints={"top": (0, 0, 0.04)}) for box in boxes]


def scatter_boxes(scene: Any, index: int, *, progress: Any) -> Layout:
    """Place four objects at random poses, without physics."""
    rng = random_stream(scene.spec.seed, "drawn layout", index)
    instances = []
    for i in range(4):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-0.17, 0.17, 3)
        instances.append(Instance(i + 1, i % 2, scene.class_names.index(scene.assets[i % 2].class_name), pose))
    return Layout(index, tuple(instances), CERTIFICATE)


def render_boxes(scene: Any, index: int, *, layout: Layout) -> Any:
    """Draw each box as the convex hull of its projected corners, at the depth of its centre.

    Nearer boxes occlude others.
    """
    plan = plan_frame(scene, index, layout)
    camera = plan.camera
    shape = camera.height, camera.width
    ids, depth = np.zeros(shape, dtype=np.uint16), np.full(shape, 1.5)
    silhouettes, middles = {}, {}
    for instance in layout.instances:
        pose = instance.world_from_object
        corners = scene.assets[instance.asset].mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        pixels, _ = camera.project(corners)
        canvas = np.zeros((shape[0] + 2 * MARGIN, shape[1] + 2 * MARGIN), dtype=np.uint8)
        cv2.fillConvexPoly(canvas, cv2.convexHull(np.floor(pixels + MARGIN).astype(np.int32)), 1)
        silhouettes[instance.id] = Silhouette.cropped(canvas > 0, -MARGIN, -MARGIN)
        middles[instance.id] = float(camera.project(pose[:3, 3])[1][0])
    for number in sorted(middles, key=lambda number: -middles[number]):
        covered = silhouettes[number].image_mask(camera.width, camera.height)
        ids[covered], depth[covered] = number, middles[number]
    rng = np.random.default_rng(plan.seed)
    image = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    labels = label_instances(
        Truth(ids, ids, silhouettes, depth),
        layout.instances,
        scene.class_names,
        LabelRules(),
        camera=camera,
        keypoints={number: asset.keypoint_array for number, asset in enumerate(scene.assets)},
    )
    normal = np.broadcast_to(np.float32([0.48, -0.6, 0.64]), (*shape, 3)) * (ids > 0)[..., None]
    return frame_around(plan, layout, labels, image=image, ids=ids, depth=depth, normal=normal)
