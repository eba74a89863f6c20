"""Objects in the picture whose exposure is checked."""

from __future__ import annotations

from typing import Any

from mitsplat.checks.exposure_check import _placed_objects
from mitsplat.scene.loading.scene_loading import load_scene
from tests.conftest import WriteScene


def test_one_object_of_each_entry_is_placed_for_any_count(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    scene_data["objects"] = [{"asset": "assets/nut", "count": 3}, {"asset": "assets/bolt"}, {"asset": "assets/nut"}]
    layout = _placed_objects(load_scene(write_scene(scene_data)))
    assert [one.asset for one in layout.instances] == [0, 1, 2]
