"""Light reflected by surroundings and visible meshes onto objects: closed forms and noise."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from tests.renderer.test_light import WHITE_SKY, down_camera, floor, noise_free, nothing, slab

RED = np.array([0.8, 0.2, 0.1])


def captured_wall() -> Any:
    wall = trimesh.creation.box(bounds=[[0.3, -500, -500], [0.4, 500, 500]])
    encoded = 1.055 * RED ** (1 / 2.4) - 0.055
    sheet = floor(2.0)
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)) @ trimesh.transformations.translation_matrix(
        (0, 0, 0.3)
    )
    painted = Splats(
        sheet.means, sheet.quats, sheet.scales, sheet.opacities, np.tile((encoded - 0.5) / SH_C0, (1600, 1, 1))
    ).transformed(turn)
    return make_splats_shape(painted, proxy=wall)


def visible_wall() -> Any:
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0.3, 0, 0]).rotate([0, 1, 0], -90).scale(500),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": RED.tolist()}},
    }


@pytest.mark.parametrize("wall", [captured_wall, visible_wall])
def test_a_red_wall_reflects_half_of_its_colour(wall: Any) -> None:
    """A red wall hides half of a uniform sky: E_bounce over the white irradiance is half the wall's colour.

    A captured wall emits its captured colour; a mesh reflects the other half of the sky.
    """
    make_integrator()
    shapes = {
        "wall": wall(),
        "object": make_splats_shape(floor(0.02), proxy=slab(0.02), instance=1, capture_light="uniform"),
        "sky": WHITE_SKY,
    }
    camera = down_camera(0.2, 32, 6.0)
    with_bounce, without = (noise_free(shapes, camera, white=np.pi, bounce=b).light for b in (True, False))
    added = (with_bounce - without).mean(axis=(0, 1))
    np.testing.assert_allclose(added / RED, 0.5, atol=0.03)
    np.testing.assert_allclose(without, 0.5, atol=0.03)


def test_a_bright_spot_leaves_no_patches_on_a_mesh() -> None:
    """Few rays from a table hit the bright spot of a lamp on the ceiling."""
    make_integrator()
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    table = mi.ScalarTransform4f().scale(2)
    ceiling = mi.ScalarTransform4f().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(4)
    shapes = {
        "table": {"type": "rectangle", "to_world": table, "bsdf": grey},
        "ceiling": {"type": "rectangle", "to_world": ceiling, "bsdf": grey},
        "lamp": {"type": "point", "position": [0.3, 0.2, 0.5], "intensity": {"type": "rgb", "value": 1.0}},
        "thing": make_splats_shape(nothing(), proxy=slab(0.01, top=-5), instance=1),
    }
    camera = down_camera(0.9, 96, 60.0)
    with_bounce, without = (
        [
            render_layers(make_integrator(bounce=bounce), mi.load_dict({"type": "scene", **shapes}), camera, seed=seed)
            for seed in (1, 2)
        ]
        for bounce in (True, False)
    )
    reflected = [(lit.light - direct.light).mean(axis=-1) for lit, direct in zip(with_bounce, without, strict=True)]
    assert np.mean(reflected) > 0.1
    assert np.std(reflected[0] / reflected[1]) < 0.05
