"""Layouts on slopes and of bodies that hardly lose energy: which objects stay, and which are left out."""

from __future__ import annotations

import numpy as np
import pytest

from mitsplat.physics.settle import settle_layout
from mitsplat.scene.layout import UnsettledLayoutError
from mitsplat.scene.loading.scene_loading import load_scene
from tests.bodies import STEPPERS
from tests.conftest import box_asset

pytestmark = pytest.mark.usefixtures("physics")

FRICTION = 0.5
"""Friction coefficient of the parts."""


@pytest.fixture
def slope_scene(scene_data, write_scene, tmp_path):
    """Return a function that loads a scene of four flat parts above a slope [degrees] of a friction coefficient."""

    def load(stepper, degrees, friction):
        box_asset("tile", (0.04, 0.03, 0.006)).save(tmp_path / "assets/tile")
        scene_data["shapes"] = [
            {"name": "ramp", "box": {"size": [1.0, 1.0, 0.1], "rotate": [0, degrees, 0]}, "friction": friction}
        ]
        scene_data["objects"] = [{"asset": "assets/tile", "count": 4}]
        angle = np.radians(degrees)
        height = float(0.05 / np.cos(angle) + 0.1 * np.tan(angle))
        scene_data["region"] = {"min": [-0.1, -0.2, height + 0.02], "max": [0.1, 0.2, height + 0.1]}
        scene_data["settle"] = {"stepper": stepper, "attempts": 2, "max_time": 4.0}
        return load_scene(write_scene(scene_data))

    return load


@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("degrees", [20, 40])
@pytest.mark.parametrize("share", [0.85, 1.15])
def test_parts_stay_on_slopes_below_the_angle_of_friction_only(stepper, degrees, share, slope_scene):
    """Parts stay if tan a < mu, the geometric mean of both coefficients, and are left out beyond it."""
    mu = np.tan(np.radians(degrees)) / share
    scene = slope_scene(stepper, degrees, float(mu**2 / FRICTION))
    if share > 1:
        with pytest.raises(UnsettledLayoutError) as error:
            settle_layout(scene, 0, cached=False)
        assert len(error.value.layout.left_out) == 4
        return
    layout = settle_layout(scene, 0, cached=False)
    assert layout.left_out == ()
    normal = np.array([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])
    for one in layout.instances:
        assert abs(one.world_from_object[:3, 2] @ normal) == pytest.approx(1.0, abs=1e-3)
        assert one.world_from_object[:3, 3] @ normal == pytest.approx(0.053, abs=1e-4)
