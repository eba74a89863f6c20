"""Scenes: values, loading and planning.

In: a YAML file and the asset folders that it names. Out: a :class:`Scene` (the checked specification with its assets
and meshes) and one :class:`FramePlan` per frame (camera, lights, random draws). The seed and the index of the frame
determine the plan. A :class:`Layout` holds the poses of the objects. The physics simulation creates it; all later
stages read it.
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
