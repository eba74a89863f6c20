"""Radiometric pictures, exposure and white balance of frames, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mitsplat as ms
from mitsplat.frames.camera_response import GREY
from mitsplat.frames.light_properties import capture_irradiance, light_properties, white_irradiance
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.layers import make_integrator
from tests.conftest import WriteScene, box_asset

ORANGE = [1.0, 0.6, 0.2]


@pytest.fixture
def table_data(scene_data: dict[str, Any]) -> dict[str, Any]:
    """Return a scene of a white table without objects, seen from above."""
    scene_data["shapes"][0]["colour"] = [1, 1, 1]
    camera = {"kind": "orbit", "target": [0, 0, 0], "radius": 0.01, "height": 1.0, "intrinsics": {"fov_x": 5}}
    return scene_data | {"objects": [], "camera": camera, "composite": {"exposure": "fixed"}}


@pytest.mark.parametrize("radiance", [0.15, 15.0, 60.0])
def test_a_white_table_has_the_radiance_of_its_irradiance(
    table_data: dict[str, Any], write_scene: WriteScene, radiance: float
) -> None:
    """A Lambertian surface of albedo 1 has radiance E / pi.

    E = pi L below a uniform sky. Below a square lamp of half side a at height h, E = 4 L s atan(s) with
    s = a / sqrt(a^2 + h^2).
    """
    sky = {"kind": "environment", "radiance": radiance, "colour": ORANGE}
    lamp = {"kind": "area", "position": [0, 0, 2], "target": [0, 0, 0], "size": [0.4, 0.4], "radiance": radiance}
    s = 0.2 / np.hypot(0.2, 2.0)
    for light, expected in ((sky, radiance * np.array(ORANGE)), (lamp, 4 * radiance * s * np.arctan(s) / np.pi)):
        frame = ms.render_frame(ms.load_scene(write_scene(table_data | {"lights": [light]})), 0)
        np.testing.assert_allclose(frame.rgb[20:28, 28:36].mean(axis=(0, 1)), expected, rtol=0.005)


@pytest.mark.parametrize(("composite", "neutral"), [({}, False), ({"white_balance": "auto"}, True)])
def test_metering_removes_the_brightness_of_a_lamp_and_white_balance_its_colour(
    table_data: dict[str, Any], write_scene: WriteScene, composite: dict[str, Any], neutral: bool
) -> None:
    images = []
    for radiance in (1e-5, 1e5):
        lights = [{"kind": "environment", "radiance": radiance, "colour": ORANGE}]
        scene = ms.load_scene(write_scene(table_data | {"lights": lights, "composite": composite}))
        images.append(ms.render_frame(scene, 0).image.astype(int))
    assert np.abs(images[1] - images[0]).max() <= 1
    red, green, blue = images[0].mean(axis=(0, 1))
    if neutral:
        assert (red, green, blue) == pytest.approx((GREY,) * 3, abs=1)
        assert np.ptp([red, green, blue]) <= 1
    else:
        assert red > 1.2 * green > 1.4 * blue


def test_pictures_and_rays_under_automatic_exposure_do_not_depend_on_the_light_level(
    table_data: dict[str, Any], write_scene: WriteScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The wanted numbers of shadow and reflection rays of two metal boxes are those of other lamps."""
    make_integrator()
    from mitsplat.renderer.light.light_filter import LightFilter

    wanted: list[Any] = []
    rays_for, reflections_for = LightFilter.rays_for, LightFilter.reflections_for

    def spy_rays_for(self: LightFilter, *args: Any) -> Any:
        rays, exposure = rays_for(self, *args)
        wanted.append(np.array(rays))
        return rays, exposure

    def spy_reflections_for(self: LightFilter, *args: Any) -> Any:
        rays = reflections_for(self, *args)
        wanted.append(np.array(rays))
        return rays

    monkeypatch.setattr(LightFilter, "rays_for", spy_rays_for)
    monkeypatch.setattr(LightFilter, "reflections_for", spy_reflections_for)
    camera = {"kind": "orbit", "target": [0, 0, 0.015], "radius": 0.3, "height": 0.25, "intrinsics": {"fov_x": 15}}
    table_data |= {"objects": [{"asset": "assets/metal"}], "composite": {}, "camera": camera}
    metal, images, numbers = box_asset("metal", (0.03, 0.03, 0.03)), [], []
    splats = metal.splats.with_material(metallic=1.0, roughness=0.4, specular=0.5)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[-0.017, 0, 0.016], [0.017, 0, 0.016]]
    for radiance in (1e-4, 1e5):
        table_data["lights"] = [{"kind": "area", "position": [0.4, 0, 0.5], "radiance": radiance}]
        path = write_scene(table_data)
        replace(metal, splats=splats).save(path.parent / "assets/metal")
        scene = ms.load_scene(path)
        images.append(ms.render_frame(scene, 0, layout=ms.Layout.from_poses(scene, {0: list(poses)})).image.astype(int))
        numbers.append(wanted.copy())
        wanted.clear()
    assert len(numbers[0]) == 3 and all(rays.max() > 1 for rays in numbers[0])
    for some, others in zip(*numbers, strict=True):
        np.testing.assert_allclose(some, others, rtol=0.02, atol=0.02)
    assert np.abs(images[1] - images[0]).max() <= 2


@pytest.mark.parametrize("shadow", ["traced", "image", "none"])
def test_pictures_of_all_shadow_modes_are_metered(
    table_data: dict[str, Any], write_scene: WriteScene, shadow: str
) -> None:
    table_data["lights"] = [{"kind": "area", "position": [0.5, 0, 1], "radiance": 40.0}]
    table_data["shapes"][0]["colour"] = [0.3, 0.3, 0.3]
    scene = ms.load_scene(write_scene(table_data | {"composite": {"shadow": shadow}}))
    assert ms.render_frame(scene, 0).image.mean() == pytest.approx(GREY, abs=4)


def environment_data(scene_data: dict[str, Any], lights: list[dict[str, Any]]) -> dict[str, Any]:
    return scene_data | {"environment": "assets/room", "lights": lights}


def save_environment(write_scene: WriteScene, data: dict[str, Any], **values: Any) -> ms.Scene:
    """Save an environment with changed attributes beside the scene, and load the scene."""
    path = write_scene(data)
    room = replace(box_asset("room", (1.0, 1.0, 0.1)), kind="environment", **values)
    room.save(path.parent / "assets/room")
    return ms.load_scene(path)


LAMP = {"kind": "environment", "radiance": 2.0, "colour": ORANGE}


def test_only_captures_without_white_are_calibrated_by_the_lights(
    scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    """The irradiance of a sky of radiance L is pi L."""
    data = environment_data(scene_data, [LAMP])
    captured = save_environment(write_scene, data, capture_light="scene")
    expected = 2 * np.pi * np.array(ORANGE)
    np.testing.assert_allclose(white_irradiance(captured, 0), expected, rtol=1e-3)
    np.testing.assert_allclose(light_properties(captured)["white"]["value"], expected, rtol=1e-3)
    for values, white in (({"capture_light": "scene", "white": 2.0}, 2.0), ({"capture_light": "uniform"}, np.pi)):
        assert white_irradiance(save_environment(write_scene, data, **values), 0) == (white,) * 3
    assert white_irradiance(ms.load_scene(write_scene(scene_data | {"lights": [LAMP]})), 0) == (np.pi,) * 3


def test_the_calibration_is_one_mean_over_the_draws_of_a_scene(
    scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    """Radiance is uniform from 1 to 3, so that the mean over 16 draws is 2 with a standard error of 0.14."""
    drawn = LAMP | {"draw": {"radiance": [1.0, 3.0], "vary": "frame"}}
    values = []
    for layouts in (1, 9):
        scene_data["output"]["layouts"] = layouts
        scene = save_environment(write_scene, environment_data(scene_data, [drawn]), capture_light="scene")
        values.append([white_irradiance(scene, layout) for layout in (0, layouts - 1)])
    assert len({white for pair in values for white in pair}) == 1
    assert values[0][0][0] / np.pi == pytest.approx(2.0, abs=0.45)
    assert values[0][0][0] / np.pi != pytest.approx(2.0, abs=1e-6)


def test_a_path_is_calibrated_over_its_length(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    """A point light of intensity I at height h above the point gives I / h^2; the mean over h from 1 to 2 is I / 2."""
    path = [{"position": [0, 0, 1.02]}, {"position": [0, 0, 2.02]}]
    lamp = {"kind": "point", "position": [0, 0, 1.02], "intensity": 3.0, "path": path}
    scene = save_environment(write_scene, environment_data(scene_data, [lamp]), capture_light="scene")
    assert capture_irradiance(scene)[1] == pytest.approx(1.5, rel=2e-3)


def test_two_coloured_lamps_on_a_white_table_look_as_path_traced() -> None:
    """The display-encoded picture, with a shadow of each lamp, differs from Mitsuba's path tracer by less than 0.01."""
    make_integrator()
    pose = mi.ScalarTransform4f()

    def lamp(origin: list[float], colour: list[float]) -> dict[str, Any]:
        to_world = pose.look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0]).scale(0.15)
        return {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": rgb(colour)}}

    def rgb(value: Any) -> dict[str, Any]:
        return {"type": "rgb", "value": value}

    description: dict[str, Any] = {
        "type": "scene",
        "table": {"type": "rectangle", "to_world": pose.scale(4), "bsdf": {"type": "diffuse", "reflectance": rgb(0.8)}},
        "warm": lamp([0.8, 0.3, 0.9], [14.0, 5.0, 1.0]),
        "cold": lamp([-0.7, -0.2, 1.0], [2.0, 5.0, 16.0]),
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": pose.look_at(origin=[0, 0, 1], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 64, "height": 48, "rfilter": {"type": "box"}},
        },
    }
    # The camera does not see these blocks, half-way between the lamps and the table.
    black = {"type": "diffuse", "reflectance": rgb(0.0)}
    for number, centre in enumerate(([0.4, 0.15, 0.45], [-0.35, -0.1, 0.5])):
        to_world = pose.translate(centre).scale([0.06, 0.06, 0.01])
        description[f"block_{number}"] = {"type": "cube", "to_world": to_world, "bsdf": black}
    scene = mi.load_dict(description)
    integrators = mi.load_dict({"type": "path"}), make_integrator(shadow_error=0)
    expected, seen = (
        np.clip(encode_srgb(np.array(mi.render(scene, integrator=integrator, spp=512))[..., :3]), 0, 1)
        for integrator in integrators
    )
    assert np.ptp(expected, axis=(0, 1)).min() > 0.15
    assert np.sqrt(np.mean((seen - expected) ** 2)) < 0.01


def test_a_frame_under_many_lamps_is_the_same_whenever_it_is_rendered(
    scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    """Mitsuba lists the emitters of a scene in arbitrary order if it loads them from one dictionary."""
    lamps = [
        {"kind": "area", "position": [0.3 * i - 1, 0.7 - 0.2 * i, 1], "target": [0, 0, 0], "radiance": 3 + i}
        for i in range(6)
    ]
    scene = ms.load_scene(write_scene(scene_data | {"lights": lamps}))
    assert len({capture_irradiance(scene) for _ in range(12)}) == 1
    layout = ms.Layout.from_poses(scene, {asset.name: [None] * 4 for asset in scene.assets})
    pictures = set()
    for _ in range(4):
        with ms.Renderer(scene) as renderer:
            pictures |= {renderer.render(0, layout=layout).rgb.tobytes() for _ in range(2)}
    assert len(pictures) == 1
