"""Shapes that are drawn per layout: their places and presence, the same for picture, physics and visibility."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.frames.scene_builder import SceneBuilder
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.layout import NO_PHYSICS, Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.layout_surroundings import draw_surroundings
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.scene.planning.visibility_prediction import enclosing_shape
from mitsplat.scene.scene import Scene
from tests.conftest import WriteScene


@pytest.fixture
def jittered(scene_data: dict[str, Any], write_scene: WriteScene) -> Scene:
    """Return a scene with a bin that moves by 3 mm and turns by 2 degrees (1 sigma)."""
    bin_shape = {"size": [0.2, 0.1, 0.05], "position": [0.3, 0.1, 0.01]}
    scene_data["shapes"].append(
        {"name": "bin", "bin": bin_shape, "visible": True, "jitter": 0.003, "rotation_jitter": 2.0,
         "materials": [{"kind": "noise"}]}
    )  # fmt: skip
    scene_data["output"]["layouts"] = 400
    return load_scene(write_scene(scene_data))


def test_shapes_move_by_the_stated_distances(jittered: Scene) -> None:
    """The centre moves along x and y, and the shape turns about the vertical through it."""
    middle = jittered.shape_meshes[1].bounds.mean(axis=0)
    shifts = []
    for layout in range(400):
        table, moved_bin = placed_shapes(jittered, layout)
        motion = moved_bin.motion
        shifts.append(draw_surroundings(jittered.spec, 4 * layout).shifts["bin"])
        x, y, turn = shifts[-1]
        moved = motion[:3, :3] @ middle + motion[:3, 3]
        np.testing.assert_allclose(moved - middle, [x, y, 0], atol=1e-12)
        assert np.degrees(np.arctan2(motion[1, 0], motion[0, 0])) == pytest.approx(turn)
        np.testing.assert_allclose(motion[2], [0, 0, 1, 0], atol=1e-12)
        assert table.mesh is jittered.shape_meshes[0] and (table.motion == np.eye(4)).all()
        assert moved_bin.mesh.volume == pytest.approx(jittered.shape_meshes[1].volume)
    np.testing.assert_allclose(np.std(shifts, axis=0), [0.003, 0.003, 2.0], rtol=0.15)
    assert draw_surroundings(jittered.spec, 3).shifts == draw_surroundings(jittered.spec, 0).shifts
    assert draw_surroundings(jittered.spec, 0).to_json(jittered.spec)["shifts"] == {"bin": list(shifts[0])}


def test_the_rendered_shape_and_its_pattern_move_together(jittered: Scene) -> None:
    ensure_variant()
    builder = SceneBuilder(jittered)
    for number in (0, 1):
        made = builder.describe(Layout(number, (), NO_PHYSICS), ())["shape_1"]
        params = mi.traverse(made)
        positions = np.array(params["vertex_positions"]).reshape(-1, 3)
        _, placed = placed_shapes(jittered, number)
        motion = placed.motion
        np.testing.assert_allclose(positions, np.asarray(placed.mesh.triangles).reshape(-1, 3), atol=1e-6)
        # On the floor, texture coordinates are a similarity of the places before the motion.
        before = (positions - motion[:3, 3]) @ motion[:3, :3]
        np.testing.assert_allclose(before, jittered.shape_meshes[1].triangles.reshape(-1, 3), atol=1e-6)
        uv = np.array(params["vertex_texcoords"]).reshape(-1, 2)
        up = np.repeat(np.abs(np.asarray(jittered.shape_meshes[1].face_normals)[:, 2]) > 0.9, 3)
        up &= np.repeat(np.asarray(jittered.shape_meshes[1].face_normals)[:, 2] > 0, 3)
        fitted, residual, _, _ = np.linalg.lstsq(np.column_stack([before[up, :2], np.ones(up.sum())]), uv[up])
        assert residual.max() < 1e-8
        np.testing.assert_allclose(fitted[:2] @ fitted[:2].T, np.eye(2) * (fitted[0] ** 2).sum(), rtol=1e-4, atol=1e-4)


def test_a_point_is_inside_the_moved_shape(jittered: Scene) -> None:
    _, placed = placed_shapes(jittered, 5)
    motion = placed.motion
    in_wall = motion[:3, :3] @ [0.3 + 0.1 + 0.002, 0.1, 0.03] + motion[:3, 3]
    assert enclosing_shape(jittered, in_wall, 5) == "bin"
    assert enclosing_shape(jittered, in_wall + motion[:3, 0] * 0.003, 5) == ""


@pytest.mark.parametrize(("key", "value"), [("jitter", 0.001), ("share", 0.5)])
def test_the_belt_of_a_conveyor_must_not_be_drawn(
    scene_data: dict[str, Any], write_scene: WriteScene, key: str, value: float
) -> None:
    scene_data["shapes"][0][key] = value
    scene_data["conveyor"] = {"belt": "table", "speed": 0.1, "interval": 0.1}
    with pytest.raises(InputError, match=rf"shapes\[0\]\.{key}: must not be given for the belt"):
        load_scene(write_scene(scene_data))


@pytest.fixture
def shared(scene_data: dict[str, Any], write_scene: WriteScene) -> Scene:
    """Return a scene with a table and two boxes, each in 0.3 of the layouts."""
    for name, x in (("left", -0.3), ("right", 0.3)):
        box = {"size": [0.1, 0.1, 0.04], "position": [x, 0, 0.03]}
        scene_data["shapes"].append(
            {"name": name, "box": box, "visible": True, "share": 0.3, "materials": [{"kind": "colour"}]}
        )
    scene_data["output"]["layouts"] = 400
    return load_scene(write_scene(scene_data))


def test_layouts_have_the_stated_share_of_shapes(shared: Scene) -> None:
    """Shapes are drawn independently; the plan of a frame names the absent ones and has no material for them."""
    names = [[placed.shape.name for placed in placed_shapes(shared, layout)] for layout in range(400)]
    has = np.array([[name in some for name in ("table", "left", "right")] for some in names])
    assert has[:, 0].all()
    # 0.3 +- 0.1 is more than four standard deviations of 400 draws; for both, 0.09 +- 0.06.
    np.testing.assert_allclose(has[:, 1:].mean(axis=0), 0.3, atol=0.1)
    assert has[:, 1:].all(axis=1).mean() == pytest.approx(0.09, abs=0.06)
    for layout, some in enumerate(names[:20]):
        drawn = draw_surroundings(shared.spec, 4 * layout)
        assert drawn.absent == tuple(name for name in ("left", "right") if name not in some)
        assert set(drawn.materials) == set(some) - {"table"}
        assert drawn.to_json(shared.spec).get("absent", []) == list(drawn.absent)


def test_picture_and_visibility_have_the_same_shapes(shared: Scene) -> None:
    ensure_variant()
    builder = SceneBuilder(shared)
    for number in range(6):
        present = {placed.shape.name for placed in placed_shapes(shared, number)}
        made = builder.describe(Layout(number, (), NO_PHYSICS), ())
        shown = {shared.spec.shapes[int(name.split("_")[1])].name for name in made if name.startswith("shape_")}
        assert shown == present
        for name, x in (("left", -0.3), ("right", 0.3)):
            assert enclosing_shape(shared, np.array([x, 0, 0.03]), number) == (name if name in present else "")
