"""Conveyor belts: carried objects, times, and validation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.conveyor import layout_at_view
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene
from tests.conftest import WriteScene, box_asset

SceneData = dict[str, Any]
SETTLED = replace(NO_PHYSICS, attempts=1)


@pytest.fixture
def belt_data(scene_data: SceneData) -> SceneData:
    """Return a scene of a belt of 1.2 m, rotated by 30 degrees, below a region of 0.4 m."""
    box = {"size": [1.2, 0.6, 0.1], "position": [0, 0, -0.05], "rotate": [0, 0, 30]}
    scene_data["shapes"] = [{"name": "belt", "box": box, "visible": True}]
    return scene_data | {"conveyor": {"belt": "belt", "speed": 0.2, "interval": 0.1}}


def lying(*places: tuple[float, float, float]) -> Layout:
    """Return a settled layout with an object at each of the given positions [m]."""
    instances = []
    for number, place in enumerate(places, start=1):
        pose = np.eye(4)
        pose[:3, 3] = place
        instances.append(Instance(number, 0, 0, pose))
    return Layout(0, tuple(instances), SETTLED)


def places_of(layout: Layout) -> Any:
    return np.array([instance.world_from_object[:3, 3] for instance in layout.instances])


def scene_of(data: SceneData, write_scene: WriteScene) -> Scene:
    return load_scene(write_scene(data))


def test_objects_above_the_belt_move_along_it(belt_data: SceneData, write_scene: WriteScene) -> None:
    """Another box, which is the first shape, is beside the belt."""
    post = {"size": [0.1, 0.1, 1], "position": [0, 0.9, 0]}
    belt_data["shapes"].insert(0, {"name": "post", "box": post, "visible": True})
    scene = scene_of(belt_data, write_scene)
    beside, below = (0.0, 0.45, 0.01), (0.0, 0.0, -0.2)
    layout = lying((0.1, 0.0, 0.01), beside, below, (-0.1, 0.05, 0.3))
    along = np.array([np.cos(np.pi / 6), 0.5, 0.0])
    for view, time in enumerate((-0.15, -0.05, 0.05, 0.15)):
        moved = places_of(layout_at_view(scene, layout, view)) - places_of(layout)
        np.testing.assert_allclose(moved[[0, 3]], [0.2 * time * along] * 2, atol=1e-15)
        np.testing.assert_array_equal(moved[[1, 2]], 0)


def test_objects_are_carried_wherever_their_origin_is(belt_data: SceneData, write_scene: WriteScene) -> None:
    """The origin of a CAD part may be far from the part."""
    away = np.array([0.1, 0.5, 0.2])
    cad = box_asset("cad").transformed(homogeneous_matrix(np.eye(3), away))
    cad.save(write_scene(belt_data).parent / "assets/cad")
    scene = scene_of(belt_data | {"objects": [{"asset": "assets/cad", "count": 2}]}, write_scene)
    layout = lying(*(np.array([(0.1, 0.0, 0.01), (0.0, 0.45, 0.01)]) - away).tolist())
    moved = places_of(layout_at_view(scene, layout, 3)) - places_of(layout)
    np.testing.assert_allclose(moved, [0.03 * np.array([np.cos(np.pi / 6), 0.5, 0.0]), np.zeros(3)], atol=1e-15)


def test_centroids_at_the_origin_have_no_sign(belt_data: SceneData, write_scene: WriteScene) -> None:
    """The sign of a rounded error would differ between machines, and `dataset.json` with it."""
    assert not np.signbit(scene_of(belt_data, write_scene).centroids).any()


def test_a_layout_moves_from_its_settled_poses(belt_data: SceneData, write_scene: WriteScene) -> None:
    scene = scene_of(belt_data, write_scene)
    layout = lying((0.1, 0.0, 0.01))
    last = layout_at_view(scene, layout, 3)
    assert layout_at_view(scene, last, 3) is last
    np.testing.assert_array_equal(
        places_of(layout_at_view(scene, last, 0)), places_of(layout_at_view(scene, layout, 0))
    )


def test_given_poses_do_not_move(belt_data: SceneData, write_scene: WriteScene) -> None:
    scene = scene_of(belt_data, write_scene)
    given = Layout.from_poses(scene, {"nut": [np.eye(4)]})
    assert layout_at_view(scene, given, 0) is given


def test_a_scene_without_a_belt_keeps_its_layout(scene_data: SceneData, write_scene: WriteScene) -> None:
    layout = lying((0.1, 0.0, 0.01))
    assert layout_at_view(scene_of(scene_data, write_scene), layout, 1) is layout


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"belt": "table"}, "conveyor.belt: must be the name of a box among the shapes, belt (got table)"),
        ({"speed": 0.0}, "conveyor.speed: must not be 0"),
        ({"interval": 0.0}, "conveyor.interval: must be > 0"),
        ({"speed": 3.0}, "conveyor.belt: its box must be 1.45 m long, so that the objects of its region stay on it"),
        ({"speed": -3.0}, "conveyor.belt: its box must be 1.45 m long, so that the objects of its region stay on it"),
    ],
)
def test_invalid_belts_are_refused(
    belt_data: SceneData, write_scene: WriteScene, change: dict[str, Any], sentence: str
) -> None:
    belt_data["conveyor"] |= change
    with pytest.raises(InputError) as caught:
        scene_of(belt_data, write_scene)
    assert sentence in str(caught.value)


@pytest.mark.parametrize("position", [(3, 0, 0), (-3, 0, 0), (-0.75, 1.3, 0), (0.75, -1.3, 0), (0, 0, 3)])
def test_a_belt_below_no_region_is_refused(
    belt_data: SceneData, write_scene: WriteScene, position: tuple[float, ...]
) -> None:
    belt_data["shapes"][0]["box"]["position"] = list(position)
    with pytest.raises(InputError, match=r"conveyor\.belt: must be below a region, so that it carries objects"):
        scene_of(belt_data, write_scene)


def test_exposures_are_drawn_within_their_range_and_need_a_conveyor(
    belt_data: SceneData, write_scene: WriteScene
) -> None:
    belt_data["camera"]["motion"] = {"exposure": [0.01, 0.02]}
    scene = scene_of(belt_data, write_scene)
    exposures = [plan_frame(scene, index).viewpoint["motion"]["exposure"] for index in range(scene.num_frames)]
    assert len(set(exposures)) == scene.num_frames
    assert 0.01 <= min(exposures) < max(exposures) <= 0.02
    del belt_data["conveyor"]
    with pytest.raises(InputError, match=r"camera\.motion: needs a conveyor"):
        scene_of(belt_data, write_scene)
