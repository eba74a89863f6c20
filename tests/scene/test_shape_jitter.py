"""Jittered shapes: another place in every layout, the same for picture, physics and visibility."""

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
        (_, table, still), (_, mesh, motion) = placed_shapes(jittered, layout)
        shifts.append(draw_surroundings(jittered.spec, 4 * layout).shifts["bin"])
        x, y, turn = shifts[-1]
        moved = motion[:3, :3] @ middle + motion[:3, 3]
        np.testing.assert_allclose(moved - middle, [x, y, 0], atol=1e-12)
        assert np.degrees(np.arctan2(motion[1, 0], motion[0, 0])) == pytest.approx(turn)
        np.testing.assert_allclose(motion[2], [0, 0, 1, 0], atol=1e-12)
        assert table is jittered.shape_meshes[0] and (still == np.eye(4)).all()
        assert mesh.volume == pytest.approx(jittered.shape_meshes[1].volume)
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
        _, (_, mesh, motion) = placed_shapes(jittered, number)
        np.testing.assert_allclose(positions, np.asarray(mesh.triangles).reshape(-1, 3), atol=1e-6)
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
    _, (*_, motion) = placed_shapes(jittered, 5)
    in_wall = motion[:3, :3] @ [0.3 + 0.1 + 0.002, 0.1, 0.03] + motion[:3, 3]
    assert enclosing_shape(jittered, in_wall, 5) == "bin"
    assert enclosing_shape(jittered, in_wall + motion[:3, 0] * 0.003, 5) == ""


def test_the_belt_of_a_conveyor_must_not_be_jittered(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    scene_data["shapes"][0]["jitter"] = 0.001
    scene_data["conveyor"] = {"belt": "table", "speed": 0.1, "interval": 0.1}
    with pytest.raises(InputError, match=r"shapes\[0\]\.jitter: must not be given for the belt"):
        load_scene(write_scene(scene_data))
