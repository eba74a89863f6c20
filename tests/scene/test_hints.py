"""Hints at probable mistakes in scene files: files that are no assets, misspelt names, and percentages."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import trimesh

from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.unit_warnings import unit_warnings
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.storage.yaml_input import load_yaml
from tests.cli.typed import run

HEMISPHERE = {"kind": "hemisphere", "target": [0, 0, 0], "radius": [0.5, 0.8]}
BELT = {"belt": "belt", "speed": 0.2, "interval": 0.5}
BELT_SHAPES = [{"name": "belt", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}}]


def error_of(path: Path) -> str:
    with pytest.raises(InputError) as raised:
        load_scene(path)
    assert "\n" not in str(raised.value)
    return str(raised.value)


@pytest.mark.parametrize("key", ["asset", "pool", "environment"])
@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("part.stl", "(got a mesh; bake it first: `mitsplat bake {folder}/part.stl -o {folder}/part`)"),
        ("part.GLB", "a mesh; bake it first"),
        ("part.splat", "(got a splat file; import it first: `mitsplat import {folder}/part.splat -o {folder}/part`)"),
        ("part.ply", "(got splats or a mesh; import or bake it first: "),
        ("part.step", "(got a STEP file; bake it first: `mitsplat bake {folder}/part.step -o {folder}/part`)"),
        ("part.iges", "(got a CAD file; export it as .step"),
        ("part.txt", "must be an asset folder (got another file)"),
    ],
)
def test_a_file_instead_of_an_asset_is_refused_with_the_command_to_use(
    scene_data, write_scene, key: str, name: str, hint: str
) -> None:
    if key == "environment":
        scene_data["environment"] = name
    else:
        scene_data["objects"][0] = {"asset": name} if key == "asset" else {"pool": [name]}
    path = write_scene(scene_data)
    (path.parent / name).write_bytes(b"solid")
    message = error_of(path)
    assert hint.format(folder=path.parent) in message
    assert message.startswith(f"{path}:") and f"{path.parent / name}: must be an asset folder" in message


def test_folders_that_are_no_assets_are_refused_with_a_hint(scene_data, write_scene) -> None:
    scene_data["objects"][0] = {"asset": "assets/new"}
    path = write_scene(scene_data)
    folder = path.parent / "assets/new"
    folder.mkdir(parents=True)
    assert "must be an asset folder (got a folder without asset.yaml)" in error_of(path)
    (folder / "gear.stl").write_bytes(b"solid")
    assert "(got a folder without asset.yaml; gear.stl is a mesh; bake it first" in error_of(path)
    (folder / "dataset.json").write_text("{}")
    assert "(got the folder of a dataset" in error_of(path)
    scene_data["objects"][0] = {"asset": "assets/nut/asset.yaml"}
    assert f"(got its asset.yaml: give {path.parent}/assets/nut)" in error_of(write_scene(scene_data))


@pytest.mark.parametrize("name", ["assets/nutt", "asets/nut", "Assets/Nut", "nut", "parts/nut"])
def test_a_misspelt_asset_folder_is_refused_with_the_similar_one(scene_data, write_scene, name: str) -> None:
    scene_data["objects"][0] = {"asset": name}
    path = write_scene(scene_data)
    assert f"{path.parent / name}: no such folder; did you mean {path.parent / 'assets/nut'}?" in error_of(path)


def test_other_names_get_no_hint(scene_data, write_scene) -> None:
    scene_data["objects"][0] = {"asset": "zzzzzz"}
    path = write_scene(scene_data)
    assert error_of(path).endswith(f"{path.parent / 'zzzzzz'}: no such folder")


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        ({"formats": ["yolo", "cocoo"]}, """output.formats[1]: must be 'yolo', """),
        ({"formats": ["yolo", "cocoo"]}, """(got "cocoo"; did you mean 'coco'?)"""),
        ({"formats": ["COCO"]}, """(got "COCO"; did you mean 'coco'?)"""),
        ({"image": "jpeg"}, """(got "jpeg"; did you mean 'jpg'?)"""),
        ({"validation": 20}, "output.validation: must be <= 1 (got 20; a share of 20 % is 0.2)"),
        ({"test": 10}, "output.test: must be < 1 (got 10; a share of 10 % is 0.1)"),
        ({"validation": 2000}, "output.validation: must be <= 1 (got 2000)"),
        ({"viws": 3}, "output.viws: is not a known key (did you mean 'views'?)"),
    ],
)
def test_misspelt_words_and_percentages_are_refused_with_the_probable_value(
    scene_data, write_scene, change: dict[str, object], hint: str
) -> None:
    scene_data["output"] |= change
    assert hint in error_of(write_scene(scene_data))


def test_a_misspelt_kind_is_refused_with_the_similar_one(scene_data, write_scene) -> None:
    scene_data["camera"] |= {"kind": "hemisfere"}
    assert """(got "hemisfere"; did you mean 'hemisphere'?)""" in error_of(write_scene(scene_data))


def test_commands_refuse_misspelt_formats_and_other_files_with_a_hint(
    scene_data, write_scene, capsys, tmp_path
) -> None:
    path = write_scene(scene_data)
    assert run("render", path, "-o", tmp_path / "out", "--format", "yolo,cocoo") == 2
    assert "(got cocoo; did you mean coco?)" in capsys.readouterr().err
    trimesh.creation.box().export(tmp_path / "part.stl")
    assert run("check", tmp_path / "part.stl") == 2
    assert f"bake it first: `mitsplat bake {tmp_path}/part.stl" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"got suffix '\.stl', a mesh; bake it first"):
        Splats.load(tmp_path / "part.stl")
    with pytest.raises(InputError, match="a mesh; bake it first"):
        Asset.load(tmp_path / "part.stl")
    shutil.rmtree(tmp_path / "out", ignore_errors=True)


@pytest.mark.parametrize(
    ("changes", "text", "cause"),
    [
        ({"region": {"min": [-100, -100, 50], "max": [100, 100, 250]}}, "region: it is 200 m long", "millimetres?"),
        (
            {"lights": [{"kind": "point", "position": [0, 0, 1500], "intensity": 3}]},
            "lights[0]: it is 1500 m away",
            "millimetres?",
        ),
        ({"lights": [{"kind": "room", "size": 3400}]}, "lights[0].size: it is 3400 m", "millimetres?"),
        (
            {"lights": [{"kind": "room", "around": [0, -400, 300]}]},
            "lights[0].around: it is 500 m away",
            "millimetres?",
        ),
        (
            {"lights": [{"kind": "room"}, {"kind": "point", "position": [0, 0, 1500], "intensity": 3}]},
            "lights[1]: it is 1500 m away",
            "millimetres?",
        ),
        (
            {"lights": [{"kind": "environment", "colour": [255, 240, 230]}]},
            "lights[0].colour: its factors are up to 255",
            "from 0 to 255?",
        ),
        (
            {"shapes": [{"name": "a", "box": {"size": [1, 1, 1], "position": [0, 0, -1], "rotate": [0, 0, 1.57]}}]},
            "shapes[0]: it is rotated by 0, 0, 1.57 degrees",
            "radians?",
        ),
        (
            {"shapes": [{"name": "a", "box": {"size": [1, 1, 1], "position": [0, 0, -1], "rotate": [0, 0, 0.5236]}}]},
            "shapes[0]: it is rotated by 0, 0, 0.5236 degrees",
            "radians?",
        ),
        (
            {"shapes": [{"name": "a", "box": {"size": [1, 1, 1], "position": [0, 0, -25]}}]},
            "shapes[0]: it is 25 m away from the origin",
            "millimetres?",
        ),
        (
            {"shapes": [{"name": "a", "jitter": 5, "box": {"size": [1, 1, 1], "position": [0, 0, -1]}}]},
            "shapes[0].jitter: it is 5 m",
            "millimetres?",
        ),
        ({"camera": HEMISPHERE | {"elevation": [0.3, 1.4]}}, "camera.elevation: it is 0.3, 1.4 degrees", "radians?"),
        ({"camera": HEMISPHERE | {"azimuth": [0, 6.2832]}}, "camera.azimuth: it is 0, 6.2832 degrees", "radians?"),
        ({"camera": HEMISPHERE | {"roll": [-3.1416, 3.1416]}}, "camera.roll: it is -3.1416, 3.1416", "radians?"),
        ({"camera": HEMISPHERE | {"target_jitter": 20}}, "camera.target_jitter: it is 20 m", "millimetres?"),
        (
            {"camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 1, "height": 1, "sweep": 6.2832}},
            "camera.sweep: it is 6.2832 degrees",
            "radians?",
        ),
        (
            {"camera": {"kind": "fixed", "eye": [0, 0, 1], "target": [0, 0, 0], "jitter": 1}},
            "camera.jitter: it is 1 m, at 0.89 m",
            "millimetres?",
        ),
        (
            {"camera": {"kind": "path", "keys": [{"eye": [0, 0, 1], "target": [0, 0, 0]}], "jitter": 0.5}},
            "camera.jitter: it is 0.5 m, at 1 m",
            "millimetres?",
        ),
        (
            {"camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 3, "height": 4, "jitter": 2}},
            "camera.jitter: it is 2 m, at 5 m",
            "millimetres?",
        ),
        ({"camera": HEMISPHERE | {"target_jitter": 0.5}}, "camera.target_jitter: it is 0.5 m, at", "millimetres?"),
        ({"lights": [{"kind": "spot", "position": [0, 0, 2], "cone": 0.5}]}, "lights[0].cone: it is 0.5", "radians?"),
        ({"backdrop": {"size": [5000, 5000, 2800]}}, "backdrop.size: it is up to 5000 m", "millimetres?"),
        (
            {"conveyor": BELT | {"speed": 200}, "shapes": BELT_SHAPES},
            "conveyor.speed: it is 200 m/s",
            "millimetres per second?",
        ),
        (
            {"conveyor": BELT | {"interval": 500}, "shapes": BELT_SHAPES},
            "conveyor.interval: it is 500 s",
            "milliseconds?",
        ),
        (
            {"conveyor": BELT, "shapes": BELT_SHAPES, "camera": HEMISPHERE | {"motion": {"exposure": [5, 10]}}},
            "camera.motion.exposure: it is up to 10 s",
            "milliseconds?",
        ),
    ],
)
def test_values_in_another_unit_are_reported(scene_data, changes: dict[str, object], text: str, cause: str) -> None:
    assert list(unit_warnings(SceneSpec(**scene_data))) == []
    (found,) = unit_warnings(SceneSpec(**scene_data | changes))
    assert found.text.startswith(text) and cause in found.remedy


@pytest.mark.parametrize("name", ["benches", "close_up", "conveyor", "fisheye", "moving_light", "shelf", "workcell"])
def test_shipped_scenes_have_no_value_in_another_unit(name: str) -> None:
    scene = Path(__file__).parents[2] / f"scenes/{name}.yaml"
    assert list(unit_warnings(load_yaml(scene, SceneSpec))) == []


def test_a_pattern_of_assets_names_the_key_for_it(scene_data, write_scene) -> None:
    scene_data["objects"][0]["asset"] = "assets/*"
    assert "assets/*: no such folder; is it a pattern, for the key pool?" in error_of(write_scene(scene_data))


def test_more_objects_than_ids_are_refused(scene_data, write_scene) -> None:
    """The id maps of a layout with 70,000 objects would have repeated ids."""
    scene_data["objects"] = [{"asset": "assets/nut", "count": [1, 40_000]}, {"asset": "assets/nut", "count": 25_535}]
    load_yaml(write_scene(scene_data), SceneSpec)
    scene_data["objects"][1]["count"] = 25_536
    assert "objects: must be at most 65535 in a layout, as ids have 16 bits (got 65536)" in error_of(
        write_scene(scene_data)
    )
