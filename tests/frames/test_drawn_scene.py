"""Frames of scenes with drawn lights and appearances: records and determinism."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mitsplat as ms
from mitsplat.formats.registry import Catalogue, write_frame
from mitsplat.frames.camera_response import develop
from mitsplat.frames.mitsuba_xml import export_xml, render_xml
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from tests.conftest import WriteScene
from tests.drawn import scatter_boxes

LIGHTS = [
    {"kind": "area", "draw": {"vary": "frame", "count": [0, 2], "distance": [0.6, 1.2], "radiance": [5, 20]}},
    {"kind": "environment", "pool": "skies/*", "draw": {"vary": "frame", "rotate_z": [0, 360], "radiance": [0.5, 2]}},
]


@pytest.fixture
def scene(scene_data: dict[str, Any], write_scene: WriteScene, tmp_path: Path) -> ms.Scene:
    (tmp_path / "skies").mkdir()
    for number in range(3):
        sky = np.random.default_rng(number).integers(0, 255, (8, 16, 3)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"skies/{number}.png"), sky)
    scene_data["output"] |= {"layouts": 4, "views": 3}
    return ms.load_scene(write_scene(scene_data | {"lights": LIGHTS}))


def test_earlier_frames_of_a_renderer_do_not_change_a_frame(scene: ms.Scene) -> None:
    layouts = [scatter_boxes(scene, layout, progress=None) for layout in range(4)]
    with ms.Renderer(scene, quality="fast") as renderer:
        frames = {index: renderer.render(index, layout=layouts[index // 3]) for index in (0, 1, 6, 7)}
    assert len({frame.plan.lights[-1].image for frame in frames.values()}) > 1
    assert len({len(frame.plan.lights) for frame in frames.values()}) > 1
    for index in (1, 6, 7):
        with ms.Renderer(scene, quality="fast") as renderer:
            alone = renderer.render(index, layout=layouts[index // 3])
        np.testing.assert_array_equal(alone.image, frames[index].image)
        np.testing.assert_array_equal(alone.layers.light, frames[index].layers.light)
    assert (frames[6].layers.light != frames[7].layers.light).any()  # another rotation of the same sky


def test_the_manifest_records_the_drawn_lights(scene: ms.Scene, tmp_path: Path) -> None:
    layout = scatter_boxes(scene, 0, progress=None)
    with ms.Renderer(scene, quality="fast") as renderer:
        frame = renderer.render(1, layout=layout)
    record = write_frame(frame, tmp_path / "out", scene.spec, Catalogue.of(scene))
    *areas, sky = record["lights"]
    assert [area["position"] for area in areas] == [list(light.position) for light in frame.plan.lights[:-1]]
    assert set(sky) == {"kind", "radiance", "colour", "image", "rotate_z"} and sky["image"].startswith("skies/")
    assert all("draw" not in area for area in areas)


APPEARANCE = {"hue": [-30, 30], "value": [0.4, 0.9], "gain": [0.8, 1.2], "roughness": [0.2, 0.8], "wear": [0.2, 1]}


def _apart() -> Layout:
    """Return a layout of three nuts and a bolt around the middle."""
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = (-0.05, 0, 0.005), (0, 0.05, 0.005), (0.05, 0, 0.005), (0, -0.05, 0.025)
    instances = [Instance(i + 1, int(i == 3), int(i < 3), pose) for i, pose in enumerate(poses)]
    return Layout(0, tuple(instances), NO_PHYSICS)


APART = _apart()


def test_appearances_change_colours_only(scene_data: Any, write_scene: WriteScene, tmp_path: Path) -> None:
    def frames(**keys: Any) -> list[ms.Frame]:
        scene_data["camera"] |= {"radius": 0.15, "height": 0.15}
        scene_data["objects"] = [{"asset": "assets/nut", "count": 3, **keys}, {"asset": "assets/bolt"}]
        scene = ms.load_scene(write_scene(scene_data))
        with ms.Renderer(scene, quality="fast") as renderer:
            return [renderer.render(index, layout=APART) for index in range(2)]

    plain, varied, again = frames(), frames(appearance=APPEARANCE), frames(appearance=APPEARANCE)
    scene = ms.load_scene(tmp_path / "scene.yaml")
    for one, other, third in zip(plain, varied, again, strict=True):
        np.testing.assert_array_equal(one.instance, other.instance)
        np.testing.assert_array_equal(one.depth, other.depth)
        assert one.labels.to_json() == other.labels.to_json()
        np.testing.assert_array_equal(other.image, third.image)
        change = np.abs(one.layers.captured - other.layers.captured).max(axis=-1)
        nuts = np.isin(one.instance, [i.id for i in one.layout.instances if i.asset == 0])
        assert nuts.sum() > 30 and np.mean(change[nuts] > 0.01) > 0.95
        # Gaussians extend a few pixels beyond the instance mask; the table and the bolt do not change.
        assert change[~cv2.dilate(nuts.astype(np.uint8), np.ones((13, 13))).astype(bool)].max() == 0
    record = write_frame(varied[0], tmp_path / "out", scene.spec, Catalogue.of(scene))
    drawn = {one["id"]: one for one in record["appearance"]}
    assert set(drawn) == {i.id for i in varied[0].layout.instances if i.asset == 0}
    assert all(0.2 <= one["wear"] <= 1 and 0.2 <= one["roughness"] <= 0.8 for one in drawn.values())
    assert "appearance" not in write_frame(
        plain[0],
        tmp_path / "plain",
        scene.spec.model_copy(
            update={"objects": tuple(entry.model_copy(update={"appearance": None}) for entry in scene.spec.objects)}
        ),
        Catalogue.of(scene),
    )


def test_exported_xml_renders_appearances(
    scene_data: Any, write_scene: WriteScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mitsplat.frames.mitsuba_xml.settle_layout", lambda scene, index: APART)
    scene_data["camera"] |= {"radius": 0.15, "height": 0.15}
    scene_data["objects"] = [
        {"asset": "assets/nut", "count": 3, "appearance": {"value": [0.2, 0.2], "wear": [0.5, 0.5]}},
        {"asset": "assets/bolt"},
    ]
    scene = ms.load_scene(write_scene(scene_data))
    export_xml(scene, 0, tmp_path / "one.xml")
    ours = cv2.imread(str(render_xml(tmp_path / "one.xml", tmp_path / "out.png")))[..., ::-1].astype(float)
    frame = ms.render_frame(scene, 0, layout=APART)
    covered = (frame.layers.alpha > 0.99) & np.isin(frame.instance, [1, 2, 3])
    assert covered.any() and np.abs(ours - develop(frame.rgb, {}))[covered].mean() < 1.0
