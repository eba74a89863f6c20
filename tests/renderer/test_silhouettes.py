"""Silhouettes equal renderings of the single instance without other objects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh

import mitsplat as ms
from mitsplat.errors import MissingResourceError
from mitsplat.quality import Quality
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers, render_silhouettes
from mitsplat.runtime.variant import ensure_variant

WIDTH, HEIGHT = 96, 64


def ball(seed: int, radius: float = 0.05, count: int = 300) -> tuple[ms.Splats, trimesh.Trimesh]:
    """Return Gaussians of mixed opacity on a sphere, and the sphere."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    splats = ms.Splats(
        means=(radius * normal).astype(np.float32),
        quats=(rng.normal(size=(count, 4))).astype(np.float32),
        scales=rng.uniform(0.05, 0.2, (count, 3)).astype(np.float32) * np.float32(radius),
        opacities=rng.uniform(0.05, 0.99, count).astype(np.float32),
        sh=np.zeros((count, 1, 3), dtype=np.float32),
    )
    return replace(splats, quats=splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)), (
        trimesh.creation.icosphere(radius=radius)
    )


def placed() -> dict[str, Any]:
    """Return overlapping balls: one behind another, one cut by the border, one outside, one far outside, one absent."""
    positions = {1: (0, 0, 0), 2: (0.03, 0.05, 0.02), 7: (-0.17, 0, 0.1), 9: (0, 0.02, -0.27), 300: (3, 0, 0)}
    shapes: dict[str, Any] = {}
    for number, position in positions.items():
        splats, mesh = ball(number)
        pose = trimesh.transformations.rotation_matrix(number, (1, 2, 3))
        pose[:3, 3] = position
        shapes[f"instance_{number}"] = make_splats_shape(splats, pose, mesh, instance=number)
    return shapes


def camera(distortion: tuple[float, ...] = ()) -> ms.Camera:
    return ms.Camera.look_at((0, -0.5, 0), (0, 0, 0), width=WIDTH, height=HEIGHT, fov_x=40, distortion=distortion)


@pytest.mark.parametrize("source", ["splats", "proxies"])
@pytest.mark.parametrize(
    ("quality", "distortion"),
    [
        (Quality(), ()),
        (Quality(samples=2), ()),
        (Quality(tolerance=0.0, alpha_min=1e-5), ()),
        (Quality(), (0.08, -0.02, 1e-3, -2e-3)),
    ],
    ids=["balanced", "samples", "exact", "distorted"],
)
def test_silhouettes_equal_renderings_of_single_instances(
    source: str, quality: Quality, distortion: tuple[float, ...]
) -> None:
    ensure_variant()
    shapes = placed()
    integrator = make_integrator(quality=quality, shadow="none")
    view = camera(distortion)
    found = render_silhouettes(integrator, mi.load_dict({"type": "scene", **shapes}), view, source=source)
    assert {1, 2, 7} <= set(found) <= {1, 2, 7, 9}
    large = replace(view, width=3 * WIDTH, height=3 * HEIGHT, cx=view.cx + WIDTH, cy=view.cy + HEIGHT)
    for number in (1, 2, 7, 9):
        alone = mi.load_dict({"type": "scene", "one": shapes[f"instance_{number}"]})
        layers = render_layers(make_integrator(quality=quality, shadow="none"), alone, large)
        expected = (layers.instance if source == "splats" else layers.proxy_instance) == number
        if number in found:
            moved = replace_origin(found[number], WIDTH, HEIGHT)
            shown = moved.image_mask(3 * WIDTH, 3 * HEIGHT)
        else:
            shown = np.zeros_like(expected)
        if distortion:  # the canvas may be smaller than the reference
            edge = [
                slice(HEIGHT - HEIGHT // 8, 2 * HEIGHT + HEIGHT // 8),
                slice(WIDTH - WIDTH // 8, 2 * WIDTH + WIDTH // 8),
            ]
            shown, expected = shown[tuple(edge)], expected[tuple(edge)]
        np.testing.assert_array_equal(shown, expected)
    if not distortion:
        assert found[9].clipped(WIDTH, HEIGHT) is None
        assert found[7].box[0] < 0 < found[7].box[2]


def replace_origin(silhouette: Any, x: int, y: int) -> Any:
    x0, y0, x1, y1 = silhouette.box
    return replace(silhouette, box=(x0 + x, y0 + y, x1 + x, y1 + y))


def test_visible_pixels_lie_inside_of_silhouettes() -> None:
    ensure_variant()
    scene = mi.load_dict({"type": "scene", **placed()})
    integrator = make_integrator(shadow="none")
    layers = render_layers(integrator, scene, camera())
    found = render_silhouettes(integrator, scene, camera())
    for number in (1, 2, 7):
        seen = layers.instance == number
        assert seen.any()
        assert np.count_nonzero(seen & ~found[number].image_mask(WIDTH, HEIGHT)) <= 2  # three instances overlap there
    assert 0 < np.count_nonzero(layers.instance == 2) < 0.9 * found[2].area  # partly hidden


def test_a_scene_without_instances_has_no_silhouettes() -> None:
    ensure_variant()
    scene = mi.load_dict({"type": "scene", "environment": make_splats_shape(ball(1)[0])})
    integrator = make_integrator(shadow="none")
    assert render_silhouettes(integrator, scene, camera()) == {}
    assert render_silhouettes(integrator, scene, camera(), source="proxies") == {}


@pytest.mark.parametrize("samples", [1, 2])
def test_crowded_silhouettes_are_rendered_in_parts(monkeypatch: pytest.MonkeyPatch, samples: int) -> None:
    from mitsplat.renderer.splatting import pairs

    ensure_variant()
    scene = mi.load_dict({"type": "scene", **placed()})
    integrator = make_integrator(quality=Quality(samples=samples), shadow="none")
    whole = render_silhouettes(integrator, scene, camera())
    monkeypatch.setattr(pairs, "PAIRS_MAX", 3000)
    parts = render_silhouettes(integrator, scene, camera())
    assert set(parts) == set(whole)
    for number, silhouette in whole.items():
        assert parts[number].box == silhouette.box
        np.testing.assert_array_equal(parts[number].mask, silhouette.mask)
    monkeypatch.setattr(pairs, "PAIRS_MAX", 10)
    with pytest.raises(MissingResourceError, match="cover too much of the image"):
        render_silhouettes(integrator, scene, camera())


def test_more_instances_than_bits_have_their_silhouettes() -> None:
    """The scene has more instances than a word has bits, with ids far apart."""
    ensure_variant()
    splats, _ = ball(1, radius=0.01, count=40)
    shapes = {}
    for number in range(70):
        pose = np.eye(4)
        pose[:3, 3] = 0.04 * (number % 10 - 4.5), 0, 0.04 * (number // 10 - 3)
        shapes[f"instance_{number}"] = make_splats_shape(splats, pose, instance=900 * number + 1)
    found = render_silhouettes(make_integrator(shadow="none"), mi.load_dict({"type": "scene", **shapes}), camera())
    assert set(found) == {900 * number + 1 for number in range(70)}
    for number in range(70):
        pixel, _ = camera().project([(0.04 * (number % 10 - 4.5), 0, 0.04 * (number // 10 - 3))])
        x0, y0, x1, y1 = found[900 * number + 1].box
        assert np.abs(pixel[0] - ((x0 + x1) / 2, (y0 + y1) / 2)).max() < 1.5


@pytest.mark.parametrize("source", ["splats", "proxies"])
@pytest.mark.parametrize("shift", [0.0, 0.4])
def test_an_object_close_to_the_camera_has_its_complete_area(source: str, shift: float) -> None:
    """A plate of side s at distance d has f s / d pixels on each side, here 13 images of 96 px."""
    ensure_variant()
    side, distance = 1.0, 0.1
    plate = trimesh.creation.box((side, 0.001, side))
    across = (np.arange(60) + 0.5) / 60 * side - side / 2
    means = np.stack([*np.meshgrid(across, [0.0], across)], axis=-1).reshape(-1, 3).astype(np.float32)
    splats = ms.Splats(
        means=means,
        quats=np.tile(np.float32([0, 0, 0, 1]), (len(means), 1)),
        scales=np.tile(np.float32([0.012, 0.0005, 0.012]), (len(means), 1)),
        opacities=np.full(len(means), 0.95, dtype=np.float32),
        sh=np.zeros((len(means), 1, 3), dtype=np.float32),
    )
    scene = mi.load_dict({"type": "scene", "plate": make_splats_shape(splats, np.eye(4), plate, instance=1)})
    eye = shift, -distance - 0.0005, 0
    view = ms.Camera.look_at(eye, (shift, 0, 0), width=WIDTH, height=HEIGHT, fov_x=40)
    found = render_silhouettes(make_integrator(shadow="none"), scene, view, source=source)[1]
    inside = found.clipped(WIDTH, HEIGHT)
    assert inside is not None and inside.area == WIDTH * HEIGHT
    assert found.area + found.beyond == pytest.approx((view.fx * side / distance) ** 2, rel=0.01)


@pytest.mark.parametrize("end", [(4.0, 0.2), (-4.0, 0.2), (0.2, 4.0), (0.2, -4.0)])
def test_an_object_beyond_one_side_of_the_canvas_has_its_whole_area(end: tuple[float, float]) -> None:
    """A plate of 4 m x 0.2 m from the middle of the image, at 1 m from the camera."""
    ensure_variant()
    x, y = end
    plate = trimesh.creation.box(bounds=np.sort([[0, 0, -0.01], [x, y, 0]], axis=0))
    scene = mi.load_dict({"type": "scene", "plate": make_splats_shape(ball(1)[0], np.eye(4), plate, instance=1)})
    view = ms.Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=WIDTH, height=HEIGHT, fov_x=60)
    found = render_silhouettes(make_integrator(shadow="none"), scene, view, source="proxies")[1]
    assert found.area + found.beyond == pytest.approx(abs(x * y) * view.fx * view.fy, rel=0.02)


def test_an_object_that_reaches_behind_the_camera_has_a_large_finite_area() -> None:
    ensure_variant()
    floor = trimesh.creation.box((4, 4, 0.01))
    scene = mi.load_dict({"type": "scene", "floor": make_splats_shape(ball(1)[0], np.eye(4), floor, instance=1)})
    view = ms.Camera.look_at((0, 0, 0.1), (0, 1, 0.1), width=WIDTH, height=HEIGHT, fov_x=40)
    found = render_silhouettes(make_integrator(shadow="none"), scene, view, source="proxies")[1]
    assert 10 * found.area < found.beyond < np.inf
