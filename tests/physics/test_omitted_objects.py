"""Objects omitted from a layout: unstable ones, and those without free space."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mitsplat.errors import InputError
from mitsplat.physics.settle import replay_layout, settle_layout, settle_layouts, try_alone
from mitsplat.scene.layout import Layout, UnsettledLayoutError
from mitsplat.scene.loading.scene_loading import load_scene
from tests.bodies import draw_start_poses
from tests.conftest import box_asset

pytestmark = pytest.mark.usefixtures("physics")


@pytest.fixture
def needle_scene(scene_data, write_scene, tmp_path):
    """Return a scene of nuts and a needle that stands on its point with its centre of mass beside it."""
    cone = trimesh.creation.cone(0.004, 0.08, sections=16)
    cone.vertices[:, 2] = 0.08 - cone.vertices[:, 2]
    cone.vertices[:, 0] += 0.2 * cone.vertices[:, 2]
    cone.invert()
    replace(box_asset("needle"), mesh=cone, pieces=()).save(tmp_path / "assets/needle")
    scene_data["objects"] = [{"asset": "assets/needle"}, {"asset": "assets/nut", "count": 2}]
    scene_data["settle"] = {"arrangement": "upright", "attempts": 2}
    return write_scene


def test_an_object_that_falls_over_is_omitted_and_others_keep_their_ids(needle_scene, scene_data):
    scene = load_scene(needle_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    assert [(one.id, scene.assets[one.asset].name) for one in layout.instances] == [(2, "nut"), (3, "nut")]
    (gone,) = layout.left_out
    assert (gone.id, scene.assets[gone.asset].name) == (1, "needle")
    assert gone.reason == "fell over in 2 of 2 draws"
    assert layout.certificate.refused == ("needle fell over",) * 2
    assert layout.certificate.attempts == 3
    assert Layout.from_json(json.loads(json.dumps(layout.to_json()))).left_out == layout.left_out
    *moments, _ = replay_layout(scene, layout, interval=0.04)
    start = np.array([one.world_from_object[:3, 3] for one in moments[0].layout.instances])
    resting = np.array([one.world_from_object[:3, 3] for one in layout.instances])
    assert start.shape == (2, 3)
    assert np.abs(start - resting).max() < 2e-3  # they were placed at rest


def test_the_simulated_time_of_a_layout_is_bounded(needle_scene, scene_data, monkeypatch):
    """After the limit of simulated time, one rejected draw leaves an object out, whatever settle.attempts says."""
    from mitsplat.physics import drop

    scene_data["settle"]["attempts"] = 50
    monkeypatch.setattr(drop, "_MAX_SIMULATED", 0.0)
    layout = settle_layout(load_scene(needle_scene(scene_data)), 0, cached=False)
    assert [(one.id, one.reason) for one in layout.left_out] == [(1, "fell over in 1 of 1 draws")]
    assert layout.certificate.attempts == 2


def test_a_layout_without_resting_objects_is_an_error_with_the_empty_layout(needle_scene, scene_data):
    scene_data["objects"] = [{"asset": "assets/needle", "count": 2}]
    scene = load_scene(needle_scene(scene_data))
    sentence = r"layout 1 must come to rest .*[(]got 2 x needle fell over[)]"
    with pytest.raises(UnsettledLayoutError, match=sentence) as error:
        settle_layout(scene, 1, cached=False)
    again = pickle.loads(pickle.dumps(error.value))
    assert again.layout.instances == ()
    assert {one.id for one in again.layout.left_out} == {1, 2}
    assert str(again) == str(error.value)
    (layout,) = settle_layouts(scene, [1], cached=False)
    assert layout.to_json() == again.layout.to_json()


def test_an_object_higher_than_the_region_is_omitted(scene_data, write_scene, tmp_path, monkeypatch):
    from mitsplat.physics import placement

    monkeypatch.setattr(placement, "_MAX_DRAWS", 2)
    box_asset("plank", (0.02, 0.02, 0.3)).save(tmp_path / "assets/plank")
    scene_data["objects"] = [{"asset": "assets/nut"}, {"asset": "assets/plank"}]
    scene_data["settle"] = {"arrangement": "upright", "attempts": 1}
    scene = load_scene(write_scene(scene_data))
    layout = settle_layout(scene, 0, cached=False)
    assert [one.id for one in layout.instances] == [1]
    assert [(one.id, one.reason) for one in layout.left_out] == [(2, "no room for it in 1 of 1 draws")]
    scene_data["objects"] = [{"asset": "assets/plank"}]
    with pytest.raises(UnsettledLayoutError, match="region must be large enough"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


def test_an_object_without_room_beside_others_is_omitted(scene_data, write_scene, tmp_path):
    box_asset("tile", (0.04, 0.04, 0.01)).save(tmp_path / "assets/tile")
    scene_data["objects"] = [{"asset": "assets/tile", "count": 5}]
    scene_data["region"] = {"min": [-0.045, -0.045, 0.01], "max": [0.045, 0.045, 0.03]}
    scene_data["settle"] = {"arrangement": "packed"}
    layout = settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)
    assert [one.id for one in layout.instances] == [1, 2, 3, 4]
    assert [(one.id, one.reason) for one in layout.left_out] == [(5, "no room for all in 1 of 1 draws")]
    assert layout.certificate.refused.count("no room for all") == 1
    scene_data["objects"][0]["count"] = 9
    with pytest.raises(InputError, match=r"region must be large enough .*got 9 objects in"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


def test_each_omitted_object_is_tried_alone(needle_scene, scene_data):
    tried = list(try_alone(load_scene(needle_scene(scene_data))))
    assert tried == [("needle", "upright", ["needle fell over"] * 3), ("nut", "upright", [])]
    scene_data["settle"]["arrangement"] = "drop"
    assert not any(refused for _, _, refused in try_alone(load_scene(needle_scene(scene_data))))


def test_a_region_too_small_is_refused(scene_data, write_scene):
    scene_data["objects"][0]["count"] = 60
    scene_data["region"] = {"min": [-0.05, -0.05, 0.01], "max": [0.05, 0.05, 0.08]}
    with pytest.raises(InputError, match=r"scene.yaml: region must be large enough .*got 61 objects in"):
        settle_layout(load_scene(write_scene(scene_data)), 0, cached=False)


def test_a_region_mostly_inside_of_a_table_is_refused_with_its_name(scene_data, write_scene, monkeypatch):
    from mitsplat.physics import placement as place
    from mitsplat.physics.drop import drop_of

    monkeypatch.setattr(place, "_MAX_DRAWS", 1)
    rng = np.random.default_rng(0)
    scene_data["region"] = {"min": [-0.2, -0.2, -0.09], "max": [0.2, 0.2, 0.01]}
    with pytest.raises(InputError, match=r"in 0.4 x 0.4 x 0.1 m, (89|90|91)% of which are inside 'table', settle"):
        draw_start_poses(drop_of(load_scene(write_scene(scene_data)), lambda text: None), (0,), rng)
