"""Drawn lights: ranges, frequency of draws, and validation."""

from __future__ import annotations

import copy
from typing import Any

import cv2
import numpy as np
import pytest

from mitsplat.checks.scene_warnings import scene_warnings
from mitsplat.dataset.inputs import describe_inputs
from mitsplat.errors import InputError
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight
from tests.conftest import WriteScene

SIDES = {
    "kind": "area",
    "target": [0.1, -0.2, 0.3],
    "draw": {
        "count": [0, 3],
        "distance": [0.5, 2.0],
        "elevation": [10, 80],
        "size": [[0.1, 0.2], [0.3, 0.4]],
        "radiance": [5, 20],
        "temperature": [2500, 10000],
        "colour": [[1, 0.5, 0.2], [0.5, 0.6, 1]],
    },
}
SKY = {"kind": "environment", "draw": {"radiance": [0.5, 2], "rotate_z": [0, 360]}}


@pytest.fixture
def lit(scene_data: dict[str, Any], write_scene: WriteScene) -> Any:
    """Return a function that makes a scene of 150 layouts of two views under the given lights."""

    def make(*lights: dict[str, Any], **keys: Any) -> Scene:
        scene_data["output"] |= {"layouts": 150, "views": 2}
        return load_scene(write_scene(scene_data | {"lights": list(lights)} | keys))

    return make


def lights_of(scene: Scene, frames: range | None = None) -> list[list[Any]]:
    return [list(plan_frame(scene, index).lights) for index in frames or range(scene.num_frames)]


def spread(values: Any, low: float, high: float) -> None:
    """Assert that values have a uniform distribution's mean within five standard errors, and its ends."""
    values = np.asarray(values)
    assert low <= values.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < values.max() <= high
    assert abs(values.mean() - (low + high) / 2) < 5 * (high - low) / np.sqrt(12 * len(values))


def test_drawn_lights_come_from_all_sides_within_their_ranges(lit: Any) -> None:
    drawn = lights_of(lit(SIDES, SKY))
    assert {len(lights) for lights in drawn} == {1, 2, 3, 4}
    areas = [light for lights in drawn[::2] for light in lights if isinstance(light, AreaLight)]
    assert len({light.position for light in areas}) == len(areas)  # each copy has its own draw
    arms = np.array([light.position for light in areas]) - SIDES["target"]
    away = np.linalg.norm(arms, axis=1)
    spread(away, 0.5, 2.0)
    spread(arms[:, 2] / away, *np.sin(np.radians([10, 80])))
    spread(np.degrees(np.arctan2(arms[:, 1], arms[:, 0])) % 360, 0, 360)
    before = lights_of(lit(SIDES | {"draw": SIDES["draw"] | {"count": 1, "azimuth": [180, 300]}}))[::2]
    arms = np.array([light.position for lights in before for light in lights]) - SIDES["target"]
    spread(np.degrees(np.arctan2(arms[:, 1], arms[:, 0])) % 360, 180, 300)
    for side in range(2):
        spread([light.size[side] for light in areas], *np.array(SIDES["draw"]["size"])[:, side])
    spread([light.radiance for light in areas], 5, 20)
    spread([1 / light.temperature for light in areas], 1 / 10000, 1 / 2500)
    shares = np.array([light.colour for light in areas]) - (1, 0.5, 0.2)
    np.testing.assert_allclose(shares, shares[:, :1] * (1, -0.2, -1.6), atol=1e-12)
    spread(shares[:, 0], -0.5, 0)
    skies = [lights[-1] for lights in drawn[::2]]
    spread([sky.radiance for sky in skies], 0.5, 2)
    spread([sky.rotate_z for sky in skies], 0, 360)
    assert all("draw" not in light.model_dump(mode="json") for lights in drawn for light in lights)


def test_lights_drawn_in_a_box_fill_each_component(lit: Any) -> None:
    box = [[-1, 2, 0.5], [1, 2.5, 0.5]]
    lamp = {"kind": "spot", "draw": {"position": box}}
    drawn = [light for (light,) in lights_of(lit(lamp))[::2]]
    spread([light.position[0] for light in drawn], -1, 1)
    spread([light.position[1] for light in drawn], 2, 2.5)
    assert {light.position[2] for light in drawn} == {0.5}
    along = np.corrcoef([light.position[0] for light in drawn], [light.position[1] for light in drawn])[0, 1]
    assert abs(along) < 0.4  # standard deviation for 150 independent pairs: 0.08


def test_lights_vary_by_layout_or_by_frame(lit: Any) -> None:
    still = lights_of(lit(SIDES, SKY), range(20))
    assert still[::2] == still[1::2]
    moving = copy.deepcopy(SIDES)
    moving["draw"] |= {"vary": "frame", "count": 1}
    drawn = lights_of(lit(moving, SKY), range(20))
    assert len({light.position for light, _ in drawn}) == 20
    assert [sky for _, sky in drawn[::2]] == [sky for _, sky in drawn[1::2]]


def test_drawing_a_light_does_not_change_other_draws(lit: Any) -> None:
    fixed = {"kind": "point", "position": [0, 0, 1], "intensity": 3}
    ranges = {"randomise": {"exposure": [-1, 1]}}
    plain, drawn = lit(fixed, fixed, **ranges), lit(fixed, SIDES | {"kind": "area"}, SKY, **ranges)
    for index in range(6):
        one, other = plan_frame(plain, index), plan_frame(drawn, index)
        assert one.lights[0] == other.lights[0]
        assert (one.draws, one.seed) == (other.draws, other.seed)
    narrowed = copy.deepcopy(SIDES)
    narrowed["draw"]["radiance"] = [5, 5]
    for one, other in zip(lights_of(lit(SIDES, SKY), range(9)), lights_of(lit(narrowed, SKY), range(9)), strict=True):
        alike = [light.model_copy(update={"radiance": 5.0}) for light in one[:-1]]
        assert [*alike, one[-1]] == other


def test_a_room_has_a_window_lamps_and_walls(lit: Any) -> None:
    scene = lit({"kind": "room", "around": [1, 0, 0.5], "size": 2})
    assert [light.kind for light in scene.spec.lights] == ["room"]  # messages and hashes use the file's own entries
    drawn = lights_of(scene)
    assert {len(lights) for lights in drawn} == {3, 4, 5}
    for window, *lamps, walls in drawn:
        assert isinstance(walls, EnvironmentLight) and 0.1 <= walls.radiance <= 0.4
        for light, low, high, widest in ((window, 12, 35, 0.9), *((lamp, 50, 85, 0.3) for lamp in lamps)):
            arm = np.subtract(light.position, (1, 0, 0.5))
            away = np.linalg.norm(arm)
            assert 0.7 <= away <= 1.2 and low <= np.degrees(np.arcsin(arm[2] / away)) <= high
            assert light.target == (1, 0, 0.5) and light.size[0] <= widest
    assert len({window.position for window, *_ in drawn}) == len(drawn) / 2


def test_skies_are_drawn_from_a_folder(lit: Any, tmp_path: Any) -> None:
    (tmp_path / "skies").mkdir()
    for name in ("a.png", "b.png", "c.png"):
        cv2.imwrite(str(tmp_path / "skies" / name), np.full((4, 8, 3), 90, dtype=np.uint8))
    (tmp_path / "skies/notes.txt").write_text("no image")
    moving = {**SKY, "pool": "skies/*", "draw": {"rotate_z": [0, 360], "vary": "frame"}}
    scene = lit(moving)
    assert scene.spec.lights[0].pool == ("skies/a.png", "skies/b.png", "skies/c.png")
    assert set(scene.images) == set(scene.spec.lights[0].pool)
    assert {f"lights[0].pool[{i}]" for i in range(3)} <= set(describe_inputs(scene))
    drawn = [sky for (sky,) in lights_of(scene)]
    images = [sky.image for sky in drawn]
    assert images[::2] == images[1::2]  # one image per layout
    assert len({sky.rotate_z for sky in drawn}) == 300
    # Of 150 draws, 50 are expected for each, with a standard deviation of 6.
    assert abs(images[::2].count("skies/b.png") - 50) < 25 and set(images) == set(scene.images)
    assert "pool" not in drawn[0].model_dump(mode="json")


def test_lights_that_may_be_inside_of_a_shape_get_a_warning(lit: Any) -> None:
    block = {"name": "block", "box": {"size": [1, 1, 1], "position": [0, 0, 5]}, "visible": True}
    table = {"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}}
    lamp = {"kind": "point", "draw": {"position": [[-0.4, -0.4, 4.6], [0.4, 0.4, 7]]}}
    found = [finding.text for finding in scene_warnings(lit(lamp, shapes=[table, block])) if finding.name == "lights"]
    assert len(found) == 1 and "drawn lights lie inside a shape, such as 'block'" in found[0]
    hall = block | {"box": {"size": [9, 9, 9], "position": [0, 0, 5]}}
    room = {"kind": "room", "around": [0, 0, 5]}
    found = [finding.text for finding in scene_warnings(lit(room, shapes=[table, hall])) if finding.name == "lights"]
    assert len(found) == 1 and "drawn lights lie inside a shape, such as 'block'" in found[0]


@pytest.mark.parametrize(
    ("light", "sentence"),
    [
        ({"kind": "area"}, "lights[0].position: is required"),
        ({"kind": "area", "draw": {"radiance": [1, 2]}}, "lights[0].position: is required"),
        (
            {"kind": "point", "draw": {"distance": [1, 2], "size": [[1, 1], [2, 2]]}},
            "lights[0].draw.size: is not a key of lights of kind point",
        ),
        (
            {"kind": "environment", "draw": {"count": 2}},
            "lights[0].draw.count: is not a key of lights of kind environment",
        ),
        ({"kind": "environment", "draw": {"distance": [1, 2]}}, "lights[0].draw.distance: is not a key of lights of"),
        (
            {"kind": "area", "draw": {"distance": [1, 2], "position": [[0, 0, 1], [0, 0, 2]]}},
            "lights[0].draw.distance: must not be given together with position",
        ),
        (
            {"kind": "area", "position": [0, 0, 1], "draw": {"elevation": [0, 90]}},
            "lights[0].draw.elevation: needs a distance",
        ),
        (
            {"kind": "area", "position": [0, 0, 1], "draw": {"azimuth": [0, 90]}},
            "lights[0].draw.azimuth: needs a distance",
        ),
        ({"kind": "area", "draw": {"distance": [0, 2]}}, "lights[0].draw.distance[0]: must be > 0 (got 0)"),
        (
            {"kind": "area", "draw": {"distance": [1, 2], "elevation": [0, 91]}},
            "lights[0].draw.elevation[1]: must be <= 90 (got 91)",
        ),
        (
            {"kind": "area", "draw": {"position": [[0, 0, 1], [0, -1, 2]]}},
            "lights[0].draw.position: must be [low, high] with low <= high in each component (got [[0.0, 0.0, 1.0], ",
        ),
        ({"kind": "area", "draw": {"position": [[0, 0, 1]]}}, "lights[0].draw.position: must have 2 items (got 1)"),
        (
            {"kind": "area", "draw": {"distance": [1, 2], "colour": [[1, 1, 1], [0, 0, 0]]}},
            "lights[0].draw.colour[1]: must not be black",
        ),
        (
            {"kind": "point", "draw": {"distance": [1, 2]}, "path": [{"position": [0, 0, 2]}]},
            "lights[0].draw: must not be given together with a path",
        ),
        (
            {"kind": "point", "draw": {"distance": [1, 2], "count": [0, 2]}},
            "lights[0].draw.count: must be at least 1 if no other light is in every frame (got 0)",
        ),
        ({"kind": "point", "draw": {"distance": [1, 2], "vary": "view"}}, "lights[0].draw.vary: must be 'layout' or"),
        ({"kind": "area", "draw": {"distance": [1, 2], "dist": 3}}, "lights[0].draw.dist: is not a known key (did you"),
        ({"kind": "environment", "pool": []}, "lights[0].pool: must name at least one image (got [])"),
        (
            {"kind": "environment", "pool": "no/*"},
            "lights[0].pool: must name at least one image (got 'no/*', which matches none",
        ),
        ({"kind": "environment", "pool": ["a.exr"], "image": "b.exr"}, "lights[0].pool: must not be given together"),
        (
            {"kind": "environment", "image": "b.exr", "colour": [1, 0.2, 0.2]},
            "lights[0].colour: must not be given together with an image, which has the colours",
        ),
        (
            {"kind": "environment", "pool": ["b.exr"], "draw": {"colour": [[1, 1, 1], [1, 0.5, 0.5]]}},
            "lights[0].draw.colour: must not be given together with an image, which has the colours",
        ),
        ({"kind": "environment", "pool": ["/etc/a.exr"]}, "lights[0].pool[0]: must be inside the scene's folder"),
        ({"kind": "environment", "pool": "../*.png"}, "lights[0].pool: must be inside the scene's folder"),
        ({"kind": "room", "size": 0}, "lights[0].size: must be > 0 (got 0)"),
    ],
)
def test_invalid_lights_are_refused(scene_data: Any, write_scene: WriteScene, light: Any, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        load_scene(write_scene(scene_data | {"lights": [light]}))
    assert sentence in str(error.value) and "\n" not in str(error.value)


def test_a_second_sky_beside_a_room_is_refused(scene_data: Any, write_scene: WriteScene) -> None:
    lights = [{"kind": "environment"}, {"kind": "room"}]
    with pytest.raises(InputError, match=r"lights\[1\]\.kind: must not be a second environment light"):
        load_scene(write_scene(scene_data | {"lights": lights}))


@pytest.mark.usefixtures("files_tried")
def test_the_first_unreadable_image_of_a_pool_is_named(scene_data: Any, write_scene: WriteScene, tmp_path: Any) -> None:
    for name in ("a.png", "c.png"):
        cv2.imwrite(str(tmp_path / name), np.full((4, 8, 3), 90, dtype=np.uint8))
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:40])
    (tmp_path / "d.png").write_bytes(b"no image")
    scene_data["lights"] = [{"kind": "environment", "pool": "*.png"}]
    with pytest.raises(InputError, match=r"lights\[0\]\.pool\[1\]: .*b\.png: not a readable image \("):
        load_scene(write_scene(scene_data))
