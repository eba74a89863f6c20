"""Visible meshes beside splats: Mitsuba materials, mirror and glass images, and visible emitters."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.layers import Layers, make_integrator, make_sensor, make_splats_shape, render_layers
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_light import WHITE_SKY, down_camera, floor, nothing, slab

SEEDS = 4
SAMPLES = 64

MATERIALS = {
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}},
    "roughconductor": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "conductor": {"type": "conductor", "material": "Cu"},
    "plastic": {"type": "plastic"},
    "principled": {"type": "principled", "metallic": 0.5, "roughness": 0.3},
    "dielectric": {"type": "dielectric"},
}


def scene_of(material: str, light: str, *, ground: bool = False) -> Any:
    ensure_variant()
    transform = mi.ScalarTransform4f()
    waves = np.random.default_rng(0).random((16, 32, 3)).astype(np.float32) ** 4 * 3
    lights = {
        "constant": WHITE_SKY,
        "point": {"type": "point", "position": [1, -2, 3], "intensity": 20.0},
        "area": {
            "type": "rectangle",
            "to_world": transform.look_at(origin=[1, -2, 3], target=[0, 0, 0], up=[0, 0, 1]).scale(0.5),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
        },
        "envmap": {"type": "envmap", "bitmap": mi.Bitmap(waves)},
    }
    plane = {"type": "rectangle", "to_world": transform.translate([0, 0, -1]).scale(4), "bsdf": MATERIALS["diffuse"]}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 34,
                "to_world": transform.look_at(origin=[0, -4, 2], target=[0, 0, 0], up=[0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 40, "height": 36, "rfilter": {"type": "box"}},
            },
            "ball": {"type": "sphere", "bsdf": MATERIALS[material]},
            "light": lights[light],
            **({"ground": plane} if ground else {}),
        }
    )


@lru_cache
def physical(samples: int) -> Any:
    """Return an integrator whose image is radiance."""
    return make_integrator(white=float(np.pi), mesh_samples=samples, max_depth=6, shadow_error=0, shadow_samples=256)


def pictures(scene: Any, integrator: Any, seeds: int, **options: Any) -> np.ndarray:
    """Render linear images (seeds, H, W, 3)."""
    sensor = scene.sensors()[0]
    return np.array(
        [np.array(integrator.render(scene, sensor, seed=seed, **options))[..., :3] for seed in range(seeds)]
    )


def ball_pixels() -> np.ndarray:
    """Return the pixels (H, W) that show only the ball."""
    scene = scene_of("diffuse", "constant")
    depth = np.array(physical(1).render(scene, scene.sensors()[0]))[..., 7]
    ball = depth > 0
    return np.logical_and.reduce([np.roll(ball, shift, axis) for shift in (-2, -1, 0, 1, 2) for axis in (0, 1)])


def compare(scene: Any, depth: int) -> tuple[float, float, float, float]:
    """Return means over the ball of our and Mitsuba's path-traced images, their RMSE, and the RMSE of noise alone."""
    inside = ball_pixels()
    path = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100})
    ours = pictures(scene, physical(SAMPLES), SEEDS)[:, inside]
    theirs = pictures(scene, path, SEEDS, spp=SAMPLES)[:, inside]
    noise = (ours.var(axis=0, ddof=1).mean() + theirs.var(axis=0, ddof=1).mean()) / SEEDS
    error = np.square(ours.mean(axis=0) - theirs.mean(axis=0)).mean()
    return float(ours.mean()), float(theirs.mean()), float(np.sqrt(error)), float(np.sqrt(noise))


QUICK = {"diffuse": "area", "roughconductor": "envmap", "plastic": "constant", "principled": "point"}
"""The light under which the quick tests compare each material."""


@pytest.mark.parametrize(
    ("material", "light"),
    [
        pytest.param(material, light, marks=() if light == quick else pytest.mark.extended)
        for material, quick in QUICK.items()
        for light in ("constant", "point", "area", "envmap")
    ],
)
def test_materials_equal_those_traced_by_mitsuba(material: str, light: str) -> None:
    """The variance of the difference of two unbiased images is the sum of both: 256 paths per pixel each."""
    ours, theirs, rmse, noise = compare(scene_of(material, light), 2 if material == "diffuse" else 6)
    assert theirs > 0.03
    assert ours == pytest.approx(theirs, rel=0.01)
    # 10 % above the noise; the constant covers colours that change within a pixel, and the light filter.
    assert rmse < 1.1 * noise + 0.003


@pytest.mark.parametrize(
    "material",
    ["dielectric", *(pytest.param(name, marks=pytest.mark.extended) for name in ("conductor", "plastic"))],
)
def test_paths_between_meshes_are_followed(material: str) -> None:
    ours, theirs, rmse, noise = compare(scene_of(material, "envmap", ground=True), 6)
    assert ours == pytest.approx(theirs, rel=0.01)
    assert rmse < 1.1 * noise + 0.003


def test_without_light_metal_is_black_and_diffuse_meshes_have_their_own_colour() -> None:
    ensure_variant()
    for material, expected in (("roughconductor", 0.0), ("diffuse", 0.7)):
        scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 0.2, "bsdf": MATERIALS[material]}})
        seen = render_layers(make_integrator(), scene, down_camera())
        assert seen.rgb[16, 16, 0] == pytest.approx(expected, abs=1e-5)


def mirror(z: float = 0.0) -> dict[str, Any]:
    """Return a perfect mirror that faces up."""
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, z]).scale(0.5),
        "bsdf": {"type": "conductor", "material": "none"},
    }


def stripes(z: float) -> Splats:
    """Return a plane of Gaussians at height z, bright where x > 0.15 and dark elsewhere."""
    plane = floor(1.0, 0.0, z)
    grey = np.where(plane.means[:, 0] > 0.15, 0.8, 0.3)
    return Splats(
        plane.means,
        plane.quats,
        plane.scales,
        plane.opacities,
        np.repeat(((grey - 0.5) / SH_C0)[:, None, None], 3, axis=2),
    )


def test_a_mirror_reflects_the_splats_above_it() -> None:
    ensure_variant()
    shapes = {"mirror": mirror(), "ceiling": make_splats_shape(stripes(1.5))}
    scene = mi.load_dict({"type": "scene", **shapes, "sky": WHITE_SKY})
    seen = render_layers(make_integrator(mesh_samples=32), scene, down_camera())
    low, high = ((0.3 + 0.055) / 1.055) ** 2.4, ((0.8 + 0.055) / 1.055) ** 2.4
    assert seen.rgb[4:28, 2:14].mean() == pytest.approx(low, rel=0.05)
    # The mirrored edge is at 0.15 / 2.5 of the distance to the ceiling's image: pixel 16 + 0.06 / 0.011 = 21.4.
    assert seen.rgb[4:28, 26:30].mean() == pytest.approx(high, rel=0.05)
    assert np.abs(seen.rgb[16, 18] - low).max() < 0.1 and np.abs(seen.rgb[16, 25] - high).max() < 0.1
    # Labels are those of the mirror, not of its image.
    np.testing.assert_allclose(seen.depth, 1.0, atol=1e-6)
    np.testing.assert_allclose(seen.normal, np.broadcast_to([0, 0, 1], seen.normal.shape), atol=1e-6)


def test_uniform_splats_are_relit_in_a_mirror() -> None:
    """Splats captured in uniform light are relit by the scene's lights when seen in a mirror."""
    ensure_variant()
    below, above = (make_splats_shape(floor(1.0, 0.6, 1.5), instance=i, proxy=None) for i in (0, 1))
    lamp = {"type": "point", "position": [0, 0, -1.0], "intensity": 4.0}
    got = {}
    for name, splats in (("scene", below), ("uniform", above)):
        scene = mi.load_dict({"type": "scene", "mirror": mirror(0.0), "splats": splats, "lamp": lamp})
        seen = render_layers(make_integrator(mesh_samples=16, white=2.0), scene, down_camera())
        got[name] = float(seen.rgb[12:20, 12:20].mean())
    # The mirror occludes the lamp for splats above it.
    assert got["scene"] == pytest.approx(((0.6 + 0.055) / 1.055) ** 2.4, rel=0.02)
    assert got["uniform"] == 0
    lamp = {"type": "point", "position": [0, 0, 0.5], "intensity": 4.0}
    scene = mi.load_dict({"type": "scene", "mirror": mirror(0.0), "splats": above, "lamp": lamp})
    seen = render_layers(make_integrator(mesh_samples=16, white=2.0), scene, down_camera())
    # Irradiance 4 / 1^2 over white 2 doubles the colour.
    assert seen.rgb[15:17, 15:17].mean() == pytest.approx(2 * got["scene"], rel=0.05)


@pytest.mark.parametrize(("lights", "shadow"), [({}, "traced"), ({"sky": WHITE_SKY}, "none")])
def test_splats_that_are_not_relit_have_their_colours_in_a_mirror(lights: dict[str, Any], shadow: str) -> None:
    ensure_variant()
    splats = make_splats_shape(floor(1.0, 0.6, 1.5), instance=1)
    scene = mi.load_dict({"type": "scene", "mirror": mirror(), "splats": splats, **lights})
    seen = render_layers(make_integrator(mesh_samples=16, white=2.0, shadow=shadow), scene, down_camera())
    assert seen.rgb[12:20, 12:20].mean() == pytest.approx(((0.6 + 0.055) / 1.055) ** 2.4, rel=0.02)


def test_the_camera_sees_emitters_unless_they_are_hidden() -> None:
    ensure_variant()
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.4, 0.8]}}
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5]).rotate([1, 0, 0], 0).scale(0.02),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}},
    }
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale([0.08, 0.08, 0.01])}
    scene = mi.load_dict({"type": "scene", "sky": sky, "lamp": lamp, "cube": cube})

    def seen(**options: Any) -> Layers:
        return render_layers(make_integrator(white=float(np.pi), **options), scene, down_camera())

    shown, hidden = seen(), seen(hide_emitters=True)
    np.testing.assert_allclose(shown.rgb[0, 0], [0.2, 0.4, 0.8], rtol=1e-5)
    np.testing.assert_allclose(shown.rgb[16, 16], 3.0, rtol=1e-5)
    assert (shown.alpha == 1).all() and shown.depth[0, 0] == 0
    assert shown.depth[16, 16] == pytest.approx(0.5)
    assert (hidden.rgb[0, 0] == 0).all() and hidden.alpha[0, 0] == 0
    # The cube is visible through the hidden lamp, and unchanged elsewhere.
    assert hidden.depth[16, 16] == pytest.approx(0.99) and hidden.alpha[16, 16] == 1
    np.testing.assert_array_equal(hidden.rgb[12, 20], shown.rgb[12, 20])


@pytest.mark.parametrize(("material", "dark"), [("diffuse", True), ("roughconductor", True), ("dielectric", False)])
def test_meshes_cast_shadows_on_captured_splats(material: str, dark: bool) -> None:
    ensure_variant()
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.05, "bsdf": MATERIALS[material]}
    lamp = {"type": "point", "position": [0.5, 0, 1.0], "intensity": 1.0}
    ground = make_splats_shape(floor(), proxy=slab())
    scene = mi.load_dict({"type": "scene", "floor": ground, "ball": ball, "lamp": lamp})
    seen = render_layers(make_integrator(), scene, down_camera(fov=70))
    x, _ = down_camera(fov=70).project([[-0.5, 0, 0]])[0][0]
    assert seen.light[16, int(x)].max() == (0 if dark else 1)
    assert seen.light[2, 2].min() == 1


def test_light_is_the_same_in_any_order_of_shapes() -> None:
    """A proxy without splats does not determine the capture light of an environment."""
    ensure_variant()
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 0.25}}
    ground = make_splats_shape(floor(), proxy=slab(), capture_light="uniform")
    bare = make_splats_shape(nothing(), proxy=slab(0.2, 0.3))
    integrator = make_integrator(white=float(np.pi))
    camera = down_camera(fov=70)
    first, last = (
        render_layers(integrator, mi.load_dict({"type": "scene", **shapes, "sky": sky}), camera)
        for shapes in ({"a": ground, "b": bare}, {"a": bare, "b": ground})
    )
    assert first.light[1, 1].max() < 0.3
    np.testing.assert_array_equal(first.rgb, last.rgb)


def test_shapes_of_one_instance_are_relit_by_their_own_capture_light() -> None:
    ensure_variant()
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 0.25}}
    moved = [mi.ScalarTransform4f().translate([x, 0, 0]).matrix for x in (-0.2, 0.15)]
    left, right = (floor(extent).transformed(to) for extent, to in zip((0.2, 0.15), moved, strict=True))
    parts = {
        "left": make_splats_shape(left, capture_light="uniform"),
        "right": make_splats_shape(right, capture_light="scene"),
    }
    integrator = make_integrator(white=float(np.pi))
    for order in (("left", "right"), ("right", "left")):
        scene = mi.load_dict({"type": "scene", **{name: parts[name] for name in order}, "sky": sky})
        light = render_layers(integrator, scene, down_camera()).light
        np.testing.assert_allclose(light[:, 2:13], 0.25, atol=0.01)
        np.testing.assert_array_equal(light[4:28, 19:28], 1)


def test_mitsubas_thin_lens_equals_the_camera_plugin() -> None:
    ensure_variant()
    camera = down_camera(fov=40)
    pose = camera.world_from_camera @ np.diag([-1.0, -1, 1, 1])
    film = {"type": "hdrfilm", "width": 32, "height": 32, "crop_width": 20, "crop_height": 12, "crop_offset_x": 5}
    lens = {
        "type": "thinlens",
        "fov": 40,
        "aperture_radius": 0.05,
        "focus_distance": 0.5,
        "to_world": mi.ScalarTransform4f(pose),
        "near_clip": 0.01,
        "film": {**film, "crop_offset_y": 7},
    }
    ground = {"floor": make_splats_shape(stripes(0.0)), "sky": WHITE_SKY}
    scene = mi.load_dict({"type": "scene", **ground})
    # The crop begins inside a tile: only the order along each ray is independent of tiles.
    integrator = make_integrator(quality="exact", lens_rings=1, shadow="none")
    ours = integrator.render(scene, make_sensor(replace(camera, aperture_radius=0.05, focus_distance=0.5)))
    theirs = integrator.render(scene, mi.load_dict(lens))
    sharp = integrator.render(scene, make_sensor(camera))
    np.testing.assert_allclose(np.array(theirs), np.array(ours)[7:19, 5:25], atol=1e-4)
    assert np.abs(np.array(ours) - np.array(sharp))[..., :3].max() > 0.05


def test_splats_in_front_hide_their_share_of_the_radiance_of_a_mesh() -> None:
    ensure_variant()
    from mitsplat.renderer.instances.primary_visibility import PrimaryVisibility

    none, mesh = mi.Color3f(mi.Float([0, 0])), mi.Bool([True, True])
    visible = PrimaryVisibility(
        **{"colour": none, "alpha": mi.Float([1, 1]), "splat_alpha": mi.Float([0, 0.75]), "cover": mi.Float([0, 0.75])},
        **{"solid": mesh, "diffuse": ~mesh, "front": mesh, "emission": none},
        **{"mesh": mi.UInt32([1, 1]), "key": mi.UInt32([1, 1])},
    )
    for colour in visible.lit(none, none, mi.Color3f(mi.Float([2, 2]))):
        np.testing.assert_allclose(np.array(colour), [[2, 0.5]] * 3)
