"""Contents of a layout: draws from pools, balanced classes, and layouts without labelled objects."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mitsplat.errors import InputError
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.contents import draw_objects
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.scene_spec import Output
from mitsplat.scene.splits import draw_environment, is_empty, split_of
from tests.conftest import WriteScene, box_asset

SceneData = dict[str, Any]


@pytest.fixture
def pool_of_four(scene_data: SceneData, write_scene: WriteScene, tmp_path: Path) -> SceneData:
    """Return a pool of four assets in three classes: two are nuts."""
    box_asset("other_nut", class_name="nut").save(tmp_path / "assets/other_nut")
    box_asset("pin").save(tmp_path / "assets/pin")
    names = [f"assets/{name}" for name in ("nut", "other_nut", "bolt", "pin")]
    scene_data["objects"] = [{"pool": names, "count": [1, 4]}]
    scene_data["output"] |= {"layouts": 200, "validation": 0.25}
    return scene_data


def drawn(scene: Scene, layout: int) -> list[str]:
    return [scene.assets[asset].name for asset in draw_objects(scene, layout)[0]]


def counted(scene: Scene, split: str | None = None, layouts: int = 200) -> Counter[str]:
    wanted = (i for i in range(layouts) if split in (None, split_of(i, scene.spec.output)))
    return Counter(scene.assets[asset].class_name for i in wanted for asset in draw_objects(scene, i)[0])


def test_each_object_of_a_pool_is_drawn_independently(pool_of_four: SceneData, write_scene: WriteScene) -> None:
    scene = load_scene(write_scene(pool_of_four))
    layouts = [drawn(scene, index) for index in range(200)]
    assert {len(names) for names in layouts} == {1, 2, 3, 4}
    assert any(len(set(names)) < len(names) for names in layouts)
    counts = Counter(name for names in layouts for name in names)
    expected = sum(counts.values()) / 4
    assert all(abs(count - expected) < 4 * expected**0.5 for count in counts.values())


@pytest.mark.parametrize("layouts", [7, 50, 200])
def test_balance_draws_classes_in_turn(pool_of_four: SceneData, write_scene: WriteScene, layouts: int) -> None:
    """For any number of layouts and in each split, no class is ahead by two."""
    pool_of_four["objects"][0]["balance"] = True
    scene = load_scene(write_scene(pool_of_four | {"empty": 0.1}))
    for split in ("train", "val"):
        counts = counted(scene, split, layouts)
        assert max(counts.values()) - min(counts[name] for name in scene.class_names) <= 1
    assert len({tuple(drawn(scene, index)) for index in range(200)}) > 40


def test_the_order_of_layouts_does_not_change_draws(pool_of_four: SceneData, write_scene: WriteScene) -> None:
    pool_of_four["objects"][0]["balance"] = True
    path = write_scene(pool_of_four)
    one, other = load_scene(path), load_scene(path, overrides={"output.layouts": 3})
    backwards = {index: draw_objects(one, index)[0] for index in range(40, -1, -1)}
    assert backwards == {index: draw_objects(other, index)[0] for index in range(41)}


def test_a_pool_does_not_change_draws_of_other_entries(scene_data: SceneData, write_scene: WriteScene) -> None:
    plain = load_scene(write_scene(scene_data))
    scene_data["objects"].append({"pool": ["assets/nut", "assets/bolt"], "count": [0, 3], "label": False})
    more = load_scene(write_scene(scene_data))
    for index in range(20):
        assets = draw_objects(plain, index)[0]
        assert draw_objects(more, index)[0][: len(assets)] == assets


@pytest.mark.parametrize("share", [0.05, 0.3, 0.75])
def test_each_split_has_its_share_of_empty_layouts(
    pool_of_four: SceneData, write_scene: WriteScene, share: float
) -> None:
    pool_of_four["objects"].append({"asset": "assets/pin", "label": False})
    scene = load_scene(write_scene(pool_of_four | {"empty": share}))
    for split in ("train", "val"):
        layouts = [i for i in range(200) if split_of(i, scene.spec.output) == split]
        empty = [i for i in layouts if is_empty(scene.spec, i)]
        assert abs(len(empty) - share * len(layouts)) <= 1
        for index in layouts:
            labelled = [a for a in draw_objects(scene, index)[0] if scene.class_index(a) is not None]
            assert bool(labelled) == (index not in empty)
            assert scene.pools[1][0] in draw_objects(scene, index)[0]  # distractors are in all layouts


def test_classes_are_those_of_labelled_objects(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data["objects"][0]["label"] = False
    scene = load_scene(write_scene(scene_data))
    assert scene.class_names == ("bolt",)
    assert [scene.class_index(asset) for asset in (0, 1)] == [None, 0]


def test_a_pattern_is_replaced_by_its_matches(scene_data: SceneData, write_scene: WriteScene, tmp_path: Path) -> None:
    """Matches are sorted by name, restricted to objects, and written into the scene for the dataset's record."""
    path = write_scene(scene_data | {"objects": [{"pool": "assets/*", "count": 2}]})
    box_asset("around").save(tmp_path / "assets/around")
    folder = tmp_path / "assets/around/asset.yaml"
    folder.write_text(folder.read_text().replace("kind: object", "kind: environment"))
    (tmp_path / "assets/notes").mkdir()
    scene = load_scene(path)
    assert scene.spec.objects[0].pool == ("assets/bolt", "assets/nut")
    assert [asset.name for asset in scene.assets] == ["bolt", "nut"]
    with pytest.raises(InputError, match=r"objects\[0\]\.pool: must be inside the scene's folder"):
        load_scene(write_scene(scene_data | {"objects": [{"pool": "../*"}]}))


def test_a_range_of_scales_gives_assets_of_several_sizes(scene_data: SceneData, write_scene: WriteScene) -> None:
    """Each size is a complete asset, with scaled mesh, splats, pieces and mass: poses stay rigid."""
    scene_data["objects"] = [{"pool": ["assets/nut", "assets/bolt"], "scale": [0.5, 2], "count": 3}]
    scene = load_scene(write_scene(scene_data))
    assert scene.pools == (range(10),)
    factors = [0.5, 0.5**0.5, 1, 2**0.5, 2]
    for asset, factor in zip(scene.assets, factors + factors, strict=True):
        assert asset.mesh is not None
        edge = 0.03 if asset.name == "nut" else 0.05
        assert asset.mesh.extents.max() == pytest.approx(edge * factor)
        assert asset.pieces[0].extents.max() == pytest.approx(edge * factor)
        assert abs(asset.splats.means).max() == pytest.approx(edge * factor / 2)
    assert {asset for index in range(60) for asset in draw_objects(scene, index)[0]} == set(range(10))


@pytest.mark.parametrize(("validation", "test"), [(0.2, 0.1), (0.25, 0.25), (0.0, 0.3), (0.7, 0.3), (0.1, 0.6)])
def test_three_splits_have_their_shares(validation: float, test: float) -> None:
    """For any number of layouts, the error is at most one for each of the two divisions."""
    splits = [split_of(layout, Output(validation=validation, test=test)) for layout in range(500)]
    assert splits[1 if test <= 0.5 else 0] == "test"
    for count in (10, 37, 500):
        shares = {"train": 1 - validation - test, "val": validation, "test": test}
        for name, share in shares.items():
            assert abs(splits[:count].count(name) - share * count) < 2, (name, count)


def test_each_of_three_splits_is_balanced_and_has_its_empty_layouts(
    pool_of_four: SceneData, write_scene: WriteScene
) -> None:
    pool_of_four["objects"][0]["balance"] = True
    pool_of_four["output"] |= {"validation": 0.2, "test": 0.2}
    scene = load_scene(write_scene(pool_of_four | {"empty": 0.25}))
    splits = {index: split_of(index, scene.spec.output) for index in range(200)}
    for split in ("train", "val", "test"):
        layouts = [index for index in splits if splits[index] == split]
        counts = Counter(scene.assets[a].class_name for index in layouts for a in draw_objects(scene, index)[0])
        assert len(counts) == 3 and max(counts.values()) - min(counts.values()) <= 1
        assert abs(sum(is_empty(scene.spec, index) for index in layouts) - len(layouts) / 4) <= 1


@pytest.mark.parametrize("balance", [False, True])
def test_held_out_assets_are_in_the_test_split_only(
    pool_of_four: SceneData, write_scene: WriteScene, balance: bool
) -> None:
    """Members of pools and separate entries are held out.

    A separate entry has no objects in other splits; the number of other objects does not change.
    """
    pool_of_four["objects"] = [pool_of_four["objects"][0] | {"balance": balance}, {"asset": "assets/pin", "count": 2}]
    pool_of_four["output"] |= {"test": 0.25}
    plain = load_scene(write_scene(pool_of_four))
    scene = load_scene(write_scene(pool_of_four | {"hold_out": {"assets": ["assets/pin", "assets/other_nut"]}}))
    seen: dict[bool, set[str]] = {True: set(), False: set()}
    for index in range(200):
        is_test = split_of(index, scene.spec.output) == "test"
        names = drawn(scene, index)
        seen[is_test] |= set(names)
        assert len(drawn(plain, index)) - len(names) == (0 if is_test else 2)
    assert seen == {True: {"nut", "other_nut", "bolt", "pin"}, False: {"nut", "bolt"}}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"hold_out": {"assets": ["assets/nut"]}}, r"hold_out: needs a test split: set output\.test"),
        (
            {"hold_out": {"assets": ["assets/nail"]}, "output": {"test": 0.1}},
            r"hold_out\.assets\[0\]: must be among the assets of the scene, .*assets/nut \(got assets/nail\)",
        ),
        (
            {"hold_out": {"environments": ["assets/nut"]}, "output": {"test": 0.1}},
            r"hold_out\.environments\[0\]: must be among the environments of the scene, none \(got assets/nut\)",
        ),
        ({"output": {"validation": 0.5, "test": 0.6}}, r"test: must be at most 1 - validation, 0\.5 \(got 0\.6\)"),
    ],
)
def test_invalid_splits_are_refused(
    scene_data: SceneData, write_scene: WriteScene, change: SceneData, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        load_scene(write_scene(scene_data | change))


def test_held_out_environments_are_in_the_test_split_only(
    scene_data: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    for name in ("hall", "yard", "cell"):
        replace(box_asset(name), kind="environment").save(tmp_path / "assets" / name)
    names = ("assets/cell", "assets/hall", "assets/yard")
    scene_data |= {"environment": list(names), "output": {"layouts": 200, "test": 0.25}}
    held_out = {"hold_out": {"environments": ["assets/hall"]}}
    spec = load_scene(write_scene(scene_data | held_out)).spec
    seen: dict[bool, set[str]] = {True: set(), False: set()}
    for layout in range(200):
        seen[split_of(layout, spec.output) == "test"].add(names[draw_environment(spec, layout)])
    assert seen == {True: set(names), False: {"assets/cell", "assets/yard"}}
    with pytest.raises(
        InputError, match=r"hold_out\.environments: must leave at least one environment for training \(got all 3\)"
    ):
        load_scene(write_scene(scene_data | {"hold_out": {"environments": list(names)}}))
