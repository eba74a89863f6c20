"""Frames of scenes whose lights are drawn: a renderer that has made others makes the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mitsplat as ms
from mitsplat.formats.registry import Catalogue, write_frame
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


def test_a_renderer_that_has_made_others_makes_the_same_frame(scene: ms.Scene) -> None:
    layouts = [scatter_boxes(scene, layout, progress=None) for layout in range(4)]
    with ms.Renderer(scene, quality="fast") as renderer:
        frames = [renderer.render(index, layout=layouts[index // 3]) for index in range(8)]
    assert len({frame.plan.lights[-1].image for frame in frames}) > 1
    assert len({len(frame.plan.lights) for frame in frames}) > 1
    for index in (1, 6, 7):
        with ms.Renderer(scene, quality="fast") as renderer:
            alone = renderer.render(index, layout=layouts[index // 3])
        np.testing.assert_array_equal(alone.image, frames[index].image)
        np.testing.assert_array_equal(alone.light, frames[index].light)
    assert (frames[6].light != frames[7].light).any()  # another turn of the same sky


def test_the_manifest_states_lights_as_they_were(scene: ms.Scene, tmp_path: Path) -> None:
    layout = scatter_boxes(scene, 0, progress=None)
    with ms.Renderer(scene, quality="fast") as renderer:
        frame = renderer.render(1, layout=layout)
    record = write_frame(frame, tmp_path / "out", scene.spec, Catalogue.of(scene))
    *areas, sky = record["lights"]
    assert [area["position"] for area in areas] == [list(light.position) for light in frame.plan.lights[:-1]]
    assert set(sky) == {"kind", "radiance", "colour", "image", "rotate_z"} and sky["image"].startswith("skies/")
    assert all("draw" not in area for area in areas)
