"""Drawn appearances: ranges, seeds, and validation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.images.colour import hue_matrix, saturation_matrix
from mitsplat.physics.settle import _scene_hash
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.object_appearance import ObjectAppearance, draw_appearances
from mitsplat.scene.scene import Scene
from tests.conftest import WriteScene

RANGES = {
    "hue": [-20, 10],
    "saturation": [0.5, 1.5],
    "value": [0.5, 1.1],
    "gain": [0.8, 1.25],
    "roughness": [0.2, 0.6],
    "specular": [0.02, 0.1],
    "wear": [0, 0.5],
}


@pytest.fixture
def varied(scene_data: dict[str, Any], write_scene: WriteScene) -> Any:
    """Return a function that makes a scene with varied appearances of nuts, but not of bolts."""

    def make(ranges: Any = RANGES) -> Scene:
        scene_data["objects"] = [{"asset": "assets/nut", "count": 3, "appearance": ranges}, {"asset": "assets/bolt"}]
        return load_scene(write_scene(scene_data))

    return make


def layout(index: int, nuts: int = 3) -> Layout:
    """Return a layout of nuts, with a bolt behind them."""
    instances = [Instance(number + 1, int(number == nuts), 0, np.eye(4)) for number in range(nuts + 1)]
    return Layout(index, tuple(instances), NO_PHYSICS)


def test_appearances_are_drawn_within_their_ranges(varied: Any) -> None:
    scene = varied()
    drawn = [one for index in range(100) for one in draw_appearances(scene, layout(index)).values()]
    assert len(drawn) == 300 and {one.entry for one in drawn} == {0}
    assert [one.id for one in drawn[:3]] == [1, 2, 3]
    for name, (low, high) in RANGES.items():
        values = np.array([getattr(one, name) for one in drawn]).reshape(300, -1)
        assert low <= values.min() < low + 0.05 * (high - low) and high - 0.05 * (high - low) < values.max() <= high
        # Uniform: five standard errors of the mean; gains have three times as many values.
        assert abs(values.mean() - (low + high) / 2) < 5 * (high - low) / np.sqrt(12 * 300)
        assert len(np.unique(values)) == values.size
    assert len({one.wear_seed for one in drawn}) == 300
    columns = np.array([[one.hue, one.value, *one.gain, one.wear, one.roughness] for one in drawn])
    # The correlation of independent values is 0 +- 0.06 over 300 objects.
    assert np.abs(np.corrcoef(columns.T) - np.eye(7)).max() < 0.25


def test_seed_layout_and_id_determine_an_appearance(varied: Any) -> None:
    scene = varied()
    one = draw_appearances(scene, layout(4))
    assert one == draw_appearances(scene, layout(4))
    assert one[2] == draw_appearances(scene, layout(4, nuts=2))[2]
    assert one[2] != draw_appearances(scene, layout(5))[2]
    reseeded = replace(scene, spec=scene.spec.model_copy(update={"seed": 8}))
    assert one[2] != draw_appearances(reseeded, layout(4))[2]
    narrowed = draw_appearances(varied(RANGES | {"hue": [0, 0]}), layout(4))
    assert {k: replace(v, hue=0.0) for k, v in one.items()} == narrowed


def test_properties_without_a_range_are_unchanged(varied: Any) -> None:
    scene = varied({"wear": [0.3, 0.3]})
    one = draw_appearances(scene, layout(0))[1]
    own = scene.assets[0]
    assert (one.hue, one.saturation, one.value, one.gain) == (0, 1, 1, (1, 1, 1))
    assert (one.roughness, one.specular) == (own.roughness, own.specular)
    assert set(one.properties()) == {"roughness", "specular", "wear", "wear_seed"}


def test_drawn_properties_are_those_of_the_shape() -> None:
    one = ObjectAppearance(1, 0, 30.0, 0.5, 0.8, (1.0, 0.9, 1.2), 0.3, 0.05, 0.0, 7)
    matrix = np.array(one.properties()["colours"].split(), dtype=float).reshape(3, 3)
    colour = np.array([0.2, 0.5, 0.7])
    expected = 0.8 * np.array([1.0, 0.9, 1.2]) * (saturation_matrix(0.5) @ (hue_matrix(30) @ colour))
    np.testing.assert_allclose(matrix @ colour, expected, rtol=1e-12)
    assert "wear" not in one.properties()


def test_appearances_do_not_change_layouts(varied: Any, scene_data: Any, write_scene: WriteScene) -> None:
    """Keys of layouts settled before appearances were introduced are unchanged as well."""
    dull, worn = varied({"wear": [0, 1]}), varied()
    del scene_data["objects"][0]["appearance"]
    plain = load_scene(write_scene(scene_data))
    assert _scene_hash(dull) == _scene_hash(worn) == _scene_hash(plain)
    assert "appearance" not in repr(plain.spec.objects)
    assert "appearance" not in plain.spec.model_dump(mode="json")["objects"][0]
    assert draw_appearances(plain, layout(0)) == {}


@pytest.mark.parametrize(
    ("ranges", "sentence"),
    [
        ({"hue": [-190, 0]}, "objects[0].appearance.hue[0]: must be >= -180 (got -190)"),
        ({"saturation": [1, 3]}, "objects[0].appearance.saturation[1]: must be <= 2 (got 3)"),
        ({"value": [0, 1]}, "objects[0].appearance.value[0]: must be >= 0.1 (got 0)"),
        ({"gain": [1, 2.5]}, "objects[0].appearance.gain[1]: must be <= 2 (got 2.5)"),
        ({"roughness": [0, 1]}, "objects[0].appearance.roughness[0]: must be >= 0.02 (got 0)"),
        ({"specular": [0, 1.1]}, "objects[0].appearance.specular[1]: must be <= 1 (got 1.1)"),
        ({"wear": [0.5, 0.1]}, "objects[0].appearance.wear: must be [low, high] with low <= high (got [0.5, 0.1])"),
        ({"wear": 0.5}, "objects[0].appearance.wear: must be a list of 2 (got 0.5)"),
        ({"dirt": [0, 1]}, "objects[0].appearance.dirt: is not a known key"),
    ],
)
def test_invalid_ranges_are_refused(varied: Any, ranges: Any, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        varied(ranges)
    assert sentence in str(error.value)
