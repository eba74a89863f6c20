"""Lamps that a wall of the surroundings hides from the objects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import trimesh

from mitsplat.checks.lamp_check import check_lamps
from mitsplat.findings import Finding
from mitsplat.scene.loading.scene_loading import load_scene
from tests.conftest import WriteScene, box_asset

WALL = trimesh.creation.box((8, 0.1, 8), transform=trimesh.transformations.translation_matrix((0, 0.6, 0)))
"""A wall behind the objects, at y from 0.55 to 0.65 m."""

ROUND: dict[str, Any] = {"kind": "area", "draw": {"distance": [4, 4], "elevation": [10, 20]}}
"""Lamps on all sides; those of azimuths from 9 to 171 degrees are behind the wall, 45 % of all."""

PATH = {"kind": "point", "position": [0, 0.3, 0.5], "path": [{"position": [0, -1, 0.5]}, {"position": [0, 2, 0.5]}]}
"""A lamp that moves through the wall, behind which it is for half of its path."""


@pytest.mark.parametrize(
    ("light", "hidden"),
    [
        (ROUND, True),
        ({"kind": "area", "draw": ROUND["draw"] | {"azimuth": [180, 360]}}, False),
        ({"kind": "point", "position": [0, 1, 0.5]}, True),
        ({"kind": "point", "position": [0, -1, 0.5]}, False),
        (PATH, True),
    ],
    ids=["all sides", "front", "behind", "before", "path through the wall"],
)
def test_lamps_behind_a_wall_are_reported(
    scene_data: dict[str, Any], write_scene: WriteScene, light: dict[str, Any], hidden: bool
) -> None:
    scene = load_scene(write_scene(scene_data | {"lights": [{"kind": "environment"}, light]}))
    assert not list(check_lamps(scene))  # there are no surroundings
    (finding,) = list(check_lamps(replace(scene, environments=(replace(box_asset("room"), mesh=WALL),)))) or (None,)
    assert (finding is not None) == hidden
    if finding is not None:
        assert not finding.ok and finding.text.startswith("lights[1]: the environment hides ")


def test_a_room_counts_as_the_entry_that_it_is_in_the_file(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    def findings(*lights: dict[str, Any]) -> list[Finding]:
        scene = load_scene(write_scene(scene_data | {"lights": list(lights)}))
        return list(check_lamps(replace(scene, environments=(replace(box_asset("room"), mesh=WALL),))))

    small, large = {"kind": "room", "size": 0.6}, {"kind": "room", "size": 6}
    (behind,) = findings(small, {"kind": "point", "position": [0, 1, 0.5]})
    assert behind.text.startswith("lights[1]: the environment hides 100% ") and "draw.azimuth" in behind.remedy
    (room,) = findings(large)
    assert room.text.startswith("lights[0]: the environment hides ") and room.remedy.startswith("choose a smaller size")


BELOW = {"kind": "point", "position": [0.3, 0, -0.5]}
"""A lamp below the table, which hides it from the whole region."""


@pytest.mark.parametrize(
    ("light", "table", "text"),
    [
        (BELOW, {}, "lights[0]: shapes hide this lamp from all objects"),
        (BELOW, {"visible": False}, None),  # such a shape casts no shadow
        (BELOW, {"share": 0.5}, None),
        ({"kind": "point", "position": [0.3, 0, 0.01]}, {}, None),
        (
            {"kind": "point", "draw": {"distance": [1, 1], "elevation": [-80, -60]}},
            {},
            "lights[0]: shapes hide 100% of these lamps from all objects",
        ),
        ({"kind": "point", "draw": {"distance": [1, 1], "elevation": [-5, 60]}}, {}, None),
        (
            {"kind": "area", "position": [0, 0, 0.5], "target": [0, 0, 1]},
            {},
            "lights[0]: this lamp faces away from all objects",
        ),
        ({"kind": "area", "position": [0.3, 0, 0.5], "target": [1, 0, 0.5]}, {}, "lights[0]: this lamp faces away"),
        ({"kind": "area", "position": [0, 0, 0.5], "target": [1, 0, 0.1]}, {}, None),
        ({"kind": "spot", "position": [1, 0, 1], "target": [2, 0, 1]}, {}, "lights[0]: this lamp faces away"),
        # The bottom edge of the region is at least 54 degrees off the axis: tan = 0.8 / 0.58.
        ({"kind": "spot", "position": [1, 0, 0.6], "target": [1, 0, 0], "cone": 50}, {}, "lights[0]: this lamp faces"),
        ({"kind": "spot", "position": [1, 0, 0.6], "target": [1, 0, 0], "cone": 70}, {}, None),
        ({"kind": "spot", "position": [1, 0, 1], "target": [0.013, 0.017, 0.11], "cone": 0.1}, {}, None),
    ],
)
def test_lamps_that_light_no_object_are_reported(
    scene_data: dict[str, Any], write_scene: WriteScene, light: dict[str, Any], table: dict[str, Any], text: str | None
) -> None:
    scene_data["shapes"][0] |= table
    scene = load_scene(write_scene(scene_data | {"lights": [light, {"kind": "environment"}]}))
    (finding,) = list(check_lamps(scene)) or (None,)
    assert (finding is None) == (text is None), finding
    if finding is not None and text is not None:
        assert not finding.ok and finding.text.startswith(text)


def test_a_lamp_inside_a_bin_lights_it(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    """The bin hides the lamp from all places beside it, but not from the bottom of the region."""
    scene_data["shapes"].append({"name": "bin", "visible": True, "bin": {"size": [0.1, 0.1, 0.3]}})
    scene = load_scene(write_scene(scene_data | {"lights": [{"kind": "point", "position": [0, 0, 0.25]}]}))
    assert not list(check_lamps(scene))
