"""Frames of drawn surroundings equal those of fixed scenes, in any order, as files and as XML."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import pytest

import mitsplat as ms
from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.write import write_dataset
from mitsplat.frames.mitsuba_xml import export_xml
from mitsplat.images.colour import encode_srgb
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.planning.contents import draw_arrangements, draw_regions
from mitsplat.scene.planning.layout_surroundings import draw_surroundings
from mitsplat.scene.spec.scene_spec import FORMATS
from tests.conftest import WriteScene, box_asset
from tests.manifests import records_of

SceneData = dict[str, Any]


def lying(scene: ms.Scene, index: int, **_: Any) -> Layout:
    """Return a layout of one object above the table's middle."""
    pose = np.eye(4)
    pose[:3, 3] = 0, 0, 0.006
    return Layout(index, (Instance(1, 0, scene.class_index(0), pose),), NO_PHYSICS)


@pytest.fixture
def places(scene_data: SceneData, write_scene: WriteScene, tmp_path: Path) -> SceneData:
    """Return a scene with two environments, a table of many materials, and background images."""
    for name, grey in (("cell_a", 0.3), ("cell_b", -0.5)):
        wall = box_asset(name, (0.3, 0.3, 0.1))
        splats = replace(wall.splats, means=wall.splats.means + np.float32([0, 0.35, 0]), sh=wall.splats.sh + grey)
        replace(wall, splats=splats, kind="environment", mesh=None, pieces=()).save(tmp_path / "assets" / name)
    rng = np.random.default_rng(0)
    for number in range(2):
        image = rng.integers(0, 256, (8, 10, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / f"{number}.png"), cv2.resize(image, (200, 160)))
    kinds = [{"kind": kind} for kind in ("colour", "noise", "wood", "checker")]
    scene_data |= {
        "environment": "assets/cell_*",
        "background": {"images": "*.png"},
        "objects": [{"asset": "assets/nut", "scale": 4}],
    }
    table = {"size": [0.4, 0.4, 0.1], "position": [0, 0, -0.05], "rotate": [0, 0, 10]}
    materials = [*kinds, {"kind": "image", "images": "0.png"}]
    scene_data["shapes"][0] |= {"box": table, "materials": materials}
    scene_data["output"] = {"width": 64, "height": 48, "layouts": 6, "views": 2, "validation": 0.5}
    return scene_data


def neighbours(scene: ms.Scene) -> tuple[int, int]:
    """Return the first two successive layouts with different environments."""
    numbers = [draw_surroundings(scene.spec, 2 * layout).environment for layout in range(6)]
    return next(pair for pair in pairwise(range(6)) if numbers[pair[0]] != numbers[pair[1]])


def test_a_drawn_environment_renders_as_a_stated_one(places: SceneData, write_scene: WriteScene) -> None:
    del places["shapes"][0]["materials"]
    del places["background"]
    drawn = ms.load_scene(write_scene(places))
    seen = {}
    with ms.Renderer(drawn) as renderer:
        for layout in neighbours(drawn):
            frame = renderer.render(2 * layout, layout=lying(drawn, layout))
            seen[layout] = (draw_surroundings(drawn.spec, frame.index).environment, frame.image)
    assert {number for number, _ in seen.values()} == {0, 1}
    for layout, (number, image) in seen.items():
        places["environment"] = f"assets/cell_{'ab'[number]}"
        stated = ms.load_scene(write_scene(places))
        np.testing.assert_array_equal(
            ms.render_frame(stated, 2 * layout, layout=lying(stated, layout)).image, image, strict=True
        )


def test_a_material_of_one_colour_renders_as_the_colour_key(places: SceneData, write_scene: WriteScene) -> None:
    del places["environment"], places["background"]
    places["shapes"][0]["materials"] = [{"kind": "colour"}]
    scene = ms.load_scene(write_scene(places))
    frame = ms.render_frame(scene, 0, layout=lying(scene, 0))
    del places["shapes"][0]["materials"]
    places["shapes"][0]["colour"] = draw_surroundings(scene.spec, frame.index).materials["table"].colours[0]
    stated = ms.load_scene(write_scene(places))
    np.testing.assert_array_equal(ms.render_frame(stated, 0, layout=lying(stated, 0)).image, frame.image)


def test_the_order_of_frames_does_not_change_them(places: SceneData, write_scene: WriteScene) -> None:
    scene = ms.load_scene(write_scene(places))
    frames = [2 * layout + view for layout in neighbours(scene) for view in range(2)]
    with ms.Renderer(scene) as renderer:
        forth = [renderer.render(index, layout=lying(scene, index // 2)).image for index in frames]
    with ms.Renderer(scene) as renderer:
        back = [renderer.render(index, layout=lying(scene, index // 2)).image for index in frames[::-1]][::-1]
    assert len({image.tobytes() for image in forth}) == 4
    np.testing.assert_array_equal(forth, back)


def test_given_frames_keep_the_surroundings_in_which_they_were_rendered(
    places: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    """A frame gets a new number in a dataset made in Python, but the manifest records what its picture shows."""
    scene = ms.load_scene(write_scene(places))
    with ms.Renderer(scene) as renderer:
        frames = [renderer.render(index, layout=lying(scene, index // 2)) for index in (7, 5)]
    records = records_of(ms.write_frames(scene, tmp_path / "out", frames).path)
    for record, frame in zip(records, frames, strict=True):
        place = draw_surroundings(scene.spec, frame.index)
        assert record["place"] == json.loads(json.dumps(place.to_json(scene.spec)))
    assert list(audit_dataset(tmp_path / "out").violations) == []


def test_a_dataset_with_drawn_environments_has_no_violations(
    places: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    """The manifest records every draw and passes its schema; no label includes surroundings."""
    places["labels"] = {"min_pixels": 1, "min_fragment": 1}
    places["depth_sensor"] = {"kind": "tof"}
    places["output"] |= {"layouts": 3, "formats": [name for name in FORMATS if name not in ("colmap", "yolo-pose")]}
    scene = ms.load_scene(write_scene(places))
    out = write_dataset(scene, tmp_path / "out", settle=lying, workers=1).path
    found = audit_dataset(out)
    assert found.violations == () and found.instances == 6
    records = records_of(out)
    for record in records:
        place = draw_surroundings(scene.spec, record["index"])
        assert set(record["place"]) == {"environment", "materials", "background"}
        assert record["place"] == json.loads(json.dumps(place.to_json(scene.spec)))
    content = json.loads((out / "dataset.json").read_bytes())
    assert content["scene"]["environment"] == ["assets/cell_a", "assets/cell_b"]
    assert len(content["inputs"]["background.images"]) == 64


@pytest.mark.parametrize("kind", ["colour", "wood"])
def test_exported_xml_renders_the_same_environment(
    places: SceneData, write_scene: WriteScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    del places["background"]
    places["shapes"][0]["materials"] = [{"kind": kind}]
    scene = ms.load_scene(write_scene(places))
    monkeypatch.setattr("mitsplat.frames.mitsuba_xml.settle_layout", lying)
    frame = ms.render_frame(scene, 3, layout=lying(scene, 1))
    export_xml(scene, 3, tmp_path / "frame.xml")
    read = mi.load_file(str(tmp_path / "frame.xml"))
    image = np.array(read.integrator().render(read, read.sensors()[0]))
    shown = encode_srgb(image[..., :3])
    expected = encode_srgb(frame.layers.rgb)
    assert np.abs(shown - expected).mean() < 0.004


def test_the_manifest_records_regions_and_arrangements(
    scene_data: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    scene_data |= {"regions": [{"name": "shelf", "min": [-0.2, -0.2, 0.3], "max": [0.2, 0.2, 0.5]}]}
    scene_data["settle"] = {"arrangement": ["drop", "pushed"]}
    scene_data["objects"] = [{"asset": "assets/nut", "scale": 4}]
    scene_data["output"] |= {"layouts": 4, "views": 1}
    scene = ms.load_scene(write_scene(scene_data))
    out = write_dataset(scene, tmp_path / "out", settle=lying, workers=1).path
    assert audit_dataset(out).violations == ()
    records = records_of(out)
    told = [record["objects"][0]["region"] for record in records]
    assert told == [("main", "shelf")[draw_regions(scene.spec, index)[0]] for index in range(4)]
    assert set(told) == {"main", "shelf"}
    drawn = [tuple(record["arrangement"].values()) for record in records]
    assert drawn == [draw_arrangements(scene.spec, index) for index in range(4)]
    assert records[0]["arrangement"].keys() == {"main", "shelf"}
