"""Inputs of a scene that decide whether its dataset can be resumed: every file of every entry, with any name."""

import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from ruamel.yaml import YAML

from mitsplat.asset import Asset
from mitsplat.dataset.inputs import describe_inputs
from mitsplat.errors import InputError
from mitsplat.frames.mitsuba_xml import export_xml
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.loading.scene_loading import load_scene
from tests.conftest import box_asset
from tests.dataset.test_write import never_render, write

SCENE = {
    "name": "all inputs",
    "environment": "assets/room",
    "objects": [
        {"asset": "assets/nut"},
        {"asset": "assets/other_nut"},  # same asset name
        {"asset": "assets/loose", "size": 0.04},
        {"asset": "assets/loose", "size": 0.05},
        {"asset": "assets/nut", "class_name": "large", "scale": 2},
    ],
    "shapes": [
        {"name": "nut", "mesh": "table.ply", "visible": True},  # same name as the assets
        {"name": "assets/sky.png", "mesh": "stand.obj", "visible": True},
    ],
    "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
    "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
    "lights": [{"kind": "point", "position": [0, 0, 1]}, {"kind": "environment", "image": "assets/sky.png"}],
    "output": {"width": 64, "height": 48, "layouts": 2, "views": 1},
}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Build a scene with every kind of input file, and its dataset of one frame."""
    folder = tmp_path_factory.mktemp("inputs")
    points = {"top": (0.0, 0.0, 0.005), "tip": (0.01, 0.0, 0.0)}
    for name, size in (("nut", 0.02), ("other_nut", 0.03)):
        nut = replace(box_asset("nut", (size, 0.03, 0.01)), keypoints=points)
        if name == "other_nut":
            nut = replace(nut, splats=replace(nut.splats, materials=SplatMaterials.uniform(12)))
        nut.save(folder / "assets" / name)
    replace(box_asset("loose"), class_name="nut", units="unknown", keypoints=points).save(folder / "assets/loose")
    replace(box_asset("nut", (1.0, 1.0, 0.5)), kind="environment", white=3.0).save(folder / "assets/room")
    trimesh.creation.box((1, 1, 0.1)).export(folder / "table.ply")
    trimesh.creation.box((0.1, 0.1, 0.1)).export(folder / "stand.obj")
    cv2.imwrite(str(folder / "assets/sky.png"), np.full((4, 8, 3), 90, dtype=np.uint8))
    YAML(typ="safe", pure=True).dump(SCENE, folder / "scene.yaml")
    write(load_scene(folder / "scene.yaml"), folder / "out", frames=1)
    return folder


@pytest.fixture
def copy(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def colour(path: Path) -> None:
    """Change the red value of one Gaussian in a PLY file."""
    splats = Asset.load(path.parent).splats
    sh = splats.sh.copy()
    sh[3, 0, 0] += 0.25
    replace(splats, sh=sh).save(path)


def polish(path: Path) -> None:
    """Change the last parameter of the last Gaussian in a file of materials."""
    path.write_bytes(path.read_bytes()[:-1] + b"\0")


def bend(path: Path) -> None:
    """Move the first vertex of a mesh inwards by 1 % of its coordinates."""
    mesh = trimesh.load_mesh(path, process=False)
    mesh.vertices[0] *= 0.99
    mesh.export(path)


def repaint(path: Path) -> None:
    picture = cv2.imread(str(path))
    picture[0, 0, 0] += 1
    cv2.imwrite(str(path), picture)


def say(before: str, after: str):
    def edit(path: Path) -> None:
        text = path.read_text()
        assert text.count(before) == 1
        path.write_text(text.replace(before, after))

    return edit


OBJECTS = {"nut": (0, 4), "other_nut": (1,), "loose": (2, 3)}
EDITS = [
    *((f"assets/{name}/splats.ply", colour, f"objects[{at[0]}].splats") for name, at in OBJECTS.items()),
    *((f"assets/{name}/mesh.ply", bend, f"objects[{at[0]}].mesh") for name, at in OBJECTS.items()),
    *((f"assets/{name}/pieces.ply", bend, f"objects[{at[0]}].pieces") for name, at in OBJECTS.items()),
    *(
        (f"assets/{name}/asset.yaml", say("friction: 0.5", "friction: 0.7"), f"objects[{at[0]}].friction")
        for name, at in OBJECTS.items()
    ),
    ("assets/other_nut/materials.ply", polish, "objects[1].splats"),
    ("assets/other_nut/asset.yaml", say("name: nut\n", "name: nut2\n"), "assets"),
    ("assets/other_nut/asset.yaml", say("class: nut", "class: large"), "objects[1].class_name"),
    ("assets/other_nut/asset.yaml", say("density: 1000.0", "mass: 0.5"), "objects[1].mass"),
    ("assets/other_nut/asset.yaml", say("- 0.005", "- 0.004"), "objects[1].keypoints.top"),
    ("assets/loose/asset.yaml", say("roughness: 0.4", "roughness: 0.3"), "objects[2].roughness"),
    ("assets/loose/asset.yaml", say("specular: 0.04", "specular: 0.05"), "objects[2].specular"),
    ("assets/other_nut/asset.yaml", say("capture_light: uniform", "capture_light: scene"), "objects[1].capture_light"),
    ("assets/room/asset.yaml", say("white: 3.0", "white: 2.0"), "environment.white"),
    ("assets/room/splats.ply", colour, "environment.splats"),
    ("assets/room/mesh.ply", bend, "environment.mesh"),
    ("assets/room/pieces.ply", bend, "environment.pieces"),
    ("table.ply", bend, "shapes[0]"),
    ("stand.obj", bend, "shapes[1]"),
    ("assets/sky.png", repaint, "lights[1].image"),
]


@pytest.mark.parametrize(("file", "edit", "key"), EDITS, ids=[f"{file} {key}" for file, _, key in EDITS])
def test_resuming_after_an_edit_of_an_input_is_refused_by_its_key(copy, file, edit, key):
    edit(copy / file)
    with pytest.raises(InputError) as caught:
        write(load_scene(copy / "scene.yaml"), copy / "out", render=never_render)
    key = key if key == "assets" else f"inputs.{key}"
    assert str(caught.value).startswith(f"{copy / 'out'}: cannot be resumed: {key}")
    assert str(caught.value).endswith(": overwrite it or choose another folder")


def test_files_and_remarks_that_are_not_read_may_change(copy):
    """Comments, files that nothing refers to, and modification times are not content."""
    with (copy / "assets/nut/asset.yaml").open("a") as file:
        file.write("# seen\n")
    (copy / "assets/nut/notes.txt").write_text("")
    (copy / "table.ply").touch()
    assert write(load_scene(copy / "scene.yaml"), copy / "out").rendered == 1


def test_entries_with_the_same_asset_have_different_hashes(made):
    found = describe_inputs(load_scene(made / "scene.yaml"))
    assert len({found[f"objects[{i}]"]["splats"] for i in range(5)}) == 5
    assert found["objects[0]"]["class_name"] == "nut"
    assert found["objects[4]"]["class_name"] == "large"
    assert set(found["environment"]) == {f.name for f in fields(Asset)} - {"folder"}


def test_an_exported_scene_holds_each_asset_of_the_same_name(copy, tmp_path, monkeypatch):
    """This holds if an earlier export left files in the folder, and for an asset name that is no valid file name."""
    monkeypatch.setattr("mitsplat.frames.mitsuba_xml.settle_layout", every_entry)
    for name in ("nut", "a/b"):
        for folder in ("nut", "other_nut"):
            file = copy / "assets" / folder / "asset.yaml"
            file.write_text(re.sub("^name: .*", f"name: {name}", file.read_text(), flags=re.MULTILINE))
        colour(copy / "assets/other_nut/splats.ply")
        scene = load_scene(copy / "scene.yaml")
        export_xml(scene, 0, tmp_path / "frame.xml")
        for position, asset in enumerate(scene.assets):
            kept = Splats.load(tmp_path / f"frame_files/object_{position}.ply")
            np.testing.assert_array_equal(kept.sh, asset.splats.sh)
            np.testing.assert_array_equal(kept.means, asset.splats.means)


def every_entry(scene, index):
    poses = (Instance(i + 1, i, 0, np.eye(4)) for i in range(len(scene.assets)))
    return Layout(index, tuple(poses), NO_PHYSICS)
