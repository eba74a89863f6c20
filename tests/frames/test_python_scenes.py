"""Scenes, layouts and cameras defined in Python, and image sequences rendered from them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mitsplat as ms
from mitsplat.dataset.write import write_dataset
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.labels.flow import UNKNOWN_FLOW, instance_motions, optical_flow
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.spec.camera_spec import CameraOrbit
from mitsplat.scene.spec.light_spec import AreaLight
from mitsplat.scene.spec.shape_spec import Shape
from tests.conftest import WriteScene, box_asset
from tests.drawn import render_boxes, scatter_boxes


def moved(x: float, y: float, z: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """Return a pose at a position [m], rotated about z [degrees]."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


@pytest.fixture
def scene(write_scene: WriteScene, scene_data: dict[str, Any], tmp_path: Path) -> ms.Scene:
    """Return the small scene, defined in Python next to its assets; the nut has an opaque top."""
    nut = box_asset("nut", (0.04, 0.03, 0.01))
    x, y = np.meshgrid(np.linspace(-0.018, 0.018, 10), np.linspace(-0.013, 0.013, 8))
    top = Splats(
        means=np.column_stack([x.ravel(), y.ravel(), np.full(80, 0.005)]).astype(np.float32),
        quats=np.tile(np.float32([0, 0, 0, 1]), (80, 1)),
        scales=np.tile(np.float32([0.003, 0.003, 1e-4]), (80, 1)),
        opacities=np.full(80, 0.9, dtype=np.float32),
        sh=np.zeros((80, 1, 3), dtype=np.float32),
    )
    replace(nut, splats=top).save(tmp_path / "assets/nut")
    write_scene(scene_data)
    camera = CameraOrbit(kind="orbit", target=(0, 0, 0), radius=0.25, height=0.25)
    return ms.make_scene(ms.SceneSpec(**scene_data | {"camera": camera}), tmp_path)


@pytest.fixture
def above() -> ms.Camera:
    """Return a camera 0.2 m above the table that looks down, with x along the world's x and y against its y."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.2
    return ms.Camera(64, 48, 160.0, 160.0, 32.0, 24.0, pose)


# Scenes


def test_a_scene_made_in_python_equals_that_of_the_file(
    write_scene: WriteScene, scene_data: dict[str, Any], tmp_path: Path
) -> None:
    read, made = load_scene(write_scene(scene_data)), ms.make_scene(ms.SceneSpec(**scene_data), tmp_path)
    assert made.spec == read.spec
    assert made.class_names == read.class_names
    assert [asset.name for asset in made.assets] == [asset.name for asset in read.assets]
    assert (
        plan_frame(made, 5).camera.world_from_camera.tolist() == plan_frame(read, 5).camera.world_from_camera.tolist()
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"regoin": 1}, "SceneSpec: regoin: is not a known key (did you mean 'region'?)"),
        ({"seed": -1}, "SceneSpec: seed: must be >= 0 (got -1)"),
        (
            {"camera": {"kind": "drone"}},
            "SceneSpec: camera.kind: must be one of 'fixed', 'path', 'orbit', 'hemisphere'",
        ),
        ({"objects": [{"asset": "assets/nut", "count": [3, 2]}]}, "SceneSpec: objects[0].count: must be [low, high]"),
        (
            {"shapes": (Shape(name="a", mesh="a.ply"), {"name": "b", "bxo": 1})},
            "SceneSpec: shapes[1].bxo: is not a known",
        ),
    ],
)
def test_an_invalid_specification_is_refused_with_its_key(
    scene_data: dict[str, Any], change: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ms.InputError) as caught:
        ms.SceneSpec(**scene_data | change)
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


def test_errors_in_parts_of_a_specification_name_the_part() -> None:
    with pytest.raises(ms.InputError, match=r"^CameraOrbit: radius: must be > 0 \(got -1\)$"):
        CameraOrbit(kind="orbit", target=(0, 0, 0), radius=-1, height=0.4)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"composite": {"exposure": "fixd"}}, "SceneSpec: composite.exposure: must be"),
        ({"sead": 3}, "SceneSpec: sead: is not a known key"),
        ({"seed": -1}, "SceneSpec: seed: must be >= 0"),
    ],
)
def test_an_invalid_copy_of_a_specification_is_refused_with_its_key(
    scene: ms.Scene, change: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ms.InputError, match=f"^{sentence}"):
        ms.make_scene(scene.spec.model_copy(update=change), scene.path.parent)
    sensor = scene.spec.camera.intrinsics.model_copy(update={"fov_x": -3.0})
    camera = scene.spec.camera.model_copy(update={"intrinsics": sensor})
    with pytest.raises(ms.InputError, match=r"^Intrinsics: fov_x: must be > 0 \(got -3\.0\)"):
        ms.make_scene(scene.spec.model_copy(update={"camera": camera}), scene.path.parent)


def test_parts_of_a_copied_specification_may_be_mappings(scene: ms.Scene) -> None:
    change = {"composite": {"exposure": "fixed"}, "lights": [{"kind": "environment"}]}
    changed = ms.make_scene(scene.spec.model_copy(update=change), scene.path.parent).spec
    assert (changed.composite.exposure, changed.lights[0].kind) == ("fixed", "environment")
    assert changed.model_copy(update={"composite": scene.spec.composite, "lights": scene.spec.lights}) == scene.spec


def test_a_changed_value_of_a_specification_names_the_way_to_a_copy(scene: ms.Scene) -> None:
    with pytest.raises(ms.InputError, match=r"^Composite: must not be changed: use model_copy\(update=\{'exposure': "):
        scene.spec.composite.exposure = "fixed"  # type: ignore[misc]


def test_a_missing_asset_of_a_scene_made_in_python_is_refused(scene_data: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ms.InputError, match=r"<python>\.yaml: objects\[0\]\.asset: .*assets/nut") as caught:
        ms.make_scene(ms.SceneSpec(**scene_data), tmp_path)
    assert "\n" not in str(caught.value)


def test_a_scene_made_in_python_is_stored_as_a_file_that_makes_the_same_dataset(
    scene_data: dict[str, Any], tmp_path: Path
) -> None:
    for size, name in (((0.12, 0.16, 0.08), "nut"), ((0.06, 0.07, 0.25), "bolt")):
        box_asset(name, size).save(tmp_path / "assets" / name)
    spec = ms.SceneSpec(**scene_data | {"enclosure": {"floor": -0.01}})
    scene = ms.make_scene(spec, tmp_path)
    write_dataset(scene, tmp_path / "out", frames=4, render=render_boxes, settle=scatter_boxes)
    kept = tmp_path / "out/scene/<python>.yaml"
    (tmp_path / "again.yaml").write_bytes(kept.read_bytes())
    again = load_scene(tmp_path / "again.yaml", overrides={"output.layouts": scene.spec.output.layouts})
    assert again.spec == scene.spec


# Layouts


def test_the_order_of_given_poses_does_not_change_ids(scene: ms.Scene) -> None:
    poses = [moved(0.1 * n, 0, turn=30 * n) for n in range(3)]
    layout = ms.Layout.from_poses(scene, {"bolt": [poses[2]], "assets/nut": poses[:2]}, index=4)
    other = ms.Layout.from_poses(scene, {0: np.array(poses[:2], dtype=np.float32), "bolt": poses[2:]})
    assert [(one.id, one.asset, one.class_index) for one in layout.instances] == [(1, 0, 1), (2, 0, 1), (3, 1, 0)]
    assert scene.class_names == ("bolt", "nut") and layout.index == 4
    for one, same, pose in zip(layout.instances, other.instances, poses, strict=True):
        np.testing.assert_array_equal(one.world_from_object, pose)
        assert (one.id, one.asset) == (same.id, same.asset)
        np.testing.assert_allclose(same.world_from_object, pose, atol=1e-7)
    assert ms.Layout.from_json(layout.to_json()).to_json() == layout.to_json()


def test_a_missing_object_keeps_its_id_unused(scene: ms.Scene) -> None:
    layout = ms.Layout.from_poses(scene, {"nut": [None, moved(0, 0)], "bolt": [moved(0.1, 0)]})
    assert [one.id for one in layout.instances] == [2, 3]


@pytest.mark.parametrize(
    ("poses", "sentence"),
    [
        ({"screw": [np.eye(4)]}, r"poses\['screw'\]: must be an asset of the scene \(bolt, nut\)"),
        ({7: [np.eye(4)]}, r"poses\[7\]: must be an asset of the scene"),
        ({"nut": [np.eye(4)], 0: [np.eye(4)]}, r"poses\[0\]: must not name an asset that already has poses"),
        ({"nut": [np.eye(4), 2 * np.eye(4)]}, r"poses\['nut'\]\[1\]: must have the last row 0, 0, 0, 1"),
        ({"nut": [np.diag([1, 1, 1.1, 1])]}, r"without scale or mirror \(got axes of lengths 1, 1, 1.1\)"),
        ({"nut": [np.diag([1, 1, -1, 1])]}, r"\(got axes of a left-handed frame of lengths 1, 1, 1\)"),
        ({"nut": [moved(0.1, 0).T]}, "is it transposed"),
        ({"nut": np.eye(4)}, r"poses\['nut'\]\[0\]: must be a finite 4x4 matrix .* \(got an array of shape \(4,\)\)"),
        ({"nut": [moved(math.nan, 0)]}, "must be a finite 4x4 matrix"),
        ({"nut": ["here"]}, r"must be a finite 4x4 matrix world_from_object \(got 'here'\)"),
    ],
)
def test_invalid_poses_are_refused_in_one_sentence(scene: ms.Scene, poses: Any, sentence: str) -> None:
    with pytest.raises(ms.InputError, match=sentence):
        ms.Layout.from_poses(scene, poses)


def test_assets_with_the_same_name_are_given_by_number(scene: ms.Scene) -> None:
    twice = replace(scene, assets=(scene.assets[0], replace(scene.assets[1], name="nut")))
    with pytest.raises(ms.InputError, match=r"must name one asset \(it names 2 of scene.assets: .* 0, 1\)"):
        ms.Layout.from_poses(twice, {"nut": [np.eye(4)]})
    assert ms.Layout.from_poses(twice, {1: [np.eye(4)]}).instances[0].asset == 1


# Flow


def test_flow_of_a_plane_that_turns_and_shifts_before_a_still_camera(scene: ms.Scene, above: ms.Camera) -> None:
    """Seen from above, a rotation of the world by a about z is an image rotation by -a about the axis' foot."""
    depth = np.full((48, 64), 0.2)
    ids = np.zeros((48, 64), dtype=np.uint16)
    ids[:, 32:] = 1
    before = ms.Layout.from_poses(scene, {"nut": [moved(0.05, 0.02, turn=10)], "bolt": [moved(-0.1, 0)]})
    after = ms.Layout.from_poses(scene, {"nut": [moved(0.07, 0.01, turn=40)], "bolt": [moved(-0.1, 0)]})
    motions = instance_motions(before, after)
    assert set(motions) == {1}
    flow = optical_flow(depth, above, above, ids, motions)
    np.testing.assert_allclose(flow[:, :32], 0, atol=1e-5)
    scale = 160.0 / 0.2  # pixels per metre in the plane
    x, y = np.meshgrid(np.arange(32, 64) + 0.5, np.arange(48) + 0.5)
    for part, expected in zip(np.moveaxis(flow[:, 32:], -1, 0), turned(x, y, scale), strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-4)


def turned(x: np.ndarray, y: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the flow of the object above: rotation by 30 degrees, translation from (0.05, 0.02) to (0.07, 0.01)."""
    right, up = (x - 32) / scale - 0.05, (24 - y) / scale - 0.02
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    goes = c * right - s * up + 0.07, s * right + c * up + 0.01
    return scale * goes[0] + 32 - x, 24 - scale * goes[1] - y


def test_flow_of_a_removed_object_is_unknown(scene: ms.Scene, above: ms.Camera) -> None:
    before = ms.Layout.from_poses(scene, {"nut": [moved(0, 0), moved(0.1, 0)]})
    after = ms.Layout.from_poses(scene, {"nut": [None, moved(0.1, 0)]})
    ids = np.array([[1, 2, 0]])
    flow = optical_flow(np.full((1, 3), 0.2), above, above, ids, instance_motions(before, after))
    assert (flow[0, 0] == np.float32(UNKNOWN_FLOW)).all()
    np.testing.assert_allclose(flow[0, 1:], 0, atol=1e-5)


def test_flow_beyond_the_range_of_known_flow_is_unknown(above: ms.Camera) -> None:
    """The distortion of a ray that is almost parallel to the image of the next camera is a huge number."""
    lens = replace(above, distortion=(-0.1, 0.02, 0.002, -0.003))
    near, motion = lens.centre + 0.03 * lens.world_from_camera[:3, 2], np.eye(4)
    middle = lens.unproject([[0.5, 0.5]], [0.2])[0]
    motion[:3, 3] = near + 3 * lens.world_from_camera[:3, 0] - middle
    flow = optical_flow(np.full((1, 1), 0.2), lens.cropped(0, 0, 1, 1), lens, np.ones((1, 1), int), {1: motion})
    assert lens.project(middle[None] + motion[:3, 3])[0].max() > 1e9
    assert (flow == np.float32(UNKNOWN_FLOW)).all()


# Frames


def test_a_sequence_has_the_flow_of_its_objects_and_cameras(scene: ms.Scene, above: ms.Camera) -> None:
    """A nut slides by 5 mm per frame below the camera: flow f 0.005 / depth px, depth 0.19 m at its top.

    The table is static.
    """
    steps = [{"nut": [moved(0.005 * n - 0.005, 0, 0.005)], "bolt": [moved(0.03, 0.02, 0.025)]} for n in range(3)]
    layouts = (ms.Layout.from_poses(scene, poses, index=n) for n, poses in enumerate(steps))  # like a simulator
    film = list(ms.render_frames(scene, layouts=layouts, cameras=above, quality="fast"))
    assert [frame.index for frame in film] == [0, 1, 2]
    assert film[-1].flow is None
    for frame in film[:-1]:
        flow, nut = frame.flow, frame.instance == 1
        assert flow is not None and nut.sum() > 300
        np.testing.assert_allclose(flow[nut, 0], 160 * 0.005 / frame.depth[nut], rtol=1e-5)
        np.testing.assert_allclose(np.median(frame.depth[nut]), 0.19, atol=1e-3)
        np.testing.assert_allclose(flow[nut, 1], 0, atol=1e-5)
        np.testing.assert_allclose(flow[~nut & (frame.depth > 0)], 0, atol=1e-4)
    assert np.array_equal(film[1].camera.world_from_camera, above.world_from_camera)
    x = [np.flatnonzero((frame.instance == 1).any(axis=0)).mean() for frame in film]
    np.testing.assert_allclose(np.diff(x), 160 * 0.005 / 0.19, atol=0.5)  # tolerance: whole pixels


def test_render_frames_yields_the_frames_of_the_scene(scene: ms.Scene) -> None:
    """Indices beyond the scene's 12 frames are valid; the rendering order does not change a frame."""
    layout = ms.Layout.from_poses(scene, {"nut": [moved(0, 0, 0.005)]})
    alone = ms.render_frame(scene, 5, layout=layout, quality="fast")
    shown = {frame.index: frame for frame in ms.render_frames(scene, [70, 5], layouts=layout, quality="fast")}
    assert list(shown) == [70, 5]
    assert shown[5].image.tobytes() == alone.image.tobytes()
    assert shown[5].camera.world_from_camera.tolist() == alone.camera.world_from_camera.tolist()
    endless = ms.render_frames(scene, itertools.count(11), layouts=itertools.repeat(layout), quality="fast")
    assert [frame.index for frame in itertools.islice(endless, 3)] == [11, 12, 13]


def test_a_negative_number_of_frames_is_refused(scene: ms.Scene) -> None:
    with pytest.raises(ms.InputError, match=r"frames must be 0 or more \(got -3\)"):
        next(ms.render_frames(scene, -3))


def test_settled_frames_equal_those_of_the_scene(
    scene: ms.Scene, monkeypatch: pytest.MonkeyPatch, above: ms.Camera
) -> None:
    """Without given layouts, each layout is settled once, and flow does not span two layouts."""
    asked = []

    def settle(scene: ms.Scene, index: int) -> ms.Layout:
        asked.append(index)
        return ms.Layout.from_poses(scene, {"nut": [moved(0.01 * index, 0, 0.005)]}, index=index)

    monkeypatch.setattr("mitsplat.frames.frame.settle_layout", settle)
    frames = list(ms.render_frames(scene, 5, quality="fast"))
    assert [frame.layout.index for frame in frames] == [0, 0, 0, 0, 1] and asked == [0, 1]
    assert [frame.flow is None for frame in frames] == [False, False, False, True, False]
    film = list(ms.render_frames(scene, 5, cameras=above, quality="fast"))
    assert [frame.flow is None for frame in film] == [False, False, False, True, True]


def test_given_lights_replace_those_of_the_scene(scene: ms.Scene) -> None:
    layout = ms.Layout.from_poses(scene, {"nut": [moved(0, 0, 0.005)]})

    def lit(lights: Sequence[Any] | None) -> ms.Frame:
        return ms.render_frame(scene, 0, layout=layout, quality="fast", lights=lights)

    red = AreaLight(position=(0.5, 0, 1), colour=(1.0, 0.0, 0.0))
    one, other = lit([red]), lit([{"kind": "area", "position": [0.5, 0, 1], "colour": [1, 0, 0]}])
    table = one.rgb[one.layers.proxy_instance == 0]
    assert len(table) > 1000 and np.median(table[:, 0]) > 0.05 and not table[:, 1:].any()
    assert other.plan.lights == one.plan.lights == (red,)
    assert other.image.tobytes() == one.image.tobytes()
    assert lit(scene.spec.lights).image.tobytes() == lit(None).image.tobytes()
    with pytest.raises(ms.InputError, match=r"^SceneSpec: lights\[0\].radiance: must be "):
        lit([{"kind": "area", "position": [0.5, 0, 1], "radiance": -4.0}])
    with pytest.raises(ms.InputError, match="images of lights must be images that the scene file names"):
        lit([{"kind": "environment", "image": "sky.exr"}])
    with pytest.raises(ms.InputError, match=r"pools of lights must be lists .* \(got 'skies/\*'\)"):
        lit([{"kind": "environment", "pool": "skies/*"}])


def test_the_notebook_picture_shows_image_and_labels(scene: ms.Scene, above: ms.Camera) -> None:
    layout = ms.Layout.from_poses(scene, {"nut": [moved(0, 0, 0.005)]})
    frame = ms.render_frame(scene, 0, layout=layout, camera=above, quality="fast")
    shown = cv2.imdecode(np.frombuffer(frame._repr_png_(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert shown.shape == (48, 128, 3)
    assert np.array_equal(shown[:, :64], frame.image)
    (label,) = frame.labels.instances
    x0, y0, _, _ = label.box
    assert (shown[:, 64:][y0, x0] != frame.image[y0, x0]).any()


def test_the_documented_example_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The code of docs/api.md runs unchanged in a clone."""
    root = Path(__file__).parents[2]
    (code,) = (
        part for part in (root / "docs/api.md").read_text().split("```") if "from_poses" in part and "import" in part
    )
    monkeypatch.chdir(root)
    names: dict[str, Any] = {}
    exec(code.removeprefix("python\n"), names)
    assert names["frame"].index == 2 and names["frame"].flow is None
    assert [label.class_name for label in names["frame"].labels.instances] == ["washer"]
