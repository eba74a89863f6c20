"""Scene files: rules between keys, and frames determined by seed and index."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.scene.loading.scene_loading import load_scene, scene_json_schema
from mitsplat.scene.planning.frame_plan import FramePlan, layout_index_of, plan_frame
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.scene_spec import SCHEMA_VERSION
from mitsplat.scene.streams import random_stream
from tests.conftest import WriteScene, box_asset

SceneData = dict[str, Any]


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert str(caught.value).startswith(f"{path}:")
    return str(caught.value).removeprefix(f"{path}:").partition(": ")[2]


def planned(scene: Scene, index: int) -> tuple[Any, ...]:
    """Return a plan as plain comparable values."""
    plan: FramePlan = plan_frame(scene, index)
    return (plan.camera.world_from_camera.tolist(), plan.lights, plan.draws, plan.seed, plan.split)


def with_output(scene: Scene, **changes: Any) -> Scene:
    spec = scene.spec
    return replace(scene, spec=spec.model_copy(update={"output": spec.output.model_copy(update=changes)}))


# Reading


def test_a_scene_has_the_contents_of_its_file(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["objects"][1] |= {"class_name": "screw", "scale": 2.0}
    scene = load_scene(write_scene(scene_data))
    assert scene.class_names == ("nut", "screw")
    assert [asset.class_name for asset in scene.assets] == ["nut", "screw"]
    assert scene.assets[1].mesh is not None
    np.testing.assert_allclose(scene.assets[1].mesh.extents, (0.02, 0.02, 0.1), rtol=1e-6)
    np.testing.assert_allclose(scene.shape_meshes[0].bounds, [(-0.5, -0.5, -0.1), (0.5, 0.5, 0)])
    assert [entry.count for entry in scene.spec.objects] == [(1, 2), (1, 1)]
    assert scene.num_frames == 12


def test_entries_of_one_asset_share_its_data(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["objects"] = [{"asset": "assets/nut"}, {"asset": "assets/nut", "class_name": "other"}]
    first, second = load_scene(write_scene(scene_data)).assets
    assert first.splats is second.splats
    assert first.mesh is second.mesh
    assert (first.class_name, second.class_name) == ("nut", "other")


def test_every_file_is_read_once_before_errors_are_reported(
    scene_data: SceneData, write_scene: WriteScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first object does not fit into the region and the asset of the last one is missing.

    The latter is reported.
    """
    nut, read, load = scene_data["objects"][0]["asset"], [], Asset.load
    monkeypatch.setattr(Asset, "load", lambda folder: (read.append(Path(folder).name), load(folder))[1])
    scene_data["objects"] = [{"asset": nut}, {"asset": nut, "scale": 2.0}]
    load_scene(write_scene(scene_data))
    assert read.count(Path(nut).name) == 1
    scene_data["objects"] = [{"asset": nut, "scale": 1000.0}, {"asset": "assets/absent"}]
    assert "assets/absent" in refusal(write_scene(scene_data))


def test_overrides_replace_values_of_the_file(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene = load_scene(write_scene(scene_data), overrides={"output.width": 32, "seed": 3, "quality": "fast"})
    assert (scene.spec.output.width, scene.spec.output.height) == (32, 48)
    assert (scene.spec.seed, scene.spec.quality) == (3, "fast")


def test_overrides_may_be_numpy_values(scene_data: SceneData, write_scene: WriteScene) -> None:
    given = {"seed": np.int64(3), "camera.target": np.zeros(3), "randomise.exposure": [np.float32(-0.5), 1]}
    spec = load_scene(write_scene(scene_data), overrides=given).spec
    assert (spec.seed, spec.camera.target, spec.randomise.exposure) == (3, (0, 0, 0), (-0.5, 1))


@pytest.mark.parametrize(("key", "most"), [("exposure", 20), ("motion_blur", 1000)])
def test_values_beyond_any_visible_effect_are_refused(
    scene_data: SceneData, write_scene: WriteScene, key: str, most: int
) -> None:
    with pytest.raises(InputError, match=rf"randomise.{key}\[0\]: must be <= {most} "):
        load_scene(write_scene(scene_data), overrides={f"randomise.{key}": [1100, 1100]})


def test_box_is_turned_about_fixed_axes_in_order_x_y_z(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["shapes"][0]["box"] = {"size": [1, 2, 4], "rotate": [90, 90, 0], "position": [0, 0, 3]}
    mesh = load_scene(write_scene(scene_data)).shape_meshes[0]
    # Rotation about x: (1, 4, 2); then about y: (2, 4, 1).
    np.testing.assert_allclose(mesh.extents, (2, 4, 1), atol=1e-12)
    np.testing.assert_allclose(mesh.centroid, (0, 0, 3), atol=1e-12)


def test_a_shape_is_read_from_a_mesh_file(scene_data: SceneData, write_scene: WriteScene, tmp_path: Path) -> None:
    mesh = box_asset("x").mesh
    assert mesh is not None
    mesh.export(tmp_path / "bin.ply")
    scene_data["shapes"].append({"name": "bin", "mesh": "bin.ply"})
    np.testing.assert_allclose(load_scene(write_scene(scene_data)).shape_meshes[1].bounds, mesh.bounds, atol=1e-7)


def test_enclosure_leaves_exactly_the_region_free(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["enclosure"] = {"margin": 0.1, "floor": -0.05}
    scene = load_scene(write_scene(scene_data))
    walls = list(zip(scene.spec.shapes, scene.shape_meshes, strict=True))[1:]
    assert len(walls) == 5
    assert all(shape.collider and not shape.visible for shape, _ in walls)

    def in_walls(points: np.ndarray) -> np.ndarray:
        inside = [((points > mesh.bounds[0]) & (points < mesh.bounds[1])).all(axis=1) for _, mesh in walls]
        return np.any(inside, axis=0)

    rng = np.random.default_rng(0)
    low, high = np.array([-0.3, -0.3, -0.05]), np.array([0.3, 0.3, 0.2])
    inside = rng.uniform(low, high, (500, 3))
    assert not in_walls(inside).any()
    # Every direction, sideways or up, ends at a wall.
    for axis, side in [(0, -1), (0, 1), (1, -1), (1, 1), (2, 1)]:
        leaving = inside.copy()
        leaving[:, axis] = (high if side > 0 else low)[axis] + side * 0.02
        assert in_walls(leaving).all()


def test_an_enclosure_leaves_room_for_the_largest_object_if_there_is_something_to_lie_on(
    scene_data: SceneData, write_scene: WriteScene
) -> None:
    """The bolt is 50 mm long; the table ends 20 mm beyond the region along x, and far beyond it along y."""
    scene_data["enclosure"] = {}
    scene_data["shapes"][0]["box"] = {"size": [0.44, 1, 0.1], "position": [0, 0, -0.05]}
    scene = load_scene(write_scene(scene_data))
    bounds = {shape.name: mesh.bounds for shape, mesh in zip(scene.spec.shapes, scene.shape_meshes, strict=True)}
    inner = [bounds["enclosure -x"][1, 0], bounds["enclosure +x"][0, 0]]
    inner += [bounds["enclosure -y"][1, 1], bounds["enclosure +y"][0, 1]]
    np.testing.assert_allclose(inner, [-0.22, 0.22, -0.25, 0.25])
    scene_data["shapes"][0]["box"]["size"] = [0.3, 1, 0.1]  # narrower than the region, which walls never cut
    scene = load_scene(write_scene(scene_data))
    assert scene.shape_meshes[2].bounds[0, 0] == pytest.approx(0.2)


# Refusals


def changed(data: SceneData, **changes: Any) -> SceneData:
    """Return a copy of the data with values replaced by dotted key.

    ``__`` stands for the dot, and digits for list positions.
    """
    data = copy.deepcopy(data)
    for path, value in changes.items():
        *outer, last = path.split("__")
        inner: Any = data
        for key in outer:
            inner = inner[int(key)] if key.isdigit() else inner[key]
        inner[int(last) if last.isdigit() else last] = value
    return data


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"objects__0__count": -3}, "objects[0].count: must be >= 1 (got -3)"),
        ({"objects__0__count": [3, 2]}, "objects[0].count: must be [low, high] with low <= high (got [3, 2])"),
        ({"objects__0__count": [-1, 2]}, "objects[0].count[0]: must be >= 0 (got -1)"),
        ({"objects__0__count": 1.5}, "objects[0].count: must be a whole number or [minimum, maximum] (got 1.5)"),
        ({"objects__0__scale": 0}, "objects[0].scale: must be > 0 (got 0)"),
        ({"region__max": [0.2, -0.3, 1]}, "region.max: must be above min along y (got -0.3, min is -0.2)"),
        ({"shapes__0__visible": False, "shapes__0__collider": False}, "must be visible, a collider or a proxy"),
        ({"shapes__0__mesh": "a.ply"}, "must have either a box, a bin or a mesh (got box and mesh)"),
        ({"shapes": [{"name": "a", "mesh": "b.ply"}] * 2}, "shapes[1].name: must be unique (got 'a' again)"),
        ({"shapes__0__colour": [0, 0, 2]}, "shapes[0].colour[2]: must be <= 1 (got 2)"),
        ({"camera": {"kind": "path", "keys": []}}, "camera.keys: must have 1 or more items (got [])"),
        (
            {"camera": {"kind": "path", "keys": [{"eye": [1, 2, 3], "target": [1, 2, 3]}]}},
            "camera.keys[0].target: must differ from eye (got [1.0, 2.0, 3.0])",
        ),
        ({"camera__intrinsics": {}}, "camera.intrinsics: must have either fov_x or fx (got neither)"),
        (
            {"camera__intrinsics": {"fov_x": 60, "fx": 500}},
            "camera.intrinsics: must have either fov_x or fx (got both)",
        ),
        ({"camera__intrinsics": {"fov_x": 180}}, "camera.intrinsics.fov_x: must be < 180 (got 180)"),
        ({"camera__intrinsics": {"fov_x": 60, "cx": 3}}, "camera.intrinsics.cx: needs fx"),
        (
            {"camera__intrinsics": {"fx": 60, "distortion": [0.1]}},
            "camera.intrinsics.distortion: must have 0, 4, 5, 8, 12 or 14 coefficients (got 1)",
        ),
        ({"lights__0": {"kind": "spot", "position": [0, 0, 1], "cone": 90}}, "lights[0].cone: must be < 90 (got 90)"),
        ({"lights__0__target": [0.5, 0, 1]}, "lights[0].target: must differ from the light's positions"),
        ({"lights__0__colour": [0, 0, 0]}, "lights[0].colour: must not be black"),
        ({"lights__0__path": [{}]}, "lights[0].path[0]: must have a position or a temperature"),
        ({"lights": [{"kind": "environment"}] * 2}, "lights[1].kind: must not be a second environment light"),
        ({"lights": [{"kind": "environment", "image": "sky.exr"}]}, "sky.exr: no such file"),
        ({"randomise": {"vignetting": [-1, 0]}}, "randomise.vignetting[0]: must be >= 0 (got -1)"),
        ({"randomise": {"jpeg": [0, 90]}}, "randomise.jpeg[0]: must be >= 1 (got 0)"),
        ({"composite": {"exposure": "dark"}}, "composite.exposure: must be auto, fixed, or a mapping with ev, or with"),
        ({"composite": {"white_balance": "daylight"}}, "composite.white_balance: must be auto or a colour temperature"),
        ({"composite": {"exposure": 9}}, "composite.exposure: must be auto, fixed, or a mapping with ev, or with"),
        ({"composite": {"exposure": {"ev": "9"}}}, "composite.exposure.ev: must be a number"),
        ({"composite": {"exposure": {"f": 4}}}, "composite.exposure.f: "),
        ({"composite": {"exposure": {"aperture": 4}}}, "composite.exposure.shutter: is required if ev is absent"),
        ({"composite": {"exposure": {"ev": 9, "iso": 100}}}, "composite.exposure.iso: must not be given together with"),
        (
            {"composite": {"exposure": {"aperture": 0, "shutter": 1}}},
            "composite.exposure.aperture: must be > 0 (got 0)",
        ),
        ({"composite": {"white_balance": 900}}, "composite.white_balance: must be >= 1667 (got 900)"),
        ({"composite": {"white_balance": "warm"}}, "composite.white_balance: must be "),
        (
            {"composite": {"white_balance": 3000}, "randomise": {"white_balance": [2900, 3100]}},
            "composite.white_balance: must not be given together with randomise.white_balance (got 3000 and [2900.0,",
        ),
        ({"randomise": {"exposure": [1, 0]}}, "randomise.exposure: must be [low, high] with low <= high"),
        (
            {"output__formats": ["yolo", "zip"]},
            "output.formats[1]: must be 'yolo', 'yolo-detect', 'yolo-obb', ",
        ),
        ({"output__validation": 1.5}, "output.validation: must be <= 1 (got 1.5)"),
        ({"enclosure": {"floor": 0.2}}, "enclosure.floor: must be below the region's top at 0.2 m (got 0.2)"),
        ({"objects__0__asset": "assets/gone"}, "objects[0].asset: "),
        ({"objects__0": {"count": 2}}, "objects[0]: must have either an asset or a pool (got neither)"),
        ({"objects__0__pool": ["assets/bolt"]}, "objects[0]: must have either an asset or a pool (got both)"),
        ({"objects__0": {"pool": []}}, "objects[0].pool: must name at least one asset (got [])"),
        ({"objects__0": {"pool": 3}}, "objects[0].pool: must be text (got 3)"),
        ({"name": ""}, 'name: must have 1 or more characters (got "")'),
        ({"objects__0": {"pool": ["assets/nut", 3]}}, "objects[0].pool[1]: must be text (got 3)"),
        ({"objects__0": {"pool": ["assets/nut", "assets/gone"]}}, "objects[0].pool[1]: "),
        (
            {"objects__0": {"pool": "gone/*"}},
            "objects[0].pool: must match at least one asset folder of kind object (got 'gone/*', which matches none)",
        ),
        ({"objects__0": {"pool": "**a"}}, "objects[0].pool: must "),
        ({"objects__0__balance": True}, "objects[0].balance: needs a pool"),
        ({"objects__0__label": "no"}, 'objects[0].label: must be true or false (got "no")'),
        (
            {"objects__0": {"pool": ["assets/nut"], "poses": [{"position": [0, 0, 1]}]}},
            "objects[0].pool: must not be given together with poses",
        ),
        ({"objects__0__scale": [2, 1]}, "objects[0].scale: must be [low, high] with low <= high (got [2.0, 1.0])"),
        (
            {"objects__0__scale": [0, 1]},
            "objects[0].scale: must be a number > 0 or [minimum, maximum] (got [0, 1])",
        ),
        (
            {"objects__0": {"asset": "assets/nut", "scale": [1, 2], "poses": [{"position": [0, 0, 1]}]}},
            "objects[0].scale: must be one number together with poses",
        ),
        (
            {"objects__0": {"pool": "primitives", "size": 0.1}},
            "objects[0].size: must not be given for primitives (use scale)",
        ),
        pytest.param(
            {"objects__0": {"pool": "primitives", "scale": 30}},
            "objects[0].pool[0]: asset 'box_0' must fit into",
            marks=pytest.mark.extended,
        ),
        ({"empty": 1.5}, "empty: must be <= 1 (got 1.5)"),
        ({"environment": "assets/gone"}, "environment: "),
        ({"shapes__0": {"name": "a", "mesh": "gone.ply"}}, "gone.ply: no such file"),
        (
            {"objects__1__scale": 20},
            "objects[1].asset: asset 'bolt' must fit into the region of 0.4 x 0.4 m (it measures 0.2 x 1 m)",
        ),
    ],
)
def test_an_invalid_scene_is_refused_with_its_key(
    scene_data: SceneData, write_scene: WriteScene, changes: SceneData, sentence: str
) -> None:
    assert sentence in refusal(write_scene(changed(scene_data, **changes)))


@pytest.mark.parametrize("key", ["name", "region", "camera"])
def test_missing_required_keys_are_refused(scene_data: SceneData, write_scene: WriteScene, key: str) -> None:
    del scene_data[key]
    assert refusal(write_scene(scene_data)) == f"{key}: is required"


def test_errors_in_assets_name_both_files(scene_data: SceneData, write_scene: WriteScene) -> None:
    path = write_scene(scene_data)
    shutil.rmtree(path.parent / "assets/bolt")
    message = refusal(path)
    assert message.startswith("objects[1].asset: ")
    assert str(path.parent / "assets/bolt") in message


def test_an_asset_of_unknown_units_needs_a_size(scene_data: SceneData, write_scene: WriteScene) -> None:
    path = write_scene(scene_data)
    replace(box_asset("nut"), units="unknown").save(path.parent / "assets/nut")
    with pytest.raises(InputError, match=r"scene\.yaml:\d+: objects\[0\]\.asset: asset 'nut' has unknown units: set"):
        load_scene(path)
    scene_data["objects"][0] |= {"size": 0.06, "scale": 2}
    assert load_scene(write_scene(scene_data)).assets[0].mesh.extents.max() == pytest.approx(0.12)
    scene_data["objects"][1]["size"] = 0.06
    with pytest.raises(
        InputError, match=r"objects\[1\]\.asset: asset 'bolt' is in metres: it takes a scale, not a size"
    ):
        load_scene(write_scene(scene_data))
    scene_data["objects"][1].pop("size")
    scene_data["environment"] = "assets/nut"
    with pytest.raises(InputError, match="environment: asset 'nut' has unknown units"):
        load_scene(write_scene(scene_data))


def test_an_environment_as_object_is_refused(scene_data: SceneData, write_scene: WriteScene) -> None:
    path = write_scene(scene_data)
    replace(box_asset("room"), kind="environment", pieces=()).save(path.parent / "assets/room")
    scene_data["objects"][1]["asset"] = "assets/room"
    assert "asset 'room' must be of kind object and have a mesh" in refusal(write_scene(scene_data))


# Frames


def test_the_next_camera_is_that_of_the_layouts_next_view(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene = load_scene(write_scene(scene_data))
    for index in range(scene.num_frames):
        following = plan_frame(scene, index).next_camera
        if index % 4 == 3:
            assert following is None
        else:
            assert following is not None
            np.testing.assert_array_equal(
                following.world_from_camera, plan_frame(scene, index + 1).camera.world_from_camera
            )


def test_frames_belong_to_layouts(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene = load_scene(write_scene(scene_data))
    assert [layout_index_of(scene, index) for index in range(12)] == [0] * 4 + [1] * 4 + [2] * 4
    assert [plan_frame(scene, index).view for index in range(12)] == [0, 1, 2, 3] * 3
    for index in (-1, 12):
        with pytest.raises(InputError, match=f"frame must be in 0 to 11 \\(got {index}\\)"):
            plan_frame(scene, index)


@pytest.fixture
def random_scene(scene_data: SceneData, write_scene: WriteScene) -> Scene:
    scene_data["camera"] = {
        "kind": "hemisphere", "target": [0, 0, 0], "radius": [0.4, 0.8], "elevation": [20, 70],
        "azimuth": [-90, 90], "target_jitter": 0.01, "roll": [-10, 10],
    }  # fmt: skip
    scene_data["randomise"] = {
        "exposure": [-1, 1], "hue": [-5, 5], "saturation": [0.8, 1.2], "white_balance": [5000, 7000],
        "iso": [100, 800], "jpeg": [40, 95], "motion_blur": [0, 3],
    }  # fmt: skip
    return load_scene(write_scene(scene_data))


def test_seed_and_index_determine_a_frame(random_scene: Scene, scene_data: SceneData, write_scene: WriteScene) -> None:
    again = load_scene(write_scene(scene_data))
    forward = [planned(random_scene, index) for index in range(12)]
    backward = [planned(again, index) for index in reversed(range(12))][::-1]
    assert forward == backward
    assert len({str(plan[:1]) for plan in forward}) == 12
    other = load_scene(write_scene(scene_data), overrides={"seed": 8})
    assert planned(other, 0) != forward[0]


def test_adding_layouts_or_a_draw_does_not_change_earlier_frames(random_scene: Scene) -> None:
    longer = with_output(random_scene, layouts=50)
    assert [planned(longer, index) for index in range(12)] == [planned(random_scene, index) for index in range(12)]
    spec = random_scene.spec
    fixed = spec.model_copy(update={"randomise": spec.randomise.model_copy(update={"exposure": (0.0, 0.0)})})
    draws, fewer = plan_frame(random_scene, 3).draws, plan_frame(replace(random_scene, spec=fixed), 3).draws
    assert draws.pop("exposure") != fewer.pop("exposure") == 0.0
    assert draws == fewer


def test_draws_fill_their_ranges(random_scene: Scene) -> None:
    scene = with_output(random_scene, layouts=200)
    exposures = [plan_frame(scene, index).draws["exposure"] for index in range(400)]
    # Uniform on [-1, 1]: the standard error of the mean is 1 / sqrt(3 * 400) = 0.029.
    assert abs(np.mean(exposures)) < 0.12
    assert min(exposures) < -0.95
    assert max(exposures) > 0.95
    assert all(-1 <= exposure <= 1 for exposure in exposures)


def test_camera_colours_are_drawn_only_if_the_scene_states_them(random_scene: Scene) -> None:
    spec = random_scene.spec
    varied = spec.model_copy(update={"randomise": spec.randomise.model_copy(update={"chroma_stretch": (1.0, 1.4)})})
    plain = plan_frame(random_scene, 3).draws
    draws = [plan_frame(replace(random_scene, spec=varied), index).draws for index in range(12)]
    assert draws[3].keys() - plain.keys() == {"chroma_stretch", "chroma_angle"}
    assert all(draws[3][name] == value for name, value in plain.items())
    stretches, angles = ([one[name] for one in draws] for name in ("chroma_stretch", "chroma_angle"))
    assert 1 <= min(stretches) < 1.2 < max(stretches) <= 1.4
    assert 0 <= min(angles) < 60 and 120 < max(angles) <= 180


@pytest.mark.parametrize(("balance", "is_drawn"), [(5000.0, False), (6504.0, True), ("auto", True)])
def test_white_balance_is_drawn_unless_a_temperature_is_stated(
    balance: float | str, is_drawn: bool, random_scene: Scene
) -> None:
    spec = random_scene.spec
    stated = spec.model_copy(update={"composite": spec.composite.model_copy(update={"white_balance": balance})})
    assert ("white_balance" in plan_frame(replace(random_scene, spec=stated), 3).draws) == is_drawn


def test_random_streams_are_independent() -> None:
    values = [random_stream(*key).random() for key in [(0, "a", 0), (0, "a", 1), (0, "b", 0), (1, "a", 0)]]
    assert len(set(values)) == 4
    assert random_stream(0, "a", 0).random() == values[0]


@pytest.mark.parametrize("share", [0.0, 0.1, 0.2, 0.5, 0.7, 0.9, 1.0])
def test_split_is_by_layout_and_keeps_its_share(scene_data: SceneData, write_scene: WriteScene, share: float) -> None:
    scene_data["output"] |= {"validation": share, "layouts": 200, "views": 2}
    scene = load_scene(write_scene(scene_data))
    splits = [plan_frame(scene, index).split for index in range(400)]
    assert splits[::2] == splits[1::2]
    for layouts in range(2, 201):
        count = splits[: 2 * layouts : 2].count("val")
        assert abs(count - share * layouts) <= 1.0
        if 0 < share < 1:
            assert 0 < count < layouts


# Cameras


def eyes(scene: Scene) -> Iterator[np.ndarray]:
    return (plan_frame(scene, index).camera.centre for index in range(scene.num_frames))


def test_full_orbit_does_not_repeat_its_first_view(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["camera"] |= {"target": [1, 2, 3], "start": 90}
    scene = load_scene(write_scene(scene_data))
    expected = [(1, 2.5, 3.4), (0.5, 2, 3.4), (1, 1.5, 3.4), (1.5, 2, 3.4)]
    np.testing.assert_allclose(list(eyes(scene)), expected * 3, atol=1e-12)
    pixel, depth = plan_frame(scene, 1).camera.project([[1, 2, 3]])
    np.testing.assert_allclose(pixel, [[32, 24]], atol=1e-9)
    np.testing.assert_allclose(depth, [np.hypot(0.5, 0.4)])


def test_partial_orbit_ends_at_its_end(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["camera"]["sweep"] = 90
    *_, last = eyes(load_scene(write_scene(scene_data)))
    np.testing.assert_allclose(last, (0, 0.5, 0.4), atol=1e-12)


def test_path_passes_through_its_keys(scene_data: SceneData, write_scene: WriteScene) -> None:
    keys = [(0.5, 0, 0.5), (0, 0.5, 0.6), (-0.5, 0, 0.5), (0, -0.5, 0.4)]
    scene_data["camera"] = {"kind": "path", "keys": [{"eye": list(eye), "target": [0, 0, 0]} for eye in keys]}
    np.testing.assert_allclose(list(eyes(load_scene(write_scene(scene_data)))), keys * 3, atol=1e-12)


def test_jitter_has_its_standard_deviation(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["camera"]["jitter"] = 0.02
    scene_data["output"] |= {"layouts": 300, "views": 1}
    positions = np.array(list(eyes(load_scene(write_scene(scene_data)))))
    # 900 samples: the relative standard error of a standard deviation is 1 / sqrt(2 * 900) = 2.4 %.
    assert np.std(positions - positions.mean(axis=0)) == pytest.approx(0.02, rel=0.1)


def test_hemisphere_is_uniform_by_area_and_inside_its_ranges(random_scene: Scene) -> None:
    spec = random_scene.spec
    centred = spec.model_copy(update={"camera": spec.camera.model_copy(update={"target_jitter": 0.0})})
    scene = with_output(replace(random_scene, spec=centred), layouts=400, views=1)
    positions = np.array(list(eyes(scene)))
    radius = np.linalg.norm(positions, axis=1)
    sine = positions[:, 2] / radius
    azimuth = np.degrees(np.arctan2(positions[:, 1], positions[:, 0]))
    assert ((radius >= 0.4) & (radius <= 0.8)).all()
    assert ((azimuth >= -90) & (azimuth <= 90)).all()
    low, high = np.sin(np.radians([20, 70]))
    assert ((sine >= low - 1e-12) & (sine <= high + 1e-12)).all()
    # Uniform in the sine: mean (low + high) / 2, standard error (high - low) / sqrt(12 * 400).
    assert abs(sine.mean() - (low + high) / 2) < 4 * (high - low) / np.sqrt(12 * 400)


def test_roll_turns_the_image_about_its_middle(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["camera"] = {
        "kind": "hemisphere", "target": [0, 0, 0], "radius": [1, 1], "elevation": [0, 0], "azimuth": [0, 0],
        "roll": [90, 90],
    }  # fmt: skip
    camera = plan_frame(load_scene(write_scene(scene_data)), 0).camera
    # The camera's x axis, right, is rotated onto its former y axis, down.
    np.testing.assert_allclose(camera.world_from_camera[:3, 0], (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(camera.project([[0, 0, 0]])[0], [[32, 24]], atol=1e-9)


def test_intrinsics_follow_the_output_size(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["camera"]["intrinsics"] = {"fx": 100, "fy": 110, "cx": 60, "cy": 50, "size": [128, 96]}
    path = write_scene(scene_data)
    camera = plan_frame(load_scene(path), 0).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 55, 30, 25)
    scene_data["camera"]["intrinsics"] = {"fov_x": 90}
    camera = plan_frame(load_scene(write_scene(scene_data)), 0).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((32, 32, 32, 24))


# Lights


def test_light_path_is_linear_in_time(scene_data: SceneData, write_scene: WriteScene) -> None:
    path = [{"position": [0, 0, 1]}, {"position": [1, 0, 1]}, {"position": [1, 2, 1]}]
    scene_data["lights"] = [
        {"kind": "spot", "position": [9, 9, 9], "intensity": 10, "path": path},
        {"kind": "area", "position": [1, 0, 1], "radiance": 3},
        {"kind": "environment", "radiance": 0.5},
    ]
    scene_data["output"]["views"] = 5
    scene = load_scene(write_scene(scene_data))
    plans = [plan_frame(scene, index).lights for index in range(5)]
    assert [spot.position for spot, _, _ in plans] == [(0, 0, 1), (0.5, 0, 1), (1, 0, 1), (1, 1, 1), (1, 2, 1)]
    assert all((area, sky) == scene.spec.lights[1:] for _, area, sky in plans)
    assert not plans[0][0].path


def test_light_path_warms_evenly_in_reciprocal_temperature(scene_data: SceneData, write_scene: WriteScene) -> None:
    path = [{"temperature": 2500}, {"temperature": 10000}]
    scene_data["lights"] = [{"kind": "point", "position": [0, 0, 1], "temperature": 4000, "path": path}]
    scene_data["output"]["views"] = 3
    scene = load_scene(write_scene(scene_data))
    temperatures = [plan_frame(scene, index).lights[0].temperature for index in range(3)]
    assert temperatures == pytest.approx([2500, 4000, 10000])
    del scene_data["lights"][0]["temperature"]
    with pytest.raises(InputError, match=r"lights\[0\]\.path\[0\]\.temperature: needs a temperature"):
        load_scene(write_scene(scene_data))


# Schema


def test_schema_describes_every_key() -> None:
    schema = scene_json_schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert schema["$id"] == f"urn:mitsplat:scene:{SCHEMA_VERSION}"
    json.dumps(schema)
    models = [schema, *schema["$defs"].values()]
    undescribed = [
        f"{model['title']}.{key}"
        for model in models
        for key, value in model["properties"].items()
        if not value.get("description")
    ]
    assert undescribed == []
    assert all(model.get("description") for model in models)
    assert schema["properties"]["camera"]["discriminator"]["propertyName"] == "kind"
    count = schema["$defs"]["ObjectSpec"]["properties"]["count"]
    assert [option["type"] for option in count["anyOf"]] == ["integer", "array"]


def test_a_fisheye_with_a_field_beyond_85_degrees_is_refused(scene_data: SceneData, write_scene: WriteScene) -> None:
    """The corner is 1000 / 500 = 2 focal lengths from the centre; without distortion, 85 degrees are at 1.48."""
    lens = {"fx": 500, "size": [1600, 1200], "lens": "fisheye", "distortion": [0, 0, 0, 0]}
    scene_data["output"] = {"width": 160, "height": 120}
    scene_data["camera"]["intrinsics"] = lens
    found = refusal(write_scene(scene_data))
    assert found.startswith("camera.intrinsics.distortion: ")
    assert "85 degrees" in found
    load_scene(write_scene(scene_data | {"camera": scene_data["camera"] | {"intrinsics": lens | {"fx": 700}}}))
