"""Reflections in mirrors, whose images are known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion

from mitsplat.arrays import Float64Array
from mitsplat.gaussians.spherical_harmonics import SH_C0, evaluate_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.renderer.light import reflections
from mitsplat.renderer.light.reflections import COLUMN_STEP, RAY_STEP, ROW_STEP, Reflections, ReflectionTracer
from mitsplat.renderer.light.shadow_rays import ROBERTS
from mitsplat.renderer.materials.principled import typical_brightness
from tests.renderer.test_bounce import mitsuba_camera
from tests.renderer.test_light import WHITE_SKY, down_camera, floor, noise_free, nothing, slab

CAMERA = Camera.look_at((0, -0.6, 0.5), (0, 0, 0), width=120, height=90, fov_x=50)
LAMP_CENTRE, LAMP_HALF = np.array([0.05, 0.35, 0.4]), 0.08


def round_splats(points: npt.NDArray[np.float64], size: float, materials: SplatMaterials | None = None) -> Splats:
    """Return grey, almost opaque Gaussians of one standard deviation [m]."""
    count = len(points)
    return Splats(
        points,
        np.tile([0, 0, 0, 1.0], (count, 1)),
        np.full((count, 3), size),
        np.full(count, 0.99),
        np.zeros((count, 1, 3)),
        materials=materials,
    )


def mirror(roughness: float) -> mi.Shape:
    """Return a metal floor of base colour 1 as instance 1."""
    materials = SplatMaterials.uniform(len(floor()), metallic=1.0, roughness=roughness)
    return make_splats_shape(replace(floor(), materials=materials), proxy=slab(), instance=1)


def furnace(metallic: float, roughness: float, albedo: float) -> tuple[mi.Scene, Camera]:
    """Return a sphere of a material under uniform light of radiance 1, and a camera."""
    make_integrator()
    ball = trimesh.creation.icosphere(4, 0.1)
    surfels = place_surfels(ball, 1.0, 4000, np.random.default_rng(0))
    splats = surfels.splats(np.full((len(surfels.points), 1, 3), (encode_srgb(albedo) - 0.5) / SH_C0))
    materials = SplatMaterials.uniform(len(splats), metallic=metallic, roughness=roughness, specular=0.0)
    sphere = make_splats_shape(replace(splats, materials=materials), proxy=ball, instance=1)
    camera = Camera.look_at((0, -0.6, 0.3), (0, 0, 0), width=64, height=48, fov_x=25)
    return mi.load_dict({"type": "scene", "sphere": sphere, "sky": WHITE_SKY}), camera


@pytest.mark.parametrize(
    "steps",
    [
        (RAY_STEP,),
        (COLUMN_STEP,),
        (ROW_STEP,),
        (COLUMN_STEP + ROW_STEP,),
        (COLUMN_STEP - ROW_STEP,),
        (COLUMN_STEP, ROW_STEP),
        (COLUMN_STEP, RAY_STEP),
        (ROW_STEP, RAY_STEP),
    ],
)
def test_rays_of_rows_columns_and_blocks_are_even(steps: tuple[int, ...]) -> None:
    """The smallest distance of n points on a torus is at least 0.43 of that of a hexagonal lattice.

    That is sqrt(2 / (sqrt(3) n)), the largest distance possible.
    """
    numbers = sum(np.arange(8)[(slice(None), *[None] * i)] * step for i, step in enumerate(steps)).ravel()
    points = np.stack([numbers * factor % 2**32 for factor in ROBERTS], axis=1) / 2**32
    differences = (points[:, None] - points)[~np.eye(len(points), dtype=bool)]
    distance = np.linalg.norm(differences - np.rint(differences), axis=1).min()
    assert distance > 0.43 * np.sqrt(2 / (np.sqrt(3) * len(points)))


@pytest.mark.parametrize(("metallic", "albedo"), [(1.0, 1.0), (0.0, 0.6)])
def test_sphere_in_a_white_furnace_shows_its_albedo(metallic: float, albedo: float) -> None:
    """Under uniform light of radiance 1, a lossless mirror shows this light, and a diffuse sphere its albedo.

    The mean has an error below 0.3 %, and single pixels have the target error of the rays, 0.03.
    """
    scene, camera = furnace(metallic, 0.1, albedo)
    layers = render_layers(make_integrator(white=np.pi, hide_emitters=True), scene, camera)
    inside = layers.alpha > 0.999
    assert inside.mean() > 0.2
    assert layers.rgb[inside].mean() == pytest.approx(albedo, rel=0.003)
    assert np.sqrt(np.mean((layers.rgb[inside] / albedo - 1) ** 2)) < 0.03


def test_number_of_rays_depends_on_the_light_and_not_on_chance() -> None:
    """The mean over a rough metal ball is that with equal numbers of rays.

    Few neighbours mirror similar directions. If a pixel stopped at a small variance of its own rays, the ball would be
    3 % brighter.
    """
    scene, camera = furnace(metallic=1.0, roughness=0.3, albedo=1.0)
    few, many = (
        render_layers(make_integrator(white=np.pi, hide_emitters=True, **options), scene, camera)
        for options in ({}, {"shadow_error": 0.0, "shadow_samples": 128})
    )
    inside = few.alpha > 0.999
    assert few.rgb[inside].mean() == pytest.approx(many.rgb[inside].mean(), rel=0.006)


def lamp(radiance: list[float]) -> dict[str, Any]:
    """Return a horizontal square lamp that shines downwards."""
    pose = mi.ScalarTransform4f().translate(LAMP_CENTRE.tolist()).rotate([1, 0, 0], 180).scale(LAMP_HALF)
    return {
        "type": "rectangle",
        "to_world": pose,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }


def mirrored_lamp() -> npt.NDArray[np.bool_]:
    """Return the pixels (H, W) whose centres show the image of the lamp in the plane z = 0."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    slopes = CAMERA.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ CAMERA.world_from_camera[:3, :3].T
    image = LAMP_CENTRE * (1, 1, -1)
    at = CAMERA.centre + rays * ((image[2] - CAMERA.centre[2]) / rays[:, 2])[:, None]
    inside = (np.abs(at - image)[:, :2] < LAMP_HALF).all(axis=1) & (rays[:, 2] < 0)
    return np.asarray(inside.reshape(CAMERA.height, CAMERA.width))


def test_mirror_shows_the_lamp_at_the_place_and_with_the_size_of_its_image() -> None:
    make_integrator()
    scene = mi.load_dict({"type": "scene", "floor": mirror(0.02), "lamp": lamp([2.0, 1.0, 0.5])})
    light = render_layers(make_integrator(white=np.pi, hide_emitters=True), scene, CAMERA).light
    expected = mirrored_lamp()
    assert expected.sum() > 150
    seen = light[..., 0] > 1.0
    assert (seen & expected).sum() / (seen | expected).sum() > 0.9
    np.testing.assert_allclose(light[expected].mean(axis=0), [2.0, 1.0, 0.5], rtol=0.03)


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.5])
def test_small_mirroring_ball_reflects_all_light_of_a_lamp(shift: float) -> None:
    """The image of the lamp is smaller than a pixel; its light does not depend on its place in the pixel.

    A convex mirror of radius r has the focal length f = r / 2. A lamp of area A at the distance p has an image of area
    A f^2 / (p + f)^2 at the distance p f / (p + f) behind the mirror.
    """
    make_integrator()
    radius, size, radiance = 0.02, 0.06, 1000.0
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), width=40, height=40, fov_x=5.7, up=(0, 1, 0))
    x = shift / camera.fx
    ball = trimesh.creation.icosphere(4, radius).apply_translation((x, x, 0))
    points = ball.triangles_center
    materials = SplatMaterials.uniform(len(points), metallic=1.0, roughness=0.1)
    splats = round_splats(points, 5e-4, materials)
    place = mi.ScalarPoint3f(0.15, 0, 1)
    pose = mi.ScalarTransform4f().look_at(place, mi.ScalarPoint3f(0), mi.ScalarVector3f(0, 1, 0)).scale(size / 2)
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    rectangle = {"type": "rectangle", "to_world": pose, "emitter": emitter}
    scene = mi.load_dict(
        {"type": "scene", "ball": make_splats_shape(splats, proxy=ball, instance=1), "lamp": rectangle}
    )
    layers = render_layers(make_integrator(white=np.pi, hide_emitters=True), scene, camera)
    light = (layers.light + layers.highlight)[..., 0]
    seen = light[layers.instance == 1].sum() / camera.fx**2
    focal, away = radius / 2, float(np.linalg.norm(place)) - radius
    image = away * focal / (away + focal)
    expected = radiance * size**2 * (focal / (away + focal)) ** 2 / (1 - radius + image) ** 2
    assert seen == pytest.approx(expected, rel=0.07)


@pytest.mark.parametrize("roughness", [0.1, 0.3])
def test_metal_shows_the_highlights_of_another_metal_as_bright_as_a_path_tracer(roughness: float) -> None:
    """A metal plate mirrors a metal ball that mirrors a small lamp, which is below the plane of the plate.

    The highlight contains the light of the lamp, and pixels with many rays do not brighten their neighbours.
    """
    make_integrator()
    grey, radius, height, extent = 0.5, 0.05, 0.1, 0.2
    ball = trimesh.creation.icosphere(4, radius).apply_translation((0, 0, height))
    of_ball = SplatMaterials.uniform(len(ball.faces), metallic=1.0, roughness=0.4)
    of_plate = SplatMaterials.uniform(len(floor()), metallic=1.0, roughness=roughness)
    place = mi.ScalarPoint3f(1, 0, -height)
    pose = mi.ScalarTransform4f().look_at(place, mi.ScalarPoint3f(0, 0, height), mi.ScalarVector3f(0, 0, 1)).scale(0.03)
    rectangle = {**lamp([10000.0] * 3), "to_world": pose}
    splats = {
        "plate": make_splats_shape(replace(floor(extent, grey), materials=of_plate), proxy=slab(extent), instance=1),
        "ball": make_splats_shape(round_splats(ball.triangles_center, 2e-3, of_ball), proxy=ball, instance=2),
    }
    scene = mi.load_dict({"type": "scene", **splats, "lamp": rectangle})
    many, few = (
        [render_layers(make_integrator(white=np.pi, **options), scene, CAMERA, seed=seed) for seed in range(2)]
        for options in ({"shadow_error": 0.0, "shadow_samples": 256}, {})
    )

    def metal(shape: str, roughness: float, **properties: Any) -> dict[str, Any]:
        colour = {"type": "rgb", "value": float(decode_srgb(grey))}
        bsdf = {"type": "principled", "base_color": colour, "metallic": 1.0, "roughness": roughness}
        return {"type": shape, "bsdf": bsdf, **properties}

    meshes = {
        "plate": metal("rectangle", roughness, to_world=mi.ScalarTransform4f().scale(extent)),
        "ball": metal("sphere", 0.4, center=[0, 0, height], radius=radius),
    }
    scene = mi.load_dict({"type": "scene", **meshes, "lamp": rectangle})
    path = mi.load_dict({"type": "path", "max_depth": 8, "hide_emitters": True})
    photo = np.array(mi.render(scene, sensor=mitsuba_camera(CAMERA), integrator=path, spp=256))[..., :3]
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    image = CAMERA.project(np.array([[0, 0, -height]]))[0][0]
    reach = 2 * CAMERA.fx * radius / np.linalg.norm(CAMERA.centre - (0, 0, -height))
    away = ~binary_dilation(many[0].instance == 2, iterations=2)
    around = (np.hypot(x - image[0], y - image[1]) < reach) & (many[0].instance == 1) & away
    assert around.sum() > 500
    exact, usual = (np.mean([layer.rgb[around].mean() for layer in layers]) for layers in (many, few))
    assert exact == pytest.approx(photo[around].mean(), rel=0.05)
    assert usual == pytest.approx(exact, rel=0.1)


def test_a_matt_object_before_metal_surroundings_mirrors_nothing() -> None:
    """A point light at distance sqrt(2), 45 degrees beside the normal, gives the irradiance I cos / d^2 = I / 8^0.5."""
    make_integrator()

    def of_material(splats: Splats, metallic: float) -> Splats:
        uniform = SplatMaterials.uniform(len(splats), metallic=metallic, roughness=0.3, specular=0.0)
        return replace(splats, materials=uniform)

    shapes = {
        "metal": make_splats_shape(of_material(floor(1.0, z=-0.2), 1.0), proxy=slab(1.0, -0.2)),
        "matt": make_splats_shape(of_material(floor(0.3), 0.0), proxy=slab(0.3), instance=1),
        "lamp": {"type": "point", "position": [1, 0, 1], "intensity": 6.0},
    }
    integrator = make_integrator(bounce=False, white=float(np.pi))
    seen = render_layers(integrator, mi.load_dict({"type": "scene", **shapes}), down_camera())
    assert (seen.instance[14:18, 14:18] == 1).all()
    np.testing.assert_allclose(seen.light[14:18, 14:18].mean(), 6 / 8**0.5 / np.pi, rtol=1e-3)
    assert not seen.highlight[14:18, 14:18].any()


def test_mirror_shows_an_object_at_its_image() -> None:
    """A grey box on the mirror, upside down: the mirror image lies below the box, where the sky is white elsewhere."""
    make_integrator()
    box = trimesh.creation.box(bounds=[[-0.05, 0.1, 0.02], [0.05, 0.2, 0.12]])
    points = trimesh.sample.sample_surface(box, 3000, seed=1)[0]
    grey = round_splats(points, 2e-3)
    thing = make_splats_shape(grey, proxy=box, instance=2)
    scene = mi.load_dict({"type": "scene", "floor": mirror(0.02), "thing": thing, "sky": WHITE_SKY})
    light = render_layers(make_integrator(white=np.pi, hide_emitters=True), scene, CAMERA)
    image = box.copy()
    image.vertices[:, 2] *= -1
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    slopes = CAMERA.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ CAMERA.world_from_camera[:3, :3].T
    low, high = image.bounds
    with np.errstate(divide="ignore"):
        first, second = (low - CAMERA.centre) / rays, (high - CAMERA.centre) / rays
    met = np.minimum(first, second).max(axis=1) < np.maximum(first, second).min(axis=1)
    floor_seen = light.instance == 1
    expected = met.reshape(CAMERA.height, CAMERA.width) & floor_seen
    seen = (light.light[..., 0] < 0.75) & floor_seen
    assert expected.sum() > 100
    assert (seen & expected).sum() / (seen | expected).sum() > 0.85


@pytest.mark.parametrize("lanes", [reflections.LANES, 3])
def test_each_ray_of_a_pixel_takes_the_next_number_of_its_sequence(monkeypatch: pytest.MonkeyPatch, lanes: int) -> None:
    """Sums over the numbers of the rays equal those of a loop, also if the rays are traced in parts."""
    make_integrator()
    monkeypatch.setattr(reflections, "LANES", lanes)
    pixel, begin, step = np.array([3, 10, 40, 41]), np.array([0, 2, 0, 1]), np.array([1, 4, 4, 1])
    places, done, rays = np.array([2, 0, 3]), np.array([0, 3, 1]), np.array([4, 1, 5])

    def light(_: Any, places: mi.UInt32, number: mi.UInt32) -> tuple[mi.Color3f, mi.Color3f]:
        return mi.Color3f(mi.Float(number % 1009)), mi.Color3f(mi.Float(places))

    monkeypatch.setattr(ReflectionTracer, "_light", light)
    steps = mi.UInt32(begin), mi.UInt32(step)
    stub: Any = SimpleNamespace(pixel=mi.UInt32(pixel), view=SimpleNamespace(width=7), seed=5)
    tracer = ReflectionTracer(stub, stub, steps)
    got = tracer.trace(mi.UInt32(places), mi.Float(done), mi.UInt32(rays))
    for row, (place, before, count) in enumerate(zip(places, done, rays, strict=True)):
        y, x = divmod(int(pixel[place]), 7)
        start = 5 * 2654435761 + x * COLUMN_STEP + y * ROW_STEP
        numbers = [start + (begin[place] + (before + i) * step[place]) * RAY_STEP for i in range(count)]
        values = np.array([number % 2**32 % 1009 for number in map(int, numbers)], dtype=np.float64)
        brightness = np.array(typical_brightness(mi.Color3f(mi.Float(values)), mi.Color3f(mi.Float(place))))
        assert np.array(got.tinted.x)[row] == pytest.approx(values.sum())
        assert np.array(got.colourless.z)[row] == count * place
        assert np.array(got.squares)[row] == pytest.approx((brightness**2).sum(), rel=1e-5)
    assert np.array(got.rays).tolist() == rays.tolist()


@pytest.mark.parametrize("valid", [16, 8, 4])
def test_variance_is_that_of_the_rays_that_start_at_a_surface(valid: int) -> None:
    """At an outline, some points of a pixel miss the surface; the pixel shows the mean of the other points.

    The mean of the estimated variances over many pixels is the variance of their brightness.
    """
    make_integrator()
    pixels, rays = 50_000, 16
    light = np.random.default_rng(0).lognormal(size=(pixels, rays)) * (np.arange(rays) < valid)
    grey = mi.Color3f(mi.Float(light.ravel().astype(np.float32)))
    brightness = np.array(typical_brightness(grey, mi.Color3f(0))).reshape(pixels, rays)
    sums = [mi.Float(values.sum(axis=1).astype(np.float32)) for values in (light, brightness**2)]
    every = Reflections(mi.Color3f(sums[0]), mi.Color3f(0), sums[1], dr.full(mi.Float, rays, pixels))
    shown = every.of_valid(mi.Float(valid / rays))
    assert np.allclose(np.array(shown.rays), valid)
    expected = (brightness.sum(axis=1) / valid).var()
    assert np.array(shown.variance).mean() == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("matrix", [np.eye(3), 0.9 * np.eye(3)[[1, 2, 0]]], ids=["captured", "changed"])
def test_mirror_shows_captured_colours_of_its_directions(matrix: Float64Array) -> None:
    """A captured ceiling is brighter at grazing angles: a small mirror shows 0.5 + sum_k sh_k Y_k(d), decoded.

    The matrix of an appearance applies to these linear colours.
    """
    make_integrator()
    sh = np.zeros((1600, 4, 3))
    sh[:, 1:, 0], sh[:, 1:, 1], sh[:, 2, 2] = 0.1, (-0.1, 0.05, 0.1), -0.2
    small = replace(floor(0.05), materials=SplatMaterials.uniform(1600, metallic=1.0, roughness=0.02))
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))
    ceiling = replace(floor(4.0, z=1.0), sh=sh).transformed(turn.T)
    colours = {} if np.array_equal(matrix, np.eye(3)) else {"colours": " ".join(map(str, matrix.ravel()))}
    scene = {
        "type": "scene",
        "mirror": make_splats_shape(small, proxy=slab(0.05), instance=1),
        "ceiling": make_splats_shape(ceiling, turn, proxy=slab(4.0, top=1.0).apply_transform(turn.T), **colours),
        "sky": WHITE_SKY,
    }
    camera = Camera.look_at((0.3, -0.6, 0.5), (0, 0, 0), width=40, height=30, fov_x=5)
    layers = render_layers(make_integrator(white=np.pi, hide_emitters=True), mi.load_dict(scene), camera)
    along = camera.world_from_camera[:3, 2] * (1, 1, -1)
    expected = matrix @ decode_srgb(evaluate_sh(sh[0], along))
    assert np.ptp(expected) > 0.1
    inside = binary_erosion(layers.instance == 1, iterations=2)
    seen = (layers.light + layers.highlight)[inside].mean(axis=0)
    np.testing.assert_allclose(seen, expected, rtol=0.02)


@pytest.mark.parametrize("wall", [0.1, 0.9])
def test_object_before_a_wall_blocks_the_light_of_the_wall_and_not_of_the_sky(wall: float) -> None:
    """A captured wall of radiance L hides half of a sky of radiance 1, and a black screen the wall.

    The floor, which a metal plate mirrors, loses L / (1 + L) of its light. :meth:`CapturedHits.arriving_share` gives
    L / 2, because it chooses directions by the light of the sky alone.
    """
    make_integrator()
    plate = trimesh.creation.box(bounds=[[0.15, 0.1, 0.0], [0.28, 0.11, 0.1]])
    surfels = place_surfels(plate, 1.0, 4000, np.random.default_rng(0))
    metal = SplatMaterials.uniform(len(surfels.points), metallic=1.0, roughness=0.05)
    splats = replace(surfels.splats(np.zeros((len(surfels.points), 1, 3))), materials=metal)
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0))
    shapes = {
        "plate": make_splats_shape(splats, proxy=plate, instance=1),
        "sky": WHITE_SKY,
    }
    tall = trimesh.creation.box(bounds=[[0.3, -500, -500], [0.4, 500, 500]])
    sheet = floor(0.4, wall).transformed(turn @ trimesh.transformations.translation_matrix((0, 0, 0.3)))
    both = trimesh.util.concatenate([slab(), tall])
    shapes["floor"] = make_splats_shape(Splats.concatenate([floor(0.4), sheet]), proxy=both)
    screen = trimesh.creation.box(bounds=[[0.29, -500, 0.001], [0.299, 500, 500]])
    camera = Camera.look_at((0.2, -0.5, 0.4), (0.2, 0.1, 0.04), width=48, height=36, fov_x=12)
    light = []
    for more in ({}, {"screen": make_splats_shape(nothing(), proxy=screen, instance=2)}):
        layers = noise_free({**shapes, **more}, camera, white=np.pi)
        light.append(layers.light[binary_erosion(layers.instance == 1, iterations=2)].mean())
    radiance = float(decode_srgb(wall))
    assert light[1] / light[0] == pytest.approx(1 - radiance / 2, abs=0.05)


def test_reflections_at_a_silhouette_are_averaged() -> None:
    """A flat metal plate mirrors a white sky of which a black ceiling hides one half.

    The sample points of a pixel of its outline mirror the same direction, so that the pixel is averaged with its
    neighbours.
    """
    make_integrator()
    plate = floor(0.1)
    plate = replace(plate, materials=SplatMaterials.uniform(len(plate), metallic=1.0, roughness=0.6))
    ceiling = trimesh.creation.box(bounds=[[0, -9, 1.5], [9, 9, 1.6]])
    scene = {
        "type": "scene",
        "ground": make_splats_shape(floor(1.0, z=-0.3), proxy=slab(top=-0.3)),
        "plate": make_splats_shape(plate, proxy=slab(0.12), instance=1),
        "ceiling": make_splats_shape(nothing(), proxy=ceiling, instance=2),
        "sky": WHITE_SKY,
    }
    layers = render_layers(make_integrator(white=np.pi), mi.load_dict(scene), down_camera(size=96, fov=14))
    rows, columns = (np.flatnonzero((layers.instance == 1).any(axis=axis)) for axis in (1, 0))
    light = layers.light[rows[0] : rows[-1] + 1, columns[4] : columns[-4], 0]
    beside, outline = (np.diff(light[some]).std() for some in ([3, -4], [0, -1]))
    assert beside < 0.003
    assert outline < 0.012  # 0.017 without averages


def test_noise_of_rays_leaves_no_streaks_on_a_tube() -> None:
    """The light on a metal tube differs from that of many rays by less than 5.5 % of its mean.

    Only pixels along the axis mirror similar directions. Averages over these alone leave streaks of 7 %.
    """
    make_integrator()
    tube = trimesh.creation.annulus(0.12, 0.15, 0.16, sections=128).apply_translation((0, 0, 0.08))
    surfels = place_surfels(tube, 1.0, 8000, np.random.default_rng(0))
    splats = surfels.splats(np.full((len(surfels.points), 1, 3), (encode_srgb(0.6) - 0.5) / SH_C0))
    splats = replace(splats, materials=SplatMaterials.uniform(len(splats), metallic=1.0, roughness=0.25))
    scene = {
        "type": "scene",
        "floor": make_splats_shape(floor(1.0), proxy=slab()),
        "tube": make_splats_shape(splats, proxy=tube, instance=1),
        "lamp": lamp([8.0, 8.0, 8.0]),
        "sky": {"type": "constant", "radiance": 0.3},
    }
    camera = Camera.look_at((0, -0.7, 0.6), (0, 0, 0.1), width=96, height=64, fov_x=28)
    scene = mi.load_dict(scene)
    few, many = (
        render_layers(make_integrator(white=np.pi, **options), scene, camera)
        for options in ({}, {"shadow_error": 0.0, "shadow_samples": 256})
    )
    side = binary_erosion((few.instance == 1) & (np.abs(few.normal[..., 2]) < 0.5), iterations=2)
    side &= few.normal[..., 1] < -0.6
    assert side.sum() > 1500
    expected = many.light[side].mean(axis=1)
    error = few.light[side].mean(axis=1) - expected
    assert error.std() < 0.055 * expected.mean()
