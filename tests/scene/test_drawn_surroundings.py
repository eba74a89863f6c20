"""Drawn surroundings of a layout: environments, materials, backgrounds, and their validation."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mitsplat.checks.scene_warnings import scene_warnings
from mitsplat.errors import InputError
from mitsplat.frames.light_properties import light_properties
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.layout_surroundings import MaterialDraw, draw_surroundings
from tests.conftest import WriteScene, box_asset

SceneData = dict[str, Any]

KINDS = ("colour", "noise", "wood", "checker", "stripes")


@pytest.fixture
def cells(tmp_path: Path) -> None:
    """Return a scene of two environments, and an object that a pattern must not match."""
    for name, size in (("cell_a", (1.0, 1.0, 0.1)), ("cell_b", (2.0, 1.0, 0.1))):
        replace(box_asset(name, size), kind="environment").save(tmp_path / "assets" / name)
    box_asset("cell_tool").save(tmp_path / "assets/cell_tool")


def write_images(folder: Path, *names: str) -> None:
    for number, name in enumerate(names):
        (folder / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), np.full((20, 30, 3), 40 * number, dtype=np.uint8))


@pytest.mark.usefixtures("cells")
def test_each_layout_draws_an_environment(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene_data |= {"environment": "assets/cell_*"}
    scene_data["output"] |= {"layouts": 200, "views": 2}
    scene = load_scene(write_scene(scene_data))
    assert scene.spec.environment == ("assets/cell_a", "assets/cell_b")
    plans = [draw_surroundings(scene.spec, index) for index in range(scene.num_frames)]
    assert all(first.environment == second.environment for first, second in zip(plans[::2], plans[1::2], strict=True))
    counts = Counter(place.environment for place in plans[::2])
    assert abs(counts[1] - 100) < 4 * (200 * 0.5 * 0.5) ** 0.5
    told = plans[0].to_json(scene.spec)
    assert told == {"environment": {"number": told["environment"]["number"], "name": told["environment"]["name"]}}
    chosen = scene.environment_of(0)
    assert chosen is not None
    assert f"assets/{chosen.name}" == told["environment"]["name"]


def test_a_scene_with_one_environment_records_no_draw(scene_data: SceneData, write_scene: WriteScene) -> None:
    scene = load_scene(write_scene(scene_data))
    assert draw_surroundings(scene.spec, 0).to_json(scene.spec) == {}
    stated = json.loads(scene.spec.model_dump_json())
    assert "background" not in stated
    assert "materials" not in stated["shapes"][0]


@pytest.mark.parametrize("kind", KINDS)
def test_every_value_of_a_material_is_within_its_range(
    scene_data: SceneData, write_scene: WriteScene, kind: str
) -> None:
    scene_data["shapes"][0]["materials"] = [{"kind": kind, "hue": [350, 370], "saturation": [0.4, 0.5]}]
    scene_data["output"]["layouts"] = 60
    scene = load_scene(write_scene(scene_data))
    (material,) = scene.spec.shapes[0].materials
    drawn = [draw_surroundings(scene.spec, 4 * layout).materials["table"] for layout in range(60)]
    assert len({finish.colours for finish in drawn}) == 60
    for finish in drawn:
        red, green, blue = finish.colours[0]
        value = max(finish.colours[0])
        assert material.value[0] <= value <= material.value[1]
        assert 0.4 - 1e-9 <= 1 - min(finish.colours[0]) / value <= 0.5 + 1e-9
        assert red == value and abs(green - blue) <= value * 0.5 * 10 / 60 + 1e-9
        if kind != "colour":
            dark = 1 - max(finish.colours[1]) / value
            assert material.contrast[0] - 1e-9 <= dark <= material.contrast[1] + 1e-9
            assert material.scale[0] <= finish.scale <= material.scale[1]


def test_a_further_material_shifts_no_other_draw(scene_data: SceneData, write_scene: WriteScene) -> None:
    def finishes() -> list[MaterialDraw]:
        scene = load_scene(write_scene(scene_data))
        return [draw_surroundings(scene.spec, index).materials["table"] for index in range(12)]

    scene_data["shapes"][0]["materials"] = [{"kind": "noise"}, {"kind": "wood"}]
    alone = finishes()
    assert {finish.kind for finish in alone} == {"noise", "wood"}
    assert alone == [finish for finish in alone[::4] for _ in range(4)]  # views of a layout have equal materials
    box = {"size": [0.1, 0.1, 0.1]}
    scene_data["shapes"].insert(0, {"name": "box", "box": box, "visible": True, "materials": [{"kind": "noise"}]})
    scene_data |= {"background": {"images": "photos"}}
    write_images(write_scene(scene_data).parent, "photos/a.png")
    assert finishes() == alone


def test_images_come_from_a_folder_a_pattern_or_a_list(scene_data: SceneData, write_scene: WriteScene) -> None:
    folder = write_scene(scene_data).parent
    write_images(folder, "photos/a.png", "photos/b.jpg", "photos/c.png")
    (folder / "photos/notes.txt").write_text("no image")
    for images, names in (
        ("photos", ("photos/a.png", "photos/b.jpg", "photos/c.png")),
        ("photos/*.png", ("photos/a.png", "photos/c.png")),
        ("photos/b.jpg", ("photos/b.jpg",)),
        (["photos/c.png", "photos/a.png"], ("photos/c.png", "photos/a.png")),
    ):
        scene_data |= {"background": {"images": images}}
        scene_data["shapes"][0]["materials"] = [{"kind": "image", "images": images}]
        scene = load_scene(write_scene(scene_data))
        assert scene.spec.background is not None
        assert scene.spec.background.images == names == scene.spec.shapes[0].materials[0].images
        assert set(scene.images) == set(names)


def test_each_frame_draws_a_background(scene_data: SceneData, write_scene: WriteScene) -> None:
    names = [f"photos/{number}.png" for number in range(3)]
    write_images(write_scene(scene_data).parent, *names)
    scene_data |= {"background": {"images": names}}
    scene = load_scene(write_scene(scene_data))
    drawn = [draw_surroundings(scene.spec, index).background for index in range(12)]
    assert len(set(drawn)) == 12
    for backing in drawn:
        assert backing is not None
        assert 0.5 <= backing.crop <= 1 and -15 <= backing.rotate <= 15 and 0.7 <= backing.gain <= 1.3


@pytest.mark.usefixtures("cells")
@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"environment": "gone_*"}, "environment: must match at least one asset folder of kind environment (got "),
        ({"environment": []}, "environment: must name at least one asset (got [])"),
        ({"environment": ["assets/cell_a", "assets/gone"]}, "environment[1]: "),
        ({"background": {"images": "photos"}}, "background.images: must name at least one image (got 'photos', which"),
        ({"background": {"images": "*.jpg"}}, "background.images: must name at least one image (got '*.jpg', which"),
        ({"background": {"images": []}}, "background.images: must name at least one image (got ()"),
        ({"background": {"images": ["gone.png"]}}, "gone.png: no such file"),
        ({"background": {"images": "bad.png"}}, "bad.png: not a readable image ("),
        ({"background": {"images": "/etc/*.png"}}, "background.images: must be inside the scene's folder"),
        ({"backdrop": {"size": [1, 1, 0]}}, "backdrop.size[2]: must be > 0 (got 0)"),
        ({"backdrop": {"size": [1, 1, 1], "walls": []}}, "backdrop.walls: must have at least one material (got [])"),
        (
            {"backdrop": {"size": [1, 1, 1], "floor": [{"kind": "image", "images": "gone.png"}]}},
            "backdrop.floor[0].images: must name at least one image (got 'gone.png', which",
        ),
        ({"materials": [{"kind": "glass"}]}, "shapes[0].materials[0].kind: must be "),
        ({"materials": [{"kind": "noise", "scale": [0, 1]}]}, "shapes[0].materials[0].scale[0]: must be > 0 (got 0)"),
        ({"materials": [{"kind": "image", "images": "bad.png"}]}, "shapes[0].materials[0].images: "),
        ({"materials": [{"kind": "colour"}], "visible": False}, "shapes[0].materials: must not be given for shape"),
    ],
)
@pytest.mark.usefixtures("files_tried")
def test_invalid_environments_and_backgrounds_are_refused(
    scene_data: SceneData, write_scene: WriteScene, tmp_path: Path, changes: SceneData, sentence: str
) -> None:
    (tmp_path / "bad.png").write_bytes(b"no image at all")
    of_shape = {"materials", "visible"} & set(changes)
    if of_shape:
        scene_data["shapes"][0] |= changes
    else:
        scene_data |= changes
    with pytest.raises(InputError) as caught:
        load_scene(write_scene(scene_data))
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("files_tried")
def test_the_first_unreadable_image_of_many_is_named(
    scene_data: SceneData, write_scene: WriteScene, tmp_path: Path
) -> None:
    write_images(tmp_path, *(f"photos/{number}.png" for number in range(5)))
    whole = (tmp_path / "photos/3.png").read_bytes()
    (tmp_path / "photos/3.png").write_bytes(whole[: len(whole) // 2])
    scene_data |= {"background": {"images": "photos"}}
    with pytest.raises(InputError, match=r"background\.images: .*photos/3\.png: not a readable image"):
        load_scene(write_scene(scene_data))


def test_a_backdrop_is_a_room_around_its_interior(scene_data: SceneData, write_scene: WriteScene) -> None:
    """Walls leave the interior free, do not overlap, and share one material."""
    room = {"size": [3, 2, 2.5], "position": [0.2, 0, -0.7], "ceiling": True}
    scene_data |= {"backdrop": room, "enclosure": {}}
    scene = load_scene(write_scene(scene_data))
    made = {s.name: m for s, m in zip(scene.spec.shapes, scene.shape_meshes, strict=True) if s.name[:8] == "backdrop"}
    names = ["floor", "wall -x", "wall +x", "wall -y", "wall +y", "wall above"]
    assert list(made) == [f"backdrop {name}" for name in names]
    outer = 3.2 * 2.2 * 2.7
    assert sum(mesh.volume for mesh in made.values()) == pytest.approx(outer - 3 * 2 * 2.5)
    own = np.concatenate([mesh.vertices for mesh in made.values()]) - room["position"]
    np.testing.assert_allclose([own.min(axis=0), own.max(axis=0)], [(-1.6, -1.1, -0.1), (1.6, 1.1, 2.6)], atol=1e-9)
    inside = (np.abs(own[:, :2]) < (1.499, 0.999)).all(axis=1) & (own[:, 2] > 0.001) & (own[:, 2] < 2.499)
    assert not inside.any()
    assert [s.name for s in scene.spec.shapes if s.collider and s.visible] == ["table"]
    surroundings = draw_surroundings(scene.spec, 0)
    assert set(surroundings.materials) == {"backdrop floor", "backdrop walls"}
    shapes = {shape.name: shape for shape in scene.spec.shapes}
    walls = [surroundings.material_of(shapes[f"backdrop wall {side}"]) for side in ("+y", "-x")]
    assert walls[0] == walls[1] == surroundings.materials["backdrop walls"]
    assert [finding.text for finding in scene_warnings(scene) if not finding.ok] == []
    assert light_properties(scene)["sky_reach"] == pytest.approx(0.5)
    scene_data["backdrop"] = {"size": [0.7, 0.7, 0.9], "position": [0, 0, -0.2]}
    found = [finding.text for finding in scene_warnings(load_scene(write_scene(scene_data))) if not finding.ok]
    assert "of 12 views 12 are from behind a wall of the backdrop, which hides everything" in found
    assert "1 of 1 lights are behind a wall of the backdrop" in found
