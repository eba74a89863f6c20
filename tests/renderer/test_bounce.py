"""Light reflected by surroundings and visible meshes onto objects: closed forms and noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from tests.renderer.test_light import WHITE_SKY, area_light, down_camera, floor, noise_free, nothing, slab

RED = np.array([0.8, 0.2, 0.1])


def captured_wall(materials: SplatMaterials | None = None, **options: Any) -> Any:
    wall = trimesh.creation.box(bounds=[[0.3, -500, -500], [0.4, 500, 500]])
    encoded = 1.055 * RED ** (1 / 2.4) - 0.055
    sheet = floor(2.0)
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)) @ trimesh.transformations.translation_matrix(
        (0, 0, 0.3)
    )
    painted = Splats(
        sheet.means, sheet.quats, sheet.scales, sheet.opacities, np.tile((encoded - 0.5) / SH_C0, (1600, 1, 1))
    ).transformed(turn)
    return make_splats_shape(replace(painted, materials=materials), proxy=wall, **options)


def relit_wall() -> Any:
    return captured_wall(capture_light="uniform")


def wall_of_materials() -> Any:
    return captured_wall(SplatMaterials.uniform(1600, roughness=1.0, specular=0.0))


def visible_wall() -> Any:
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0.3, 0, 0]).rotate([0, 1, 0], -90).scale(500),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": RED.tolist()}},
    }


@pytest.mark.parametrize("wall", [captured_wall, relit_wall, wall_of_materials, visible_wall])
def test_a_red_wall_reflects_half_of_its_colour(wall: Any) -> None:
    """A red wall hides half of a uniform sky: E_bounce over the white irradiance is half the wall's colour.

    A wall captured under the light of the scene emits its captured colour; others reflect the other half of the sky.
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


def test_a_shadow_far_from_its_object_keeps_the_light_of_the_wall() -> None:
    """A plate that covers 0.2 % of the hemisphere blocks a parallel light of half of white irradiance.

    The wall of colour c sends c / 2 of white irradiance to the floor: (0 + c / 2) / (1 / 2 + c / 2) remains.
    """
    make_integrator()
    shapes = {
        "wall": captured_wall(),
        "floor": make_splats_shape(floor(0.5), proxy=slab(0.5)),
        "plate": object_box((-0.02, -0.02, 0.5), (0.02, 0.02, 0.51), 1),
        "sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": 0.5 * np.pi},
    }
    light = noise_free(shapes, down_camera(0.2, 32, 6.0), white=np.pi, bounce=True).light
    np.testing.assert_allclose(light.mean(axis=(0, 1)), RED / (1 + RED), atol=0.03)


def test_surroundings_with_changed_colours_reflect_these() -> None:
    """The wall of :func:`test_a_red_wall_reflects_half_of_its_colour` with permuted colours at half the brightness."""
    make_integrator()
    shapes = {
        "wall": captured_wall(colours="0 0.5 0 0 0 0.5 0.5 0 0"),
        "object": make_splats_shape(floor(0.02), proxy=slab(0.02), instance=1, capture_light="uniform"),
        "sky": WHITE_SKY,
    }
    camera = down_camera(0.2, 32, 6.0)
    with_bounce, without = (noise_free(shapes, camera, white=np.pi, bounce=b).light for b in (True, False))
    np.testing.assert_allclose((with_bounce - without).mean(axis=(0, 1)) / (0.5 * RED[[1, 2, 0]]), 0.5, atol=0.03)


def test_captured_colours_contain_the_light_of_relit_surroundings() -> None:
    """A black object beside a captured floor does not add the light of a static wall to the floor."""
    make_integrator()
    block = trimesh.creation.box(bounds=[[-0.03, -0.01, 0.0], [-0.02, 0.01, 0.01]])
    shapes = {
        "wall": relit_wall(),
        "floor": make_splats_shape(floor(0.02), proxy=slab(0.02)),
        "block": make_splats_shape(nothing(), proxy=block, instance=1),
        "sky": WHITE_SKY,
    }
    layers = noise_free(shapes, down_camera(0.2, 32, 6.0), white=np.pi, bounce=True)
    away = layers.light[:, 16:]
    assert np.abs(away - 1).max() < 0.1
    assert layers.light.max() < 1.02


@pytest.mark.parametrize("wall", [relit_wall, wall_of_materials])
def test_a_metal_plate_mirrors_relit_surroundings(wall: Any) -> None:
    """Relit walls are as bright as half of the sky in front of them, whatever their light was when captured."""
    make_integrator()
    metal = replace(floor(0.02), materials=SplatMaterials.uniform(1600, metallic=1.0, roughness=0.1))
    shapes = {
        "wall": wall(),
        "plate": make_splats_shape(metal, proxy=slab(0.02), instance=1),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 3.0}},
    }
    camera = Camera.look_at((-0.2, 0, 0.2), (0, 0, 0), width=32, height=32, fov_x=6)
    layers = noise_free(shapes, camera, white=np.pi, bounce=True)
    shown = layers.instance == 1
    np.testing.assert_allclose((layers.light + layers.highlight)[shown].mean(axis=0), 3 * RED, rtol=0.03)


@pytest.mark.parametrize("receiver", ["captured", "object"])
def test_an_object_reflects_half_of_its_colour(receiver: str) -> None:
    """The red wall is an object. It hides half of a uniform sky, and reflects the other half.

    The factor of a captured floor and the light of an object are then 1/2 + colour / 2.
    """
    make_integrator()
    own: dict[str, Any] = {} if receiver == "captured" else {"instance": 2, "capture_light": "uniform"}
    shapes = {
        "wall": captured_wall(instance=1, capture_light="uniform"),
        "floor": make_splats_shape(floor(0.02), proxy=slab(0.02), **own),
        "sky": WHITE_SKY,
    }
    light = noise_free(shapes, down_camera(0.2, 32, 6.0), white=np.pi, bounce=True).light
    np.testing.assert_allclose(light.mean(axis=(0, 1)), 0.5 + RED / 2, atol=0.03)


def object_box(
    low: tuple[float, float, float], high: tuple[float, float, float], instance: int, encoded: float = 1.0
) -> Any:
    """Return an object of Gaussians of one colour on the faces of a box."""
    mesh = trimesh.creation.box(bounds=[low, high])
    points, faces = trimesh.sample.sample_surface_even(mesh, 3000, seed=1)
    turns = [trimesh.geometry.align_vectors([0, 0, 1], normal)[:3, :3] for normal in mesh.face_normals]
    size = float(np.sqrt(mesh.area / len(points)))
    splats = Splats(
        points,
        Rotation.from_matrix(np.array(turns)[faces]).as_quat(),
        np.tile([size, size, 0.01 * size], (len(points), 1)),
        np.full(len(points), 0.999),
        np.full((len(points), 1, 3), (encoded - 0.5) / SH_C0),
    )
    return make_splats_shape(splats, proxy=mesh, instance=instance, capture_light="uniform")


@pytest.mark.parametrize("kind", ["object", "mesh"])
def test_white_objects_in_uniform_light_stay_below_its_radiance(kind: str) -> None:
    """A white furnace: with all bounces, white objects are as bright as the uniform light, and never brighter."""
    make_integrator()
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    mesh = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.2), "bsdf": white}
    shapes = {
        "plate": object_box((-0.2, -0.2, -0.02), (0.2, 0.2, 0.0), 1) if kind == "object" else mesh,
        "cube": object_box((0.0, -0.05, 0.001), (0.1, 0.05, 0.1), 2),
        "sky": WHITE_SKY,
    }
    camera = Camera.look_at((-0.25, -0.02, 0.25), (0.0, 0.0, 0.02), width=64, height=48, fov_x=30)
    without, light = (noise_free(shapes, camera, white=np.pi, bounce=b) for b in (False, True))
    shown = light.alpha > 0.999
    dark = shown & (without.light[..., 0] < 0.75)
    assert dark.sum() > 500
    assert without.light[dark].mean() < 0.7
    assert 0.9 < light.light[dark].mean() < 1
    assert 0.96 < light.light[dark & (light.instance == 2)].mean() < 1
    assert light.light[shown].mean() < 1


def test_light_of_an_object_keeps_its_place_on_a_mesh() -> None:
    """A white wall of width 2 b and height c, lit by a horizontal sun, lights the table at the distance x.

    The form factor of a perpendicular rectangle is F = (atan(b / x) - x / r atan(b / r)) / pi, with r^2 = x^2 + c^2
    (Howell, "A Catalog of Radiation Heat Transfer Configuration Factors", B-3).
    """
    make_integrator()
    b, c = 0.2, 0.1
    shapes = {
        "table": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.5)},
        "wall": object_box((-0.05, -b, 0.0), (0.0, b, c), 1),
        "sun": {"type": "directional", "direction": [-1, 0, 0], "irradiance": {"type": "rgb", "value": 1.0}},
    }
    camera = down_camera(0.5, 96, 45.0)
    scene, integrator = mi.load_dict({"type": "scene", **shapes}), make_integrator(white=1.0)
    light = np.mean([render_layers(integrator, scene, camera, seed=seed).light for seed in range(4)], axis=0)
    x = (np.arange(96) + 0.5 - 48) / camera.fx * 0.5
    beside = (x > 0.035) & (x < 0.1)  # not in the reach of the small filter of the wall's edge
    r = np.hypot(x, c)
    expected = (np.arctan(b / x) - x / r * np.arctan(b / r)) / np.pi
    np.testing.assert_allclose(light[40:56].mean(axis=(0, 2))[beside], expected[beside], rtol=0.1)


def test_light_of_an_object_leaves_no_squares_on_a_captured_floor() -> None:
    """Few rays from a pixel hit the lit object, and the mean of its neighbours has no step at the edge of a square."""
    make_integrator()
    shapes = {
        "floor": make_splats_shape(floor(0.5), proxy=slab(0.5)),
        "wall": object_box((-0.05, -0.2, 0.0), (0.0, 0.2, 0.1), 1),
        "lamp": area_light(0.2, 1.0),
    }
    layers = noise_free(shapes, down_camera(0.5, 96, 45.0), white=0.2, bounce=True)
    beside = layers.light[20:76, 54:90].mean(axis=-1)
    assert beside.mean() > 1.01
    assert np.abs(np.diff(beside, axis=0)).max() < 0.001  # along the wall, where the light is even


def test_umbra_of_a_lamp_is_that_of_a_path_tracer() -> None:
    """In the shadow of a box, the table receives the light that the box reflects from the lit table.

    The lamp is far, so that it lights the table evenly, as the captured colours state.
    """
    make_integrator()
    radiance, distance, edge, grey = 40.0, 40.0, 2.0, 0.6
    white = radiance * edge**2 / distance**2
    place = [distance * 0.6, 0.0, distance * 0.8]
    pose = mi.ScalarTransform4f().look_at(origin=place, target=[0, 0, 0], up=[0, 1, 0]).scale(edge / 2)
    lamp = {
        "type": "rectangle",
        "to_world": pose,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }
    camera = Camera.look_at((-0.25, -0.2, 0.3), (-0.06, 0.0, 0.0), width=160, height=120, fov_x=35)
    low, high = (-0.05, -0.05, 0.0), (0.05, 0.05, 0.1)
    encoded = float(encode_srgb(grey * 0.8))  # the table is lit at a cosine of 0.8
    shapes = {
        "table": make_splats_shape(floor(0.5, encoded), proxy=slab(0.5)),
        "box": object_box(low, high, 1, float(encode_srgb(grey))),
        "lamp": lamp,
    }
    scene, integrator = mi.load_dict({"type": "scene", **shapes}), make_integrator(white=white, shadow_error=0)
    layers = [render_layers(integrator, scene, camera, seed=seed) for seed in range(2)]
    light = np.mean([one.light[..., 0] for one in layers], axis=0)
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": grey}}
    table = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.5), "bsdf": diffuse}
    middle, half = np.add(low, high) / 2, np.subtract(high, low) / 2
    box = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate(middle.tolist()).scale(half.tolist()),
        "bsdf": diffuse,
    }
    photos = []
    for objects in ({"box": box}, {}):
        scene = mi.load_dict({"type": "scene", "table": table, "lamp": lamp, **objects})
        integrator = mi.load_dict({"type": "path", "max_depth": 8})
        photo = np.array(mi.render(scene, sensor=mitsuba_camera(camera), integrator=integrator, spp=256))
        photos.append(photo[..., 0])
    ratio = photos[0] / np.maximum(photos[1], 1e-6)
    inside = gaussian_filter((layers[0].instance == 0).astype(float), 1) > 0.99
    umbra = inside & (photos[1] > 0) & (ratio < 0.3)
    assert umbra.sum() > 600
    assert ratio[umbra].mean() > 0.02
    assert light[umbra].mean() == pytest.approx(ratio[umbra].mean(), rel=0.1)


def mitsuba_camera(camera: Camera) -> Any:
    """Return Mitsuba's perspective sensor for a pinhole camera with its principal point in the middle."""
    pose = camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))),
            "to_world": mi.ScalarTransform4f(pose),
            "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
        }
    )


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
