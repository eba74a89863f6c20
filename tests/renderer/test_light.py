"""Traced light against closed forms, and mutual occlusion of splats and visible meshes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_normals import CREASE_ANGLE, smooth_normals
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers
from mitsplat.renderer.light.light_points import POINT_STEP
from mitsplat.renderer.light.light_tiles import BLOCK
from mitsplat.renderer.light.shadow_rays import RECURRENCE, SURROUNDINGS_RECURRENCE, _bayer
from mitsplat.renderer.occluders.proxies import Proxies

WHITE_SKY = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}


def down_camera(height: float = 1.0, size: int = 32, fov: float = 20.0) -> Camera:
    return Camera.look_at((0, 0, height), (0, 0, 0), up=(0, 1, 0), width=size, height=size, fov_x=fov)


def floor(extent: float = 1.0, grey: float = 0.5, z: float = 0.0) -> Splats:
    """Return an opaque grey plane of Gaussians at height z."""
    n = 40
    x, y = np.meshgrid(np.linspace(-extent, extent, n), np.linspace(-extent, extent, n))
    spacing = 2 * extent / (n - 1)
    means = np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], axis=1)
    return Splats(
        means,
        np.tile([0, 0, 0, 1.0], (n * n, 1)),
        np.tile([spacing, spacing, 0.01 * spacing], (n * n, 1)),
        np.full(n * n, 0.999),
        np.full((n * n, 1, 3), (grey - 0.5) / SH_C0),
    )


def slab(extent: float = 1.0, top: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[[-extent, -extent, top - 0.1 * extent], [extent, extent, top]])


def render(shapes: dict[str, Any], camera: Camera, *, samples: int = 64, **options: Any) -> Layers:
    integrator = make_integrator(shadow_samples=samples, shadow_error=0, **options)
    return render_layers(integrator, mi.load_dict({"type": "scene", **shapes}), camera)


def test_light_without_dynamic_objects_changes_no_bit() -> None:
    make_integrator()
    shapes = {"floor": make_splats_shape(floor(), proxy=slab()), "sky": WHITE_SKY}
    lit = render(shapes, down_camera())
    plain = render(shapes, down_camera(), shadow="none")
    assert (lit.light == 1).all()
    assert lit.rgb.tobytes() == plain.rgb.tobytes()
    assert lit.rgb.max() > 0.1


def test_wall_hides_half_of_a_uniform_sky() -> None:
    """At the foot of a tall wall, half of the cosine-weighted hemisphere is dark: the ratio is 1/2."""
    make_integrator()
    wall = trimesh.creation.box(bounds=[[0.0, -500, 0.001], [0.5, 500, 500]])
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "wall": make_splats_shape(floor().select(np.zeros(1600, bool)), proxy=wall, instance=1),
        "sky": WHITE_SKY,
    }
    camera = Camera.look_at((-0.02, 0, 0.3), (-0.02, 0, 0), up=(0, 1, 0), width=32, height=32, fov_x=4)
    light = render(shapes, camera, samples=256).light
    assert light.mean() == pytest.approx(0.5, abs=0.02)


def test_an_occluder_hides_the_sky_within_its_reach_only() -> None:
    """A ceiling at height h occludes directions within reach r; a share of (h / r)^2 of the sky's light remains."""
    make_integrator()
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 2.0}}
    for ceiling, bright in ((2.0, (0.0, 1.0)), (0.5, (0.0, 0.25))):
        plate = trimesh.creation.box(bounds=[[-500, -500, ceiling], [500, 500, ceiling + 0.1]])
        shapes = {
            "floor": make_splats_shape(floor(), proxy=slab()),
            "ceiling": make_splats_shape(nothing(), proxy=plate, instance=1),
        }
        camera = down_camera(height=0.4)
        for reach, expected in zip((0.0, 1.0), bright, strict=True):
            light = render({**shapes, "sky": WHITE_SKY}, camera, sky_reach=reach).light
            np.testing.assert_allclose(light, expected, atol=0.01)
            assert render({**shapes, "sun": sun}, camera, sky_reach=reach).light.max() == 0


@pytest.mark.parametrize("dynamic", [False, True])
def test_relit_surroundings_have_the_normals_of_their_proxy(dynamic: bool) -> None:
    """A floor below a point light of intensity I at the height h has the irradiance I / h^2, seen from any side."""
    make_integrator()
    ground = make_splats_shape(floor(), proxy=slab(), capture_light="uniform", dynamic=dynamic)
    lamp = {"type": "point", "position": [0.0, 0.0, 2.0], "intensity": {"type": "rgb", "value": 5.0}}
    camera = Camera.look_at((1.5, 0, 0.5), (0, 0, 0), width=32, height=32, fov_x=4)
    light = render({"floor": ground, "lamp": lamp}, camera, white=np.pi, bounce=False).light
    np.testing.assert_allclose(light, 5 / 4 / np.pi, rtol=0.03)


def test_an_object_before_a_point_light_leaves_no_light() -> None:
    make_integrator()
    blocker = trimesh.creation.box(bounds=[[-0.05, -0.05, 0.4], [0.05, 0.05, 0.41]])
    lamp = {"type": "point", "position": [0.0, 0.0, 2.0], "intensity": {"type": "rgb", "value": 5.0}}
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "blocker": make_splats_shape(floor().select(np.zeros(1600, bool)), proxy=blocker, instance=1),
        "lamp": lamp,
    }
    camera = Camera.look_at((0.0, -1.5, 0.3), (0, 0, 0), width=64, height=48, fov_x=30)
    light = render(shapes, camera).light
    assert light.min() == 0.0
    assert light.max() == 1.0
    # The shadow of a 0.1 m square from 2 m above, 0.4 m over the floor, is 0.1 * 2 / 1.6 m wide.
    pixels, _ = camera.project([[0.0, 0.0, 0.0], [0.055, 0, 0], [0.07, 0, 0], [-0.055, 0, 0], [-0.07, 0, 0]])
    values = [light[int(y), int(x), 0] for x, y in pixels]
    assert values[0] == values[1] == values[3] == 0.0
    assert values[2] == values[4] == 1.0


@pytest.mark.parametrize("unit", [0.001, 1.0, 100.0])
def test_uniform_capture_keeps_its_colour_under_the_irradiance_of_white(unit: float) -> None:
    """Tested at three scales: no shadow acne, no missing light.

    The sky gives pi. A square of half side a at height 5 a gives 12 times the configuration factor pi F of a quarter
    seen from below its corner, with pi F = s atan(s) and s = 1 / sqrt(1 + 5^2).
    """
    make_integrator()
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 5 * unit], target=[0, 0, 0], up=[0, 1, 0]).scale(unit),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}},
    }
    camera = Camera.look_at((0, 0, unit), (0, 0, 0), up=(0, 1, 0), width=32, height=32, fov_x=6, near=0.01 * unit)
    shapes = {
        "floor": make_splats_shape(floor(unit), proxy=slab(unit), instance=1, capture_light="uniform"),
        "sky": WHITE_SKY,
        "lamp": lamp,
    }
    s = 1 / np.sqrt(1 + 5**2)
    light = render(shapes, camera, samples=256, white=np.pi + 12 * s * np.arctan(s)).light
    np.testing.assert_allclose(light, 1.0, atol=0.03)
    assert light.mean() == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("others", [0, 1])
def test_a_lamp_at_the_reference_point_casts_shadows(others: int) -> None:
    """Its light there is infinite, where lamps are compared to distribute the rays among them."""
    make_integrator()
    lid = trimesh.creation.box(bounds=[[-0.2, -0.2, -0.21], [0.2, 0.2, -0.2]])
    shapes = {
        "floor": make_splats_shape(floor(1.0, z=-0.5), proxy=slab(1.0, -0.5)),
        "lid": make_splats_shape(nothing(), proxy=lid, instance=1),
        "lamp": {"type": "point", "position": [0, 0, 0], "intensity": 1.0},
        **{f"lamp_{i}": {"type": "point", "position": [0, 0, 0.1], "intensity": 1.0} for i in range(others)},
    }
    assert not render(shapes, down_camera(), reference=[0, 0, 0], bounce=False).light.any()


def test_side_away_from_the_light_is_darker() -> None:
    make_integrator()
    ball = trimesh.creation.icosphere(4, 0.3)
    sphere = Splats(
        ball.vertices,
        np.tile([0, 0, 0, 1.0], (len(ball.vertices), 1)),
        np.full((len(ball.vertices), 3), 0.02),
        np.full(len(ball.vertices), 0.99),
        np.zeros((len(ball.vertices), 1, 3)),
    )
    lamp = {"type": "point", "position": [3.0, 0.0, 0.0], "intensity": {"type": "rgb", "value": 5.0}}
    shapes = {"ball": make_splats_shape(sphere, proxy=ball, instance=1), "lamp": lamp}
    camera = Camera.look_at((0, -2, 0), (0, 0, 0), width=48, height=48, fov_x=25)
    light = render(shapes, camera).light[..., 0]
    assert light[24, 36] > 4 * light[24, 20] + 0.1
    assert light[24, 16] == 0.0


def test_highlight_lies_at_the_mirror_direction_and_only_there() -> None:
    make_integrator()
    lamp = {"type": "point", "position": [0.0, 0.0, 1.0], "intensity": {"type": "rgb", "value": 1.0}}
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab(), instance=1, specular=0.5, roughness=0.1),
        "lamp": lamp,
    }
    highlight = render(shapes, down_camera(1.0, 65, 40.0)).highlight[..., 0]
    assert np.unravel_index(highlight.argmax(), highlight.shape) == (32, 32)
    assert highlight[32, 60] < 0.01 * highlight.max()


def test_visible_meshes_and_splats_occlude_each_other() -> None:
    make_integrator()
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
    cube = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0.1, 0, 0]).scale(0.1),
        "bsdf": red,
    }
    shapes = {
        "above": make_splats_shape(floor(0.04, grey=0.9, z=0.3), instance=2),
        "below": make_splats_shape(floor(1.0, grey=0.2, z=0.0), instance=1),
        "cube": cube,
    }
    layers = render(shapes, down_camera(1.0, 64, 40.0))
    pixels, _ = down_camera(1.0, 64, 40.0).project([[0.0, 0, 0.3], [0.16, 0, 0.1], [-0.2, 0, 0.0]])
    above, mesh, below = [(int(y), int(x)) for x, y in pixels]
    assert [layers.instance[p] for p in (above, mesh, below)] == [2, 0, 1]
    assert layers.rgb[mesh][0] > 4 * layers.rgb[mesh][1] > 0
    assert layers.depth[mesh] == pytest.approx(0.9, abs=1e-3)
    assert layers.depth[below] == pytest.approx(1.0, abs=1e-2)
    assert layers.rgb[above].min() > layers.rgb[below].max()


def test_layers_have_depth_and_normal_of_the_proxy() -> None:
    make_integrator()
    shapes = {"floor": make_splats_shape(floor(), proxy=slab(), instance=7)}
    layers = render(shapes, down_camera())
    np.testing.assert_allclose(layers.proxy_depth, 1.0, atol=1e-5)
    np.testing.assert_allclose(layers.normal, np.broadcast_to([0, 0, 1.0], layers.normal.shape), atol=1e-5)
    assert (layers.proxy_instance == 7).all() and (layers.instance == 7).all()


def nothing() -> Splats:
    return floor().select(np.zeros(1600, bool))


def test_few_rays_leave_no_speckles_in_a_faint_shadow() -> None:
    """A strong lamp, a weak sky and four rays per pixel: few rays hit the object at the edge of the wide penumbra."""
    make_integrator()
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 1.4], target=[0, 0, 0], up=[0, 1, 0]).scale(0.3),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 14.0}},
    }
    blocker = trimesh.creation.box(bounds=[[-0.05, -0.05, 0.4], [0.05, 0.05, 0.41]])
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "blocker": make_splats_shape(nothing(), proxy=blocker, instance=1),
        "lamp": lamp,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
    }
    camera = Camera.look_at((0.0, -1.5, 0.35), (0, 0, 0), width=160, height=90, fov_x=25)
    few, many = (render(shapes, camera, samples=n).light[..., 0] for n in (4, 1024))
    assert many.min() < 0.8
    assert np.abs(few - many).max() < 0.2
    assert np.sqrt(np.mean((few - many) ** 2)) < 0.02


def test_relit_surface_shows_no_pattern_of_the_sampling() -> None:
    make_integrator()
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at(origin=[1, 0, 1.4], target=[0, 0, 0], up=[0, 1, 0]).scale(0.3),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 14.0}},
    }
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab(), instance=1, capture_light="uniform"),
        "lamp": lamp,
        "sky": WHITE_SKY,
    }
    light = render(shapes, down_camera(size=48), samples=4).light[..., 0]
    assert np.abs(np.diff(light, 2, axis=0)).max() < 1e-3
    assert np.abs(np.diff(light, 2, axis=1)).max() < 1e-3


def test_a_point_beside_its_proxy_gets_the_light_of_its_neighbours() -> None:
    """The proxy is wider than its object by a few pixels: the floor visible there is not under the object."""
    make_integrator()
    base = trimesh.creation.box(bounds=[[-0.125, -0.125, 0.0], [0.125, 0.125, 0.05]])
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "object": make_splats_shape(floor(0.1, 0.8, 0.05), proxy=base, instance=1, capture_light="uniform"),
        "sky": WHITE_SKY,
    }
    layers = render(shapes, down_camera(size=64), samples=64)
    seam = (layers.instance == 0) & (layers.proxy_instance == 1)
    assert seam.sum() > 20
    assert layers.light[seam].min() > 0.3


def test_splats_that_hide_the_foot_of_a_wall_have_the_light_of_the_contact() -> None:
    """Splats of the floor lie above its proxy. At the foot of the wall, half of the sky is visible."""
    make_integrator()
    raised = 0.004
    wall = trimesh.creation.box(bounds=[[0.0, -500, -0.01], [0.5, 500, 0.5]])
    shapes = {
        "floor": make_splats_shape(floor(z=raised), proxy=slab()),
        "wall": make_splats_shape(nothing(), proxy=wall, instance=1),
        "sky": WHITE_SKY,
    }
    camera = Camera.look_at((-1, 0, 0.27), (0, 0, 0), up=(0, 0.2, 1), width=96, height=96, fov_x=4)
    layers = render(shapes, camera, samples=256, bounce=False)
    seam = (layers.proxy_instance == 1) & (layers.depth < layers.proxy_depth)
    assert 300 < seam.sum() < 3000
    np.testing.assert_allclose(layers.light[seam], 0.5, atol=0.05)


def noise_free(shapes: dict[str, Any], camera: Camera, **options: Any) -> Layers:
    return render(shapes, camera, samples=1024, **options)


def area_light(size: float, height: float, radiance: float = 5.0) -> dict[str, Any]:
    """Return a square light of edge ``size`` at ``height`` above the origin that shines down."""
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, height], target=[0, 0, 0], up=[0, 1, 0]).scale(0.5 * size)
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return {"type": "rectangle", "to_world": pose, "emitter": emitter}


def test_penumbra_of_a_square_light_has_the_width_of_similar_triangles() -> None:
    """A half plane at height h under a square light of edge s at height H has a penumbra of width s h / (H - h).

    Inside, the visible share of the light rises linearly; the middle is under the half plane's edge.
    """
    make_integrator()
    size, top, edge = 0.1, 2.0, 0.5
    half_plane = trimesh.creation.box(bounds=[[-5, -5, edge], [0, 5, edge + 1e-4]])
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "half plane": make_splats_shape(nothing(), proxy=half_plane, instance=1),
        "lamp": area_light(size, top),
    }
    camera = Camera.look_at((0, 0, 0.45), (0, 0, 0), up=(0, 1, 0), width=320, height=8, fov_x=10)
    light = noise_free(shapes, camera).light[3, :, 0]
    slopes = camera.ray_slopes(np.stack([np.arange(320) + 0.5, np.full(320, 4.0)], axis=1))
    x = 0.45 * slopes[:, 0]
    inside = (light > 0.1) & (light < 0.9)
    slope, middle = np.polyfit(x[inside], light[inside], 1)
    assert 1 / slope == pytest.approx(size * edge / (top - edge), rel=0.02)
    assert -middle / slope + 0.5 / slope == pytest.approx(0.0, abs=0.02 / slope)


def test_the_default_accuracy_holds_in_the_penumbra() -> None:
    """Rays are added until light has the stated perceptual error; their number varies between pixels."""
    make_integrator()
    blocker = trimesh.creation.box(bounds=[[-0.1, -0.1, 0.15], [0.1, 0.1, 0.2]])
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "blocker": make_splats_shape(nothing(), proxy=blocker, instance=1),
        "lamp": area_light(0.4, 1.0),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.2}},
    }
    camera = Camera.look_at((0.0, -0.9, 0.6), (0, 0, 0), width=240, height=160, fov_x=45)
    exact = noise_free(shapes, camera).light[..., 0]
    seen = noise_free(shapes, camera).proxy_instance == 0
    penumbra = seen & (exact > 0.15) & (exact < 0.97)
    assert penumbra.sum() > 2000
    for error in (0.03, 0.06):
        layers = render_layers(
            make_integrator(shadow_error=error), mi.load_dict({"type": "scene", **shapes}), camera, seed=3
        )
        # Errors are in equal display steps; the stated error applies at half of the light.
        difference = (layers.light[..., 0] - exact) / (error * (np.maximum(exact, 0.05) / 0.5) ** (1 - 1 / 2.2))
        assert np.sqrt(np.mean(difference[penumbra] ** 2)) < 1
        assert abs(difference[penumbra].mean()) < 0.2
        assert np.abs(difference[seen & (exact > 0.97)]).max() < 3


@pytest.mark.parametrize("unit", [0.001, 1.0, 100.0])
def test_no_acne_beside_an_object_and_no_gap_under_it(unit: float) -> None:
    """A cube on the floor under a slanting lamp: lit floor is exactly unshadowed, and the shadow starts at the edge."""
    make_integrator()
    cube = trimesh.creation.box(bounds=np.multiply(unit, [[-0.1, -0.1, 0.0], [0.1, 0.1, 0.2]]))
    lamp = {"type": "directional", "direction": [1, 0, -1], "irradiance": {"type": "rgb", "value": 2.0}}
    shapes = {
        "floor": make_splats_shape(floor(unit), proxy=slab(unit)),
        "cube": make_splats_shape(nothing(), proxy=cube, instance=1),
        "lamp": lamp,
    }
    eye = np.multiply(unit, (0.6, 0, 1.0))
    camera = Camera.look_at(
        eye, np.multiply(unit, (0.2, 0, 0)), up=(0, 1, 0), width=200, height=120, fov_x=45, near=0.01 * unit
    )
    light = render(shapes, camera, samples=4).light[..., 0]
    centres = np.stack(np.meshgrid(np.arange(200) + 0.5, np.arange(120) + 0.5), axis=-1).reshape(-1, 2)
    directions = np.column_stack([camera.ray_slopes(centres), np.ones(len(centres))])
    directions = directions @ camera.world_from_camera[:3, :3].T
    point = (eye - directions * (eye[2] / directions[:, 2:])).reshape(120, 200, 3) / unit
    x, y = point[..., 0], point[..., 1]
    pixel = np.abs(np.diff(x, axis=1)).max()
    seen = (directions[:, 2].reshape(120, 200) < 0) & (np.abs(y) < 0.08)
    shadow = seen & (x > 0.1 + 1.5 * pixel) & (x < 0.3 - 1.5 * pixel)
    lit = seen & (x > 0.3 + 1.5 * pixel) | (np.abs(y) > 0.1 + 2 * pixel) & (x > 0.3)
    assert shadow.sum() > 200 and lit.sum() > 200
    assert (light[shadow] == 0).all()
    assert (light[lit] == 1).all()


@pytest.mark.parametrize("subdivisions", [2, 3])
def test_the_terminator_of_a_coarse_ball_is_that_of_a_smooth_one(subdivisions: int) -> None:
    """The terminator has no dark facets: irradiance is max(0, n.l) of the smooth ball, despite its few faces."""
    make_integrator()
    ball = trimesh.creation.icosphere(subdivisions, 0.3)
    fine = trimesh.creation.icosphere(5, 0.3)
    sphere = Splats(
        fine.vertices,
        np.tile([0, 0, 0, 1.0], (len(fine.vertices), 1)),
        np.full((len(fine.vertices), 3), 0.008),
        np.full(len(fine.vertices), 0.99),
        np.zeros((len(fine.vertices), 1, 3)),
    )
    lamp = {"type": "directional", "direction": [-1, 0, 0], "irradiance": {"type": "rgb", "value": np.pi}}
    shapes = {"ball": make_splats_shape(sphere, proxy=ball, instance=1), "lamp": lamp}
    camera = Camera.look_at((0, -2, 0), (0, 0, 0), width=96, height=96, fov_x=18)
    layers = render(shapes, camera, samples=16, white=np.pi)
    u = (np.arange(96) + 0.5 - 48) / camera.fx * 2 / 0.3
    x, z = np.meshgrid(u, -u)
    inner = x**2 + z**2 < 0.8**2
    # The camera is close, so that a little parallax remains in x.
    expected = np.maximum(x, 0)
    difference = np.abs(layers.light[..., 0] - expected)[inner]
    assert difference.mean() < 0.03
    assert np.percentile(difference, 99) < 0.12


def test_creases_are_those_of_drawings_and_not_of_rough_scans() -> None:
    rng = np.random.default_rng(0)
    scan = trimesh.creation.icosphere(3, 0.1)
    scan.vertices *= 1 + 0.025 * rng.normal(size=(len(scan.vertices), 1))
    assert (scan.face_adjacency_angles > CREASE_ANGLE).mean() > 0.15
    normals = smooth_normals(scan).reshape(-1, 3)
    order = np.argsort(scan.faces.ravel(), kind="stable")
    _, first, which = np.unique(scan.faces.ravel()[order], return_index=True, return_inverse=True)
    agreement = np.einsum("ij,ij->i", normals[order], normals[order][first][which])
    assert np.percentile(agreement, 2) > 0.99
    for height in (0.01, 0.1, 2.0):
        prism = trimesh.creation.cylinder(0.1, height, sections=6)
        sharp = np.repeat(prism.face_normals[:, None], 3, axis=1)
        np.testing.assert_allclose(smooth_normals(prism), sharp, atol=1e-6)


def test_every_kind_of_emitter_gives_the_irradiance_of_its_closed_form() -> None:
    """Relit white with white = pi gives E/pi for every kind of light without occluders."""
    make_integrator()
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0])
    sky = np.zeros((256, 512, 3), np.float32)
    polar = (np.arange(256) + 0.5) / 256 * np.pi
    sky[:] = np.maximum(np.cos(polar), 0)[:, None, None]
    up = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    rgb = {"type": "rgb", "value": 2.0}
    lights = {
        "spot": ({"type": "spot", "to_world": pose, "cutoff_angle": 30, "intensity": rgb}, 2.0 / 4),
        "directional": ({"type": "directional", "direction": [1, 0, -1], "irradiance": rgb}, 2 / np.sqrt(2)),
        "point": ({"type": "point", "position": [0, 0, 2], "intensity": rgb}, 2.0 / 4),
        "constant": ({"type": "constant", "radiance": rgb}, 2 * np.pi),
        # L = cos over the upper hemisphere: the integral of cos^2 is 2 pi / 3.
        "map": ({"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": up}, 2 * np.pi / 3),
    }
    ground = make_splats_shape(floor(), proxy=slab(), instance=1, capture_light="uniform")
    for name, (light, irradiance) in lights.items():
        layers = render({"floor": ground, "light": light}, down_camera(fov=2.0), samples=256, white=np.pi)
        assert layers.light.mean() == pytest.approx(irradiance / np.pi, rel=0.01), name


@pytest.mark.parametrize("kind", ["point", "rectangle", "sphere"])
@pytest.mark.parametrize("reverse", [False, True])
def test_every_lamp_of_a_hall_lights_the_floor_below_it(kind: str, reverse: bool) -> None:
    """E = sum of I cos(theta) / r^2 at 8 m from the point at which lamps are compared, in any order of the lamps."""
    make_integrator()
    place, radius, level = np.array([8.0, 2.0, 0.0]), 0.02, 100.0
    positions = np.array([[x, y, 1.0] for x in range(-8, 9, 2) for y in (-2, 2)])
    away = positions - place
    distance = np.linalg.norm(away, axis=1)
    cosine = away[:, 2] / distance
    if kind == "point":
        lights = [{"type": "point", "position": list(p), "intensity": level} for p in positions]
        irradiance = (level * cosine / distance**2).sum()
    else:
        radiance = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": level}}}
        if kind == "rectangle":
            down = mi.ScalarTransform4f
            lights = [
                {"type": "rectangle", "to_world": down().translate(p).scale([radius, radius, -1]), **radiance}
                for p in positions.tolist()
            ]
            irradiance = (level * 4 * radius**2 * cosine**2 / distance**2).sum()
        else:
            lights = [{"type": "sphere", "center": list(p), "radius": radius, **radiance} for p in positions]
            irradiance = (level * np.pi * radius**2 * cosine / distance**2).sum()
    camera = Camera.look_at(place + np.array([0, 0, 0.5]), place, up=(0, 1, 0), width=16, height=16, fov_x=2)
    shapes = {"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20)}}
    shapes |= {f"lamp{i}": light for i, light in enumerate(lights[::-1] if reverse else lights)}
    layers = render(shapes, camera, white=np.pi, bounce=False)
    assert layers.light.mean() == pytest.approx(irradiance / np.pi, rel=0.01)


def test_wall_hides_half_of_a_sky() -> None:
    make_integrator()
    wall = trimesh.creation.box(bounds=[[0.0, -5000, 0.0], [0.5, 5000, 5000]])
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "wall": make_splats_shape(nothing(), proxy=wall, instance=1),
        "sky": WHITE_SKY,
    }
    camera = Camera.look_at((-0.005, 0, 0.3), (-0.005, 0, 0), up=(0, 1, 0), width=32, height=32, fov_x=0.5)
    light = noise_free(shapes, camera).light
    assert light.mean() == pytest.approx(0.5, abs=2e-3)


@pytest.mark.parametrize(("metallic", "roughness"), [(1.0, 0.05), (1.0, 0.3), (1.0, 1.0), (0.5, 0.4), (0.0, 0.2)])
def test_material_reflects_as_much_uniform_light_as_in_mitsuba(metallic: float, roughness: float) -> None:
    """White furnace: under a uniform sky of radiance 1, a white surface has the albedo of ``principled``."""
    make_integrator()
    materials = SplatMaterials.uniform(len(floor()), metallic=metallic, roughness=roughness)
    shape = make_splats_shape(replace(floor(), materials=materials), proxy=slab(), instance=1)
    white = {"type": "rgb", "value": 1.0}
    bsdf = mi.load_dict({"type": "principled", "base_color": white, "metallic": metallic, "roughness": roughness})
    for eye in ((0.0, -0.05, 1.0), (0.0, -1.0, 0.4)):
        camera = Camera.look_at(eye, (0, 0, 0), width=32, height=32, fov_x=2)
        layers = noise_free({"floor": shape, "sky": WHITE_SKY}, camera, white=np.pi)
        si = dr.zeros(mi.SurfaceInteraction3f, 1 << 16)
        si.wi = mi.Vector3f((np.array(eye) / np.linalg.norm(eye)).tolist())
        random = mi.PCG32(1 << 16)
        point = mi.Point2f(random.next_float32(), random.next_float32())
        _, weight = bsdf.sample(mi.BSDFContext(), si, random.next_float32(), point)
        found = (layers.light + layers.highlight).mean()
        assert found == pytest.approx(float(np.mean(weight.x)), abs=0.01)


def test_accuracy_out_of_range_is_refused() -> None:
    make_integrator()
    for name, value in (
        ("shadow_error", 1.0),
        ("shadow_error", -0.1),
        ("white", -1.0),
        ("sky_reach", -1.0),
        ("shadow_error", "fine"),
    ):
        with pytest.raises(Exception, match=name):
            mi.load_dict({"type": "splat_proxy", name: value})


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_an_object_in_the_light_of_its_capture_is_unchanged(roughness: float) -> None:
    """Uniform light of radiance 1: the ratio is 1 to 1e-3, and the highlight replaces the captured one."""
    make_integrator()
    ground = make_splats_shape(
        floor(), proxy=slab(), instance=1, capture_light="uniform", specular=0.04, roughness=roughness
    )
    for eye in ((0.0, -0.05, 1.0), (0.0, -1.0, 0.8)):
        camera = Camera.look_at(eye, (0, 0, 0), width=24, height=24, fov_x=4)
        layers = noise_free({"floor": ground, "sky": WHITE_SKY}, camera, white=np.pi)
        np.testing.assert_allclose(layers.light, 1, atol=1e-3)
        assert abs(layers.highlight.mean()) < 0.006


@pytest.mark.parametrize("occluders", ["proxies", "splats"])
@pytest.mark.parametrize("rays", [8, 80])
def test_kernels_that_trace_one_scene_give_the_same_light(
    occluders: str, rays: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """CUDA kernels trace one scene each; occlusion by static and dynamic objects is passed to the next kernel."""
    make_integrator()
    ball = trimesh.creation.icosphere(2, 0.05)
    ball.apply_translation([0, 0, 0.06])
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0.1, 0.05, 0.03]).scale(0.03)}
    wall = trimesh.creation.box(bounds=[[-0.16, -0.2, 0.001], [-0.15, 0.2, 0.1]])
    thing = Splats(
        ball.vertices,
        np.tile([0, 0, 0, 1.0], (len(ball.vertices), 1)),
        np.full((len(ball.vertices), 3), 0.008),
        np.full(len(ball.vertices), 0.9),
        np.zeros((len(ball.vertices), 1, 3)),
    )
    shapes = {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "wall": make_splats_shape(nothing(), proxy=wall),
        "thing": make_splats_shape(thing, proxy=ball, instance=1, capture_light="uniform", specular=0.3),
        "cube": cube,
        "sky": WHITE_SKY,
        "lamp": {"type": "point", "position": [0.5, 0.2, 0.8], "intensity": {"type": "rgb", "value": 1.0}},
    }
    camera = Camera.look_at((0.1, -0.5, 0.4), (0, 0, 0), width=48, height=40, fov_x=40)

    def layers() -> Layers:
        return render(shapes, camera, samples=rays, occluders=occluders)

    together = layers()
    assert together.light.min() < 0.5
    build = Proxies.__init__

    def apart(self: Proxies, *args: Any) -> None:
        build(self, *args)
        assert len(self.shadow_casters) == (2 if occluders == "splats" else 1)
        self.separate_kernels = True

    monkeypatch.setattr(Proxies, "__init__", apart)
    one_by_one = layers()
    for name in ("rgb", "light", "highlight", "normal"):
        assert getattr(one_by_one, name).tobytes() == getattr(together, name).tobytes(), name


def test_parts_of_many_shadow_rays_share_their_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a kernel traces one scene, rays are traced 32 at a time: 128 rays in four parts, 256 in eight.

    The first parts may have kernels of their own: their sums begin with zeros.
    """
    make_integrator()
    build = Proxies.__init__

    def apart(self: Proxies, *args: Any) -> None:
        build(self, *args)
        self.separate_kernels = True

    monkeypatch.setattr(Proxies, "__init__", apart)

    def kernels(samples: int) -> set[int]:
        shapes = {
            "floor": make_splats_shape(floor(), proxy=slab()),
            "object": make_splats_shape(nothing(), proxy=trimesh.creation.icosphere(1, 0.05), instance=1),
            "lamp": {"type": "point", "position": [0.5, 0.2, 0.8], "intensity": {"type": "rgb", "value": 1.0}},
        }
        dr.kernel_history_clear()
        assert render(shapes, down_camera(), samples=samples, bounce=False).light.min() < 0.5
        return {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        few = kernels(128)
        assert kernels(256) <= few


@pytest.mark.parametrize(("stride", "apart"), [(1, 0.18), (BLOCK * BLOCK, 0.24), (POINT_STEP * BLOCK * BLOCK, 0.11)])
def test_sample_points_of_rays_do_not_repeat(stride: int, apart: float) -> None:
    """Sample points of neighbours, of one pixel, and of each point of a curved pixel differ.

    The minimum of n d^2 over points n steps apart is bounded away from 0 for sequences without repetition; it is 0.245
    for
    Roberts' sequence.
    """
    step = np.array(RECURRENCE, dtype=np.int64) * stride % 2**32 / 2**32
    n = np.arange(1, 1025)
    offset = n[:, None] * step
    distance = np.linalg.norm(offset - np.round(offset), axis=1)
    assert np.min(n * distance**2) > apart


@pytest.mark.parametrize(
    ("shape", "limit"), [((3, 3), 0.68), ((1, BLOCK), 0.63), ((BLOCK, 1), 0.68)], ids=["block", "row", "column"]
)
def test_neighbouring_pixels_see_the_same_part_of_an_emitter(shape: tuple[int, int], limit: float) -> None:
    """Neighbours estimate the visible part of an emitter with at most two thirds of the error of independent rays.

    The emitter gets a share of the rays, and a straight edge hides a part of it. Independent rays have the variance
    n p (1 - p) of the number of n rays that arrive, with the visible part p.
    """
    make_integrator()
    trials, rng = 4000, np.random.default_rng(0)
    rays, share = rng.choice([4, 10, 20], trials), rng.choice([0.12, 0.22, 0.35, 0.6, 1.0], trials)
    down, across = (index.ravel() for index in np.indices(shape))
    rows, columns = (rng.integers(BLOCK, size=(trials, 1)) + step for step in (down, across))
    rank = np.array(_bayer(mi.UInt32(columns.ravel()), mi.UInt32(rows.ravel())), dtype=np.uint64).reshape(trials, -1, 1)
    number = (
        rank + rng.integers(2**32, size=(trials, 1, 1)).astype(np.uint64) + np.arange(20, dtype=np.uint64) * BLOCK**2
    )
    x, y = (
        (number * np.uint64(step) % np.uint64(2**32)).reshape(trials, -1) / 2**32 for step in SURROUNDINGS_RECURRENCE
    )
    shot = np.tile(np.arange(20) < rays[:, None], (1, len(down)))
    start = (rng.random(trials) * (1 - share))[:, None]
    shot &= (x >= start) & (x < start + share[:, None])
    angle, edge = rng.random((trials, 1)) * np.pi, rng.uniform(-0.4, 0.4, (trials, 1))
    grid = (np.indices((32, 32)).reshape(2, -1) + 0.5) / 32 - 0.5
    visible = (np.cos(angle) * grid[0] + np.sin(angle) * grid[1] > edge).mean(axis=1)
    arrives = shot & (np.cos(angle) * ((x - start) / share[:, None] - 0.5) + np.sin(angle) * (y - 0.5) > edge)
    error = arrives.sum(axis=1) - visible * shot.sum(axis=1)
    variance = rays * len(down) * share * visible * (1 - visible)
    assert np.sqrt(np.mean(error**2 / (variance + 0.05))) < limit
