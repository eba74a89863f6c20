"""Traced light against a slow computation in float64.

Each stage of :func:`mitsplat.renderer.light.light.light_factor` contributes to at least one of the comparisons.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.light_reference import Array, Box, BoxScene, Lamp
from tests.renderer.test_light import nothing

FLOOR, WALL = Box((-1.0, -1.0, -0.1), (0.0, 1.0, 0.0)), Box((-1.1, -1.0, -0.1), (-0.9, 1.0, 1.0))
OBJECT = Box((-0.35, -0.15, 0.0), (-0.05, 0.15, 0.1), dynamic=True)
NEAR_OBJECT = Box((-0.4, -0.2, 0.0), (0.0, 0.2, 0.1))
TABLE = Box((0.0, -1.0, -0.1), (1.0, 1.0, 0.0), dynamic=True, albedo=0.5, mesh=True)
OCCLUDER = Box((-0.1, 0.5, 0.3), (0.3, 0.7, 0.4), dynamic=True)
LAMP = Lamp((0.2, 1.6, 1.4), (0.0, 0.0, 0.0), 0.4, 60.0)
SKY, GREY, WHITE = 0.3, 0.8, float(np.pi)
ROUGHNESS, METALLIC, SPECULAR = 0.6, 0.4, 0.5
CAMERA = Camera.look_at((0, 0, 1.47), (0, 0, 0), up=(0, 1, 0), width=128, height=128, fov_x=40)
EYE = CAMERA.world_from_camera[:3, 3]
SEEDS = 4
MANY_SEEDS = 16
"""Number of seeds for reflected light, whose mean over all pixels has a standard deviation of 0.003 over seeds."""

Pixels = tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]
"""Rows and columns."""


def plane(low: tuple[float, float], high: tuple[float, float], z: float) -> Splats:
    """Return an opaque grey rectangle of Gaussians."""
    n = 40
    x, y = np.meshgrid(*(np.linspace(a, b, n) for a, b in zip(low, high, strict=True)))
    spacing = max(high[0] - low[0], high[1] - low[1]) / (n - 1)
    return Splats(
        np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], axis=1),
        np.tile([0, 0, 0, 1.0], (n * n, 1)),
        np.tile([0.7 * spacing, 0.7 * spacing, 0.01 * spacing], (n * n, 1)),
        np.full(n * n, 0.999),
        np.full((n * n, 1, 3), (GREY - 0.5) / SH_C0),
    )


def with_material(splats: Splats) -> Splats:
    materials = SplatMaterials.uniform(len(splats), metallic=METALLIC, roughness=ROUGHNESS, specular=SPECULAR)
    return replace(splats, materials=materials)


def mesh_of(*boxes: Box) -> trimesh.Trimesh:
    return trimesh.util.concatenate([trimesh.creation.box(bounds=[box.low, box.high]) for box in boxes])


def load_scene(*, matt: bool = False) -> mi.Scene:
    """Load the scene. The object is of a glossy material, or ``matt``."""
    make_integrator()
    lamp_pose = mi.ScalarTransform4f().look_at(origin=list(LAMP.position), target=list(LAMP.target), up=[0, 0, 1])
    top = plane(OBJECT.low[:2], OBJECT.high[:2], OBJECT.high[2])
    shapes = {
        "floor": make_splats_shape(plane((-1, -1), (0, 1), 0.0), proxy=mesh_of(FLOOR, WALL)),
        "object": make_splats_shape(top if matt else with_material(top), proxy=mesh_of(OBJECT), instance=1),
        "occluder": make_splats_shape(nothing(), proxy=mesh_of(OCCLUDER), instance=2),
        "table": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0.5, 0, 0]).scale([0.5, 1, 1]),
            "bsdf": {"type": "diffuse"},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": lamp_pose.scale(LAMP.edge / 2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": LAMP.radiance}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
    }
    return mi.load_dict({"type": "scene", **shapes})


@pytest.fixture(scope="module")
def pictures() -> tuple[Array, Array]:
    """Render light and highlight with several seeds, shape (seeds, H, W)."""
    return rendered(load_scene())


@pytest.fixture(scope="module")
def beside_matt_object() -> Array:
    """Render the light with a matt object and several seeds, shape (seeds, H, W)."""
    return rendered(load_scene(matt=True), seeds=MANY_SEEDS)[0]


@pytest.fixture(scope="module")
def direct() -> Array:
    """Render the light of the emitters with several seeds, shape (seeds, H, W)."""
    return rendered(load_scene(), bounce=False)[0]


def rendered(scene: mi.Scene, *, bounce: bool = True, seeds: int = SEEDS) -> tuple[Array, Array]:
    integrator = make_integrator(white=WHITE, bounce=bounce)
    layers = [render_layers(integrator, scene, CAMERA, seed=seed) for seed in range(seeds)]
    light, highlight = (np.stack([getattr(one, name)[..., 0] for one in layers]) for name in ("light", "highlight"))
    return light.astype(np.float64), highlight.astype(np.float64)


COLOUR = float(decode_srgb(np.array(GREY)))
SCENE, MATT_SCENE = (
    BoxScene((FLOOR, WALL, TABLE, replace(OBJECT, albedo=albedo), OCCLUDER), LAMP, SKY, COLOUR, WHITE)
    for albedo in ((1 - METALLIC) * COLOUR, COLOUR)
)


def points_below_pixels(
    low: tuple[float, float], high: tuple[float, float], z: float, step: int
) -> tuple[Array, Pixels]:
    """Return the points of a horizontal rectangle at every ``step``-th pixel centre (``step`` even), and the pixels.

    The pixels have odd numbers, so that coarse planes do not trace them.

    Points behind the object or close to its outline are omitted.
    """
    row, column = (part.ravel() for part in np.mgrid[3:128:step, 3:128:step])
    slopes = CAMERA.ray_slopes(np.stack([column + 0.5, row + 0.5], axis=1))
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ CAMERA.world_from_camera[:3, :3].T
    points = EYE + rays * ((z - EYE[2]) / rays[:, 2])[:, None]
    inside = ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
    seen = inside & ((z == OBJECT.high[2]) | (NEAR_OBJECT.entry(EYE, rays) == np.inf))
    return points[seen], (row[seen], column[seen])


def to_camera(point: Array) -> Array:
    return np.asarray((EYE - point) / np.linalg.norm(EYE - point))


def assert_close(images: Array, pixels: Pixels, expected: list[float], *, bias: float, error: float) -> None:
    """Compare the mean difference with ``bias``, and the RMS difference of single pictures with ``error``."""
    difference = images[:, *pixels] - expected
    assert abs(difference.mean()) < bias
    assert np.sqrt(np.mean(difference**2)) < error


def test_captured_surface_takes_the_ratio_of_direct_and_reflected_light(beside_matt_object: Array) -> None:
    """The RMS error is below the target standard error, 0.03, and the bias is an order of magnitude lower."""
    points, pixels = points_below_pixels((-0.5, -0.5), (-0.04, 0.5), 0.0, 10)
    expected = [MATT_SCENE.captured(point) for point in points]
    assert min(expected) < 0.4 and max(expected) > 0.99
    assert max(light - MATT_SCENE.shadowed(point) for point, light in zip(points, expected, strict=True)) > 0.05
    assert_close(beside_matt_object, pixels, expected, bias=0.003, error=0.03)


def test_faint_shadow_is_found_by_one_ray_per_pixel(direct: Array) -> None:
    """Light is interpolated between tiles of 8 pixels; the error of the mean loss of light is below a twelfth."""
    points, pixels = points_below_pixels((-0.54, -0.5), (-0.41, 0.5), 0.0, 6)
    expected = np.array([SCENE.shadowed(point) for point in points])
    faint = (expected < 0.997) & (expected > 0.97)
    assert faint.sum() > 10
    some = pixels[0][faint], pixels[1][faint]
    assert_close(direct, some, list(expected[faint]), bias=(1 - expected[faint].mean()) / 12, error=0.01)


def test_visible_mesh_takes_direct_and_reflected_light(pictures: tuple[Array, Array]) -> None:
    """Light on coarse planes is interpolated, and a wall reflects light."""
    points, pixels = points_below_pixels((0.05, -0.5), (0.5, 0.5), 0.0, 10)
    expected = [SCENE.relit(point, to_camera(point)).factor for point in points]
    assert_close(pictures[0], pixels, expected, bias=0.008, error=0.03)


def test_material_takes_direct_light_reflected_light_and_mirrored_light(pictures: tuple[Array, Array]) -> None:
    points, pixels = points_below_pixels((-0.33, -0.13), (-0.07, 0.13), OBJECT.high[2], 6)
    expected = [SCENE.relit(point, to_camera(point), ROUGHNESS, METALLIC, SPECULAR) for point in points]
    assert_close(pictures[0], pixels, [light.factor for light in expected], bias=0.004, error=0.02)
    highlights = [light.highlight for light in expected]
    error = float(np.mean(highlights)) / 20
    assert_close(pictures[1], pixels, highlights, bias=error, error=2 * error)


def test_number_of_rays_is_doubled_until_it_is_the_wanted_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number is rounded down for each of several sample points of a pixel."""
    ensure_variant()
    from mitsplat.renderer.light.light_filter import LightFilter
    from mitsplat.renderer.light.lighting import Accuracy

    seen: dict[str, Array] = {}
    rays_for, smooth = LightFilter.rays_for, LightFilter.smooth

    def spy_rays_for(self: LightFilter, *args: Any) -> Any:
        wanted, exposure = rays_for(self, *args)
        seen["wanted"] = np.array(wanted, np.float64)
        return wanted, exposure

    def spy_smooth(self: LightFilter, estimate: Any, bounced: Any) -> Any:
        seen["rays"] = np.array(estimate.rays, np.float64)
        return smooth(self, estimate, bounced)

    monkeypatch.setattr(LightFilter, "rays_for", spy_rays_for)
    monkeypatch.setattr(LightFilter, "smooth", spy_smooth)
    monkeypatch.setattr(LightFilter, "reflections_for", lambda _, brightness, *__: 0 * brightness)
    error, most = 0.01, 200
    render_layers(make_integrator(shadow_error=error, shadow_samples=most), load_scene(), CAMERA.resized(64, 64))
    expected = []
    for wanted in seen["wanted"]:
        rays = Accuracy(error, most).first
        while wanted > rays and rays < most:
            rays = min(2 * rays, most)
        expected.append(rays)
    assert len(set(expected)) > 2
    missing = np.array(expected) - seen["rays"]
    assert (missing == 0).mean() > 0.8
    assert missing.min() >= 0 and missing.max() <= 3 * 4
