"""Frames of a conveyor belt: poses, flow, blur, and the belt's texture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mitsplat as ms
from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.rerender import rerender_frame
from mitsplat.dataset.write import write_dataset
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import homogeneous_matrix
from mitsplat.labels.flow import UNKNOWN_FLOW, exposure_flow
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.planning.conveyor import Belt
from mitsplat.scene.spec.shape_spec import Box
from tests.conftest import WriteScene, box_asset
from tests.manifests import records_of, store

SceneData = dict[str, Any]
STEP = 0.02
"""Travel of the belt between views [m]: 4 pixels at a distance of 0.5 m and a focal length of 100 px."""


def lying(scene: ms.Scene, index: int, *, origin: Sequence[float] = (0.0, 0.0, 0.0), **_: Any) -> Layout:
    """Return a layout of two large nuts: one on the belt, one beside it. Their origin is at a distance from them."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = np.add([(0.0, 0.0, 0.02), (0.0, 0.14, 0.02)], origin)
    instances = [Instance(i, 0, scene.class_index(0), pose) for i, pose in enumerate(poses, start=1)]
    return Layout(index, tuple(instances), replace(NO_PHYSICS, attempts=1))


@pytest.fixture
def belt_data(scene_data: SceneData) -> SceneData:
    """Return a scene with a downward camera over a checkered belt that moves to the right."""
    box = {"size": [1, 0.2, 0.1], "position": [0, 0, -0.05]}
    checkers = {"kind": "checker", "scale": [0.05, 0.05]}
    return scene_data | {
        "shapes": [
            {"name": "belt", "box": box, "visible": True, "materials": [checkers]},
            {"name": "floor", "box": {"size": [1, 1, 0.02], "position": [0, 0, -0.06]}, "visible": True},
        ],
        "conveyor": {"belt": "belt", "speed": 0.2, "interval": STEP / 0.2},
        "objects": [{"asset": "assets/nut", "count": 2, "scale": 2}],
        "camera": {
            "kind": "path",
            "keys": [{"eye": [0, 0, 0.5], "target": [0, 0, 0]}],
            "intrinsics": {"fx": 100},
        },
        "lights": [{"kind": "environment"}],
        "composite": {"shadow": "none"},
        "output": {"width": 64, "height": 48, "layouts": 2, "views": 3},
    }


def test_belt_and_objects_on_it_have_the_flow_of_the_belt(belt_data: SceneData, write_scene: WriteScene) -> None:
    scene = ms.load_scene(write_scene(belt_data))
    frame = ms.render_frame(scene, 0, layout=lying(scene, 0))
    flow = frame.flow
    assert flow is not None
    expected = np.where(frame.instance == 2, 0.0, 100 * STEP / frame.depth)  # f b / z
    y = (np.arange(48) + 0.5 - 24) / 100 * 0.5
    expected[abs(y) > 0.11] = 0.0  # the floor; points beside the belt do not move
    expected[(abs(y) > 0.09) & (abs(y) < 0.11)] = np.nan
    sure = np.isfinite(expected) & (flow[..., 0] < UNKNOWN_FLOW)
    assert {1, 2} <= set(frame.instance[sure].tolist())
    np.testing.assert_allclose(flow[..., 0][sure], expected[sure], atol=2e-3)
    np.testing.assert_allclose(flow[..., 1][sure], 0, atol=2e-3)
    assert ms.render_frame(scene, 2, layout=lying(scene, 0)).flow is None


def test_the_flow_of_settled_layouts_equals_that_of_the_scene(belt_data: SceneData, write_scene: WriteScene) -> None:
    """A film also continues after the last view of a layout of the scene, where a single frame has no flow."""
    scene = ms.load_scene(write_scene(belt_data))
    layout = lying(scene, 0)
    film = list(ms.render_frames(scene, 6, layouts=layout))
    for frame in film:
        alone = ms.render_frame(scene, frame.index, layout=layout)
        np.testing.assert_array_equal(frame.image, alone.image)
        if alone.flow is None:
            assert frame.index in (2, 5)
        else:
            assert frame.flow is not None
            np.testing.assert_array_equal(frame.flow, alone.flow)


@pytest.mark.parametrize("given", [True, False], ids=["layouts", "cameras"])
def test_the_flow_of_a_film_leads_to_its_next_view(
    given: bool, belt_data: SceneData, write_scene: WriteScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film may skip, repeat and reverse views: the belt and the objects on it have the motion between its images."""
    monkeypatch.setattr("mitsplat.frames.frame.settle_layout", lying)
    scene = ms.load_scene(write_scene(belt_data))
    camera = ms.render_frame(scene, 0).camera
    views = [0, 2, 2, 1]
    film = list(ms.render_frames(scene, views, layouts=lying(scene, 0) if given else None, cameras=camera))
    y = abs(np.arange(48) + 0.5 - 24) / 100 * 0.5
    for frame, steps in zip(film, (2, 0, -1), strict=False):
        flow = frame.flow
        assert flow is not None
        runs = (frame.instance == 1) | ((frame.instance == 0) & (y < 0.09)[:, None])
        sure = runs & (flow[..., 0] < UNKNOWN_FLOW)
        assert {0, 1} == set(frame.instance[sure].tolist())
        np.testing.assert_allclose(flow[..., 0][sure], steps * 100 * STEP / frame.depth[sure], atol=2e-3)
    assert film[-1].flow is None


def test_the_pattern_moves_with_the_belt(belt_data: SceneData, write_scene: WriteScene) -> None:
    belt_data["objects"] = []
    scene = ms.load_scene(write_scene(belt_data))
    empty = Layout(0, (), NO_PHYSICS)
    with ms.Renderer(scene) as renderer:
        first, second = (renderer.render(index, layout=empty).rgb[10:38] for index in (0, 1))
    shift = round(100 * STEP / 0.5)
    np.testing.assert_allclose(second[:, shift:], first[:, :-shift], atol=1e-4)
    assert np.abs(second[:, shift:] - first[:, shift:]).max() > 0.05
    belt_data["conveyor"]["interval"] = 1e-9
    still = ms.load_scene(write_scene(belt_data))
    with ms.Renderer(still) as renderer:
        np.testing.assert_allclose(renderer.render(1, layout=empty).rgb[10:38], second, atol=1e-5)  # the middle view


@pytest.mark.parametrize(
    ("lens", "error"),
    [
        ({}, 1e-4),
        # The derivatives of a distorted lens are differences between pixels, one-sided at the border.
        ({"distortion": (-0.2, 0.05, 0.01, -0.02)}, 1e-3),
        ({"distortion": (0.02, -0.01, 0.004, -0.001), "lens": "fisheye"}, 1e-3),
    ],
)
def test_moving_surfaces_are_swept_by_the_exposure(lens: dict[str, Any], error: float) -> None:
    belt = Belt(Box(size=(1.0, 0.2, 0.1), position=(0.0, 0.0, -0.05)), 0.3, 0.0, 0.1)
    camera = replace(Camera.look_at((0.1, -0.3, 0.5), (0, 0, 0), width=32, height=24, fov_x=56), **lens)
    pixels = np.stack(np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5), axis=-1).reshape(-1, 2)
    rays = np.concatenate([camera.ray_slopes(pixels), np.ones((len(pixels), 1))], axis=1)
    rotation, centre = camera.world_from_camera[:3, :3], camera.centre
    depth = (-centre[2] / (rays @ rotation.T)[:, 2]).reshape(24, 32)  # depth of the plane z = 0
    points = (rays * depth.reshape(-1, 1)) @ rotation.T + centre
    other = np.zeros((24, 32), dtype=bool)
    other[5, 7] = True  # an object on the belt
    right, down = exposure_flow(depth, camera, 0.004, belt, other)
    ends = [camera.project(points + np.array([side * 0.5 * 0.004 * 0.3, 0, 0]))[0] for side in (-1, 1)]
    runs = ((abs(points[:, 1]) < 0.1) & (abs(points[:, 0]) < 0.5)).reshape(24, 32) | other
    assert 50 < np.count_nonzero(runs) < 700
    expected = np.where(runs[..., None], (ends[1] - ends[0]).reshape(24, 32, 2), 0.0)
    np.testing.assert_allclose(np.stack([right, down], axis=-1), expected, atol=error)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.02, 0.3, 0.1)], ids=["inside", "beside"])
def test_a_dataset_with_a_belt_has_no_violations(
    origin: tuple[float, float, float], belt_data: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    """Labels follow the carried objects, the audit accepts their poses, and a remade frame is identical."""
    away = homogeneous_matrix(np.eye(3), np.negative(origin))  # of the asset from its origin, before scaling
    box_asset("nut").transformed(away).save(tmp_path / "assets/nut")
    belt_data["labels"] = {"min_pixels": 1, "min_fragment": 1}
    belt_data["camera"]["motion"] = {"exposure": [0.01, 0.02]}
    belt_data["output"]["formats"] = ["yolo", "coco", "poses", "bop", "flow", "depth", "colmap"]
    scene = ms.load_scene(write_scene(belt_data))
    settle = partial(lying, origin=2 * np.array(origin))
    out = write_dataset(scene, tmp_path / "out", settle=settle, workers=1).path
    assert audit_dataset(out).violations == ()
    records = records_of(out)
    places = np.array([[label["world_from_object"][0][3] for label in r["labels"]["instances"]] for r in records])
    np.testing.assert_allclose(places, np.array([[-STEP, 0], [0, 0], [STEP, 0]] * 2) + 2 * origin[0], atol=1e-15)
    assert [record["conveyor"]["time"] for record in records] == pytest.approx([-0.1, 0, 0.1] * 2)
    boxes = [record["labels"]["instances"][0]["box"][0] for record in records[:3]]
    assert boxes[2] - boxes[1] == boxes[1] - boxes[0] == pytest.approx(100 * STEP / 0.47, abs=1)
    again = rerender_frame(scene, 2, tmp_path / "again", dataset=out, settle=settle)
    assert again.compared and not again.differing
    # The audit reports a layout with another pose.
    stored = json.loads((out / "layouts/0000.json").read_bytes())
    stored["instances"][0]["world_from_object"][0][3] = 0.001
    (out / "layouts/0000.json").write_text(json.dumps(stored))
    found = {text for _, text in audit_dataset(out).violations}
    assert any("has another pose than in layouts/0000.json" in text for text in found), found


def test_flow_of_a_belt_recorded_as_still_is_a_violation(
    belt_data: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    belt_data["labels"] = {"min_pixels": 1, "min_fragment": 1}
    belt_data["output"]["formats"] = ["yolo", "flow", "depth"]
    out = write_dataset(ms.load_scene(write_scene(belt_data)), tmp_path / "out", settle=lying, workers=1).path
    file = out / "flow/train/000000.flo"
    flow = cv2.readOpticalFlow(str(file))
    cv2.writeOpticalFlow(str(file), np.where(flow > 1, 0, flow))
    store(out, records_of(out))
    found = audit_dataset(out).violations
    assert any("have a flow that contradicts depth and cameras" in text for _, text in found), found


def test_masks_of_proxies_may_show_what_is_behind_the_splats(
    belt_data: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    """The mask of a nut that reaches over the edge of the belt has pixels that show the floor, which stands still."""
    belt_data["labels"] = {"source": "proxies", "min_pixels": 1, "min_fragment": 1}
    belt_data["output"]["formats"] = ["yolo", "depth", "flow"]
    settle = partial(lying, origin=(0.0, 0.08, 0.0))
    out = write_dataset(ms.load_scene(write_scene(belt_data)), tmp_path / "out", settle=settle).path
    assert audit_dataset(out).violations == ()
