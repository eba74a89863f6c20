"""Light averaged over the footprint of a pixel on curved surfaces, and its noise estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from scipy.ndimage import binary_dilation

from mitsplat.arrays import Float32Array
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.renderer.light import light_points as footprint
from mitsplat.renderer.light import traced_pixels
from mitsplat.renderer.light.light_estimate import Estimate
from mitsplat.renderer.light.light_filter import GAIN, SMALL_FILTER_PIXELS, UNTRACED, LightFilter
from mitsplat.renderer.light.light_points import OFFSETS, LightPoints
from mitsplat.renderer.light.light_tiles import STRIDE
from mitsplat.renderer.light.lit_surface import LitSurface
from mitsplat.renderer.light.reflections import RAY_STEP
from mitsplat.renderer.light.shadow_rays import RECURRENCE, ROBERTS
from mitsplat.renderer.rays.camera_rays import CameraView
from tests.renderer.test_light import down_camera, floor, render
from tests.renderer.test_reflections import round_splats

SIZE, FINER, RAYS = 24, 4, 64


def ridges(period: float, slope: float, extent: float = 0.5) -> trimesh.Trimesh:
    """Return a roof of many ridges along y, whose tops are at z = 0."""
    count = int(2 * extent / period)
    x = np.linspace(-extent, extent, 2 * count + 1)
    z = np.where(np.arange(len(x)) % 2, 0.0, -slope * period / 2)
    vertices = np.concatenate([np.stack([x, np.full_like(x, y), z], axis=1) for y in (-extent, extent)])
    left = np.arange(2 * count)
    far = left + len(x)
    faces = np.concatenate([np.stack([left, left + 1, far], 1), np.stack([left + 1, far + 1, far], 1)])
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize("bent", [[], [4, 1, 6]])
def test_sums_by_pixel_add_the_points_of_bent_pixels(bent: list[int]) -> None:
    make_integrator()
    count, points = 8, len(OFFSETS)
    slot = np.full(count, UNTRACED, np.uint32)
    slot[bent] = np.arange(len(bent))
    owner = np.concatenate([np.arange(count), np.tile(bent, points)]).astype(np.uint32)
    surface: Any = None
    places = LightPoints(surface, mi.UInt32(owner), mi.UInt32(slot), mi.UInt32(bent), count, len(bent))
    values = np.random.default_rng(0).random((4, len(owner))).astype(np.float32)
    lit, squares = mi.Color3f(*[mi.Float(row) for row in values[:3]]), mi.Float(values[3])
    sums = places.sums_by_pixel(Estimate(lit, lit, lit, lit, squares, squares, squares))
    expected = values[:, :count].copy()
    for number, pixel in enumerate(bent):
        expected[:, pixel] = values[:, count + number :: len(bent)].sum(axis=1)
    assert np.allclose(np.array(sums.lit), expected[:3], rtol=1e-6)
    assert np.allclose(np.array(sums.rays), expected[3], rtol=1e-6)


@pytest.mark.parametrize("factors", [np.multiply(RECURRENCE, STRIDE), np.multiply(ROBERTS, RAY_STEP)])
@pytest.mark.parametrize("rays", [2, 4, 8])
def test_rays_of_one_point_and_of_all_points_are_even(factors: npt.NDArray[np.int64], rays: int) -> None:
    """The smallest distance of n rays on a torus is at least 0.39 of that of a hexagonal lattice.

    That is sqrt(2 / (sqrt(3) n)), the largest distance possible.
    """
    make_integrator()
    surface: Any = None
    points = LightPoints(surface, mi.UInt32([0] * 5), mi.UInt32([0]), mi.UInt32([0]), 1, 1)
    rows = dr.arange(mi.UInt32, 5)
    start, step = (np.array(v, dtype=np.int64)[1:] for v in points.steps(rows))
    assert np.array(points.ray_count(mi.UInt32(4 * rays), rows)).tolist() == [4 * rays, *[rays] * 4]
    assert np.array(points.ray_count(mi.UInt32(3), rows)).tolist() == [3, 1, 1, 1, 1]
    numbers = start[:, None] + step[:, None] * np.arange(rays)
    for own in (*numbers, numbers.ravel()):
        at = own[:, None] * (factors % 2**32) % 2**32 / 2**32
        differences = (at[:, None] - at)[~np.eye(len(at), dtype=bool)]
        distance = np.linalg.norm(differences - np.rint(differences), axis=1).min()
        assert distance > 0.39 * np.sqrt(2 / (np.sqrt(3) * len(at)))


def test_metal_ridges_below_a_lamp_and_a_sky_are_even() -> None:
    """Each point of a bent pixel samples all emitters, so that a ridge below a lamp has no black pixels.

    The error is that of three renderings with few rays against one with many. It is 0.030 if the rays of a point sample
    the same part of the emitters.
    """
    make_integrator()
    pixel = 2 * np.tan(np.radians(10)) / SIZE
    metal = SplatMaterials.uniform(len(floor(0.5)), metallic=1.0, roughness=0.34)
    lamp = mi.ScalarTransform4f().look_at(origin=[0.6, 0, 2], target=[0, 0, 0], up=[0, 1, 0]).scale(0.1)
    shapes = {
        "ridges": make_splats_shape(
            replace(floor(0.5), materials=metal),
            proxy=ridges(2.2 * pixel, 0.3),
            instance=1,
            capture_light="uniform",
        ),
        "lamp": {
            "type": "rectangle",
            "to_world": lamp,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 60.0}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
    }
    scene, camera = mi.load_dict({"type": "scene", **shapes}), down_camera(size=SIZE)

    def inner(error: float, rays: int, seed: int) -> Float32Array:
        integrator = make_integrator(shadow_error=error, shadow_samples=rays)
        return render_layers(integrator, scene, camera, seed=seed).rgb[2:-2, 2:-2]

    many = inner(0, 1024, 3)
    errors = [np.mean((inner(0.03, 256, seed) - many) ** 2) for seed in range(3)]
    assert many.mean() > 0.15
    assert np.sqrt(np.mean(errors)) < 0.023


def test_ridges_finer_than_a_pixel_have_the_mean_light_of_its_points(monkeypatch: pytest.MonkeyPatch) -> None:
    make_integrator()
    pixel = 2 * np.tan(np.radians(10)) / SIZE
    lamp = mi.ScalarTransform4f().look_at(origin=[1.2, 0, 2], target=[0, 0, 0], up=[0, 1, 0]).scale(0.1)
    shapes = {
        "ridges": make_splats_shape(
            floor(0.5),
            proxy=ridges(0.7 * pixel, 0.3),
            instance=1,
            capture_light="uniform",
            roughness=0.4,
            specular=0.5,
        ),
        "lamp": {
            "type": "rectangle",
            "to_world": lamp,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 100.0}},
        },
    }
    own = render(shapes, down_camera(size=SIZE), samples=RAYS)
    monkeypatch.setattr(traced_pixels, "bent_pixels", lambda here, *_: here.instance < 0)
    middles = render(shapes, down_camera(size=SIZE), samples=RAYS)
    large = render(shapes, down_camera(size=SIZE * FINER), samples=RAYS)
    inner = slice(2, -2)  # border pixels lack neighbours
    for name, noise in (("light", 2e-3), ("highlight", 0.015)):
        fine = getattr(large, name).reshape(SIZE, FINER, SIZE, FINER, 3)
        at = [tuple(int(FINER * (0.5 + v)) for v in offset) for offset in OFFSETS]
        twin = np.mean([fine[:, y, :, x] for x, y in at], axis=0)[inner, inner]
        assert np.sqrt(np.mean((getattr(own, name)[inner, inner] - twin) ** 2)) < noise
        assert np.sqrt(np.mean((getattr(middles, name)[inner, inner] - twin) ** 2)) > 4 * noise


@pytest.mark.parametrize("pixels_of_radius", [4.5, 5.5, 6.5, 9.0])
def test_a_rough_bevel_of_a_few_pixels_mirrors_a_lamp_as_bright_as_a_larger_image(pixels_of_radius: float) -> None:
    """The normals of adjacent pixels differ by 6 to 14 degrees; the lobe is 2 degrees wide.

    An isotropic lobe of the same variance has 0.61 to 0.81 of the light: it is also wider along the bevel.
    """
    make_integrator()
    camera, sizes = down_camera(size=32), (1, 5)
    radius = pixels_of_radius * 2 * np.tan(np.radians(10)) / 32
    turn = trimesh.transformations.rotation_matrix(np.radians(90), [1, 0, 0])
    bar = trimesh.creation.cylinder(radius, 2 * radius, sections=256, transform=turn)
    points = trimesh.sample.sample_surface(bar, 4000, seed=0)[0]
    splats = round_splats(points, radius / 20, SplatMaterials.uniform(len(points), metallic=1.0, roughness=0.2))
    lamp = mi.ScalarTransform4f().look_at(origin=[1, 0.1, 1.5], target=[0, 0, 0], up=[0, 0, 1]).scale(0.05)
    shapes = {
        "bar": make_splats_shape(splats, proxy=bar, instance=1),
        "lamp": {
            "type": "rectangle",
            "to_world": lamp,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 100.0}},
        },
    }
    images = [render(shapes, camera.resized(32 * size, 32 * size), samples=64) for size in sizes]
    small, large = (image.highlight.mean() for image in images)
    assert small == pytest.approx(large, rel=0.12)


def test_meshes_beside_an_object_have_the_mean_light_of_their_points() -> None:
    """The shadow of a plate covers parts of the pixels of the mesh along its edges."""
    make_integrator()
    turn = trimesh.transformations.rotation_matrix(np.radians(10), [0, 0, 1])
    plate = trimesh.creation.box(bounds=[[-0.1, -0.1, 0.01], [0.1, 0.1, 0.012]])
    shapes = {
        "mesh": {"type": "rectangle"},
        "plate": make_splats_shape(floor(0.097, z=0.012), turn, plate, instance=1, capture_light="uniform"),
        "lamp": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at(origin=[3, 1, 3], target=[0, 0, 0], up=[0, 0, 1]).scale(0.1),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 2000.0}},
        },
    }
    own, large = (render(shapes, down_camera(size=zoom * SIZE), samples=RAYS) for zoom in (1, FINER))
    fine, on_mesh = (
        values.reshape(SIZE, FINER, SIZE, FINER) for values in (large.light[..., 0], large.proxy_instance == 0)
    )
    at = [tuple(int(FINER * (0.5 + v)) for v in offset) for offset in OFFSETS]
    valid = np.array([on_mesh[:, y, :, x] for x, y in at])
    twin = np.sum([fine[:, y, :, x] for x, y in at], axis=0, where=valid) / np.maximum(valid.sum(axis=0), 1)
    is_mesh = own.instance == 0
    beside = is_mesh & binary_dilation(~is_mesh, np.ones((3, 3))) & (own.proxy_instance == 0) & valid.any(axis=0)
    assert beside.sum() > 50
    assert np.sqrt(np.mean((own.light[..., 0] - twin)[beside] ** 2)) < 0.1  # 0.15 with light at the centres


def test_lobes_of_pixels_include_the_spread_of_normals() -> None:
    """Slow twin of the covariance of slopes, over traced neighbours of one shape without an edge."""
    make_integrator()
    size, rng = 9, np.random.default_rng(4)
    camera = down_camera(size=size)
    view = CameraView(size, size, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_from_camera)
    index = np.flatnonzero(rng.random(size * size) < 0.9).astype(np.uint32)  # the others have no traced light
    place = np.full(size * size, UNTRACED, dtype=np.uint32)
    place[index] = np.arange(len(index))
    normal = np.array([0, 0, 1]) + rng.normal(scale=0.12, size=(len(index), 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    trait, roughness = np.float32(index // size > 5), rng.uniform(0.1, 0.6, len(index))
    to_camera = np.array([0.6, 0, 0.8])
    expected = []
    for row, pixel in enumerate(index):
        y, x = divmod(int(pixel), size)
        tangent = np.eye(3) - np.outer(normal[row], normal[row])
        slopes = roughness[row] ** 4 * tangent
        for right, down in ((1, 0), (0, 1)):
            steps = []
            for sign in (-1, 1):
                i, j = x + sign * right, y + sign * down
                other = place[j * size + i] if 0 <= i < size and 0 <= j < size else UNTRACED
                alike = other != UNTRACED and trait[other] == trait[row]
                if alike and normal[other] @ normal[row] > footprint.EVEN:
                    steps.append(sign * tangent @ normal[other])
            step = np.mean(steps, axis=0) if steps else np.zeros(3)
            slopes += 2 * np.outer(step, step) / 4 * (normal[row] @ to_camera) ** 4
        expected.append(slopes)
    values: dict[str, Any] = dict.fromkeys(LitSurface.__dataclass_fields__, mi.Float(0))
    values |= {"normal": mi.Vector3f(normal.T.astype(np.float32)), "to_camera": mi.Vector3f(to_camera)}
    values |= {"trait": mi.Float(trait), "roughness": mi.Float(roughness.astype(np.float32))}
    got = footprint.filtered_lobes(LitSurface(**values), mi.UInt32(index), mi.UInt32(place), view)
    bend, own = np.array(got.bend, np.float64).T, np.array(got.roughness, np.float64)
    tangents = np.eye(3) - np.einsum("ni,nj->nij", normal, normal)
    slopes = own[:, None, None] ** 4 * tangents + np.einsum("ni,nj->nij", bend, bend)
    np.testing.assert_allclose(slopes, expected, rtol=1e-3, atol=1e-5)
    assert np.mean(np.linalg.norm(bend, axis=1) > 0.05) > 0.5
    assert np.mean(own > roughness + 1e-3) > 0.3


def test_pixels_without_similar_neighbours_get_the_saved_rays() -> None:
    make_integrator()
    camera = down_camera(size=9)
    view = CameraView(9, 9, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_from_camera)
    count, up = 81, mi.Vector3f(0, 0, 1)
    pixel = dr.arange(mi.UInt32, count)
    estimate = Estimate(
        *[mi.Color3f(v * dr.ones(mi.Float, count)) for v in (2.0, 4.0)],
        *[dr.full(mi.Float, v, count) for v in (0.0, 0.0, 36.0, 0.0, 4.0)],
    )

    def wanted(trait: Any) -> float:
        fields: dict[str, Any] = dict.fromkeys(LitSurface.__dataclass_fields__, mi.Float(0))
        fields |= {"position": dr.zeros(mi.Point3f, count), "normal": up, "trait": mi.Float(trait)}
        fields |= {"offset": mi.Float(1), "known": dr.full(mi.Bool, True, count)}
        rays, _ = LightFilter(LitSurface(**fields), view, pixel).rays_for(estimate, 0.03, mi.Float(1))
        return float(np.array(rays)[40])

    def twin(like: float, gain: float) -> float:
        draws = 4 * like
        share = (0.5 * draws + 0.5) / (draws + 1)
        return 4 * share * (1 - share) / draws / (gain * 0.03**2)

    assert wanted(dr.zeros(mi.Float, count)) == pytest.approx(twin(SMALL_FILTER_PIXELS, GAIN), rel=1e-4)
    assert wanted(pixel) == pytest.approx(twin(1, 1), rel=1e-4)


def test_the_number_of_rays_follows_perceived_brightness() -> None:
    """The rays follow equal display steps: fewest in bright light, more with a dark picture's exposure."""
    make_integrator()
    camera = down_camera(size=9)
    view = CameraView(9, 9, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_from_camera)
    count = 81
    fields: dict[str, Any] = dict.fromkeys(LitSurface.__dataclass_fields__, mi.Float(0))
    fields |= {"position": dr.zeros(mi.Point3f, count), "normal": mi.Vector3f(0, 0, 1), "offset": mi.Float(1)}
    fields |= {"known": dr.full(mi.Bool, True, count)}
    light_filter = LightFilter(LitSurface(**fields), view, dr.arange(mi.UInt32, count))

    def wanted(unshadowed: float, share: float = 0.5, **options: Any) -> float:
        estimate = Estimate(
            *[mi.Color3f(v * dr.ones(mi.Float, count)) for v in (4 * share, 4.0)],
            *[dr.full(mi.Float, v, count) for v in (0.0, 0.0, 36.0, 0.0, 4.0)],
        )
        return float(np.array(light_filter.rays_for(estimate, 0.03, mi.Float(unshadowed), **options)[0])[40])

    at_half = wanted(1.0)
    # The slope of v^(1/2.2) at v is the slope at 0.5 times (v / 0.5)^(1/2.2 - 1).
    for light in (0.06, 0.2, 0.5):
        steps = (light / 0.5) * (light / 0.5) ** (1 / 2.2 - 1)
        assert wanted(2 * light) / at_half == pytest.approx(steps**2, rel=1e-4)
    assert wanted(0.02) / at_half == pytest.approx((0.02 * (0.05 / 0.5) ** (1 / 2.2 - 1)) ** 2, rel=1e-4)
    for light in (1e-5, 0.03, 3.0, 1e5):  # auto-exposure removes the light level
        assert wanted(light, others=mi.UInt32(0)) == pytest.approx(at_half, rel=2e-3)
    # Nine in ten pixels have light 1, whose brightness equals that of half of the light.
    mean = (9 * 1 + 0.1 ** (1 / 2.2)) / 10
    own = 0.1 * 0.5 * mean**-2.2
    steps = (own / 0.5) ** (1 / 2.2)
    assert wanted(0.2, others=mi.UInt32(9 * count)) / at_half == pytest.approx(steps**2, rel=2e-3)
