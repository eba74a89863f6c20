"""Scenes: values, loading and planning.

In: a YAML file and the asset folders that it names. Out: a :class:`Scene` (the checked specification with its assets
and meshes) and, for every frame, a :class:`FramePlan` (camera, lights, random draws) decided by the seed and the
frame's index. A :class:`Layout` holds the poses of the objects; physics makes it, and all later stages read it.
"""

from __future__ import annotations

from mitsplat.scene.layout import Instance, Layout, RestCertificate
from mitsplat.scene.loading.scene_loading import load_scene, scene_json_schema
from mitsplat.scene.planning.frame_plan import FramePlan, plan_frame
from mitsplat.scene.scene import Scene

__all__ = [
    "FramePlan",
    "Instance",
    "Layout",
    "RestCertificate",
    "Scene",
    "load_scene",
    "plan_frame",
    "scene_json_schema",
]
