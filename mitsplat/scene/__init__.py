"""What is to be rendered: a scene file becomes frozen values.

In: a YAML file and the asset folders that it names. Out: a :class:`Scene` (the checked specification with its assets
and meshes), and for every frame a :class:`FramePlan` (camera, lights, draws) that the seed and the frame's index
decide. A :class:`Layout` says where objects lie; physics makes it, and every later stage reads it.
"""

from __future__ import annotations

from mitsplat.scene.layout import Instance, Layout, RestCertificate
from mitsplat.scene.scene import FramePlan, Scene, load_scene, plan_frame, scene_json_schema

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
