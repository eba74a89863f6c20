"""YAML lines for a scene file reproduce the view's settings."""

from __future__ import annotations

import numpy as np
import pytest
from ruamel.yaml import YAML

from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.spec.camera_spec import Intrinsics
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, PointLight, SpotLight
from mitsplat.view.scene_page import changed_light
from mitsplat.view.yaml_lines import camera_lines, light_line, seed_line

LIGHTS = [
    AreaLight(position=(0.1, -2, 1 / 3), target=(0, 0, 0.01), size=(0.3, 0.2), radiance=7.25, temperature=4000),
    SpotLight(position=(1, 0, 1e-5), cone=12, intensity=0.003),
    PointLight(position=(0, 0, 1), colour=(1, 0.5, 0.25)),
    EnvironmentLight(radiance=0.3, rotate_z=10),
]


def test_lights_are_written_as_lines_of_a_scene_file(scene_data, write_scene):
    path = write_scene({**scene_data, "lights": []})
    path.write_text(path.read_text().replace("lights: []", "lights:\n" + "".join(map(light_line, LIGHTS))))
    assert load_scene(path).spec.lights == tuple(LIGHTS)


def test_the_view_is_written_as_a_camera_of_a_scene_file(scene_data, write_scene):
    pose = look_at_pose((0.5, -0.4, 0.6), (0.02, 0.01, 0.1), up=(0.1, 0, 1))
    del scene_data["camera"]
    path = write_scene(scene_data)
    path.write_text(path.read_text() + camera_lines(pose, (0.02, 0.01, 0.1), Intrinsics(fov_x=50)))
    camera = plan_frame(load_scene(path), 0).camera
    assert camera.world_from_camera == pytest.approx(pose, abs=3e-4)  # positions are rounded to 0.1 mm
    assert np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)) == pytest.approx(50)


def test_changing_a_light_ignores_keys_of_other_kinds():
    moved = changed_light(LIGHTS[0], position=(1.00004, 2, 3), target=(0, 0, 1), strength=2)
    assert (moved.position, moved.target, moved.radiance) == ((1.0, 2.0, 3.0), (0, 0, 1), 2)
    assert changed_light(LIGHTS[2], target=(0, 0, 0), strength=2) == LIGHTS[2].model_copy(update={"intensity": 2.0})
    assert changed_light(LIGHTS[3], position=(1, 1, 1)) == LIGHTS[3]
    assert YAML(typ="safe").load(seed_line(8)) == {"seed": 8}
