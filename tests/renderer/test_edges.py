"""Antialiased silhouettes against images of twice the size and brute force."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.quality import PRESETS, Quality
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_light import down_camera, floor, slab
from tests.renderer.test_render import make_splats

ensure_variant()
CAMERA = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=49, height=38, fov_x=40)
FINE = replace(PRESETS["exact"], samples="edges")
LENSES = {
    "pinhole": {},
    "distorted": {"distortion": (-0.25, 0.08, 0.002, -0.001, -0.01)},
    "fisheye": {"distortion": (0.05, -0.02, 0.01, -0.003), "lens": "fisheye"},
}


def scene_of(**meshes: Any) -> Any:
    """Return a scene of two objects before a background that does not fill the image, and further shapes."""
    pose = np.diag([0.4, 0.4, 0.4, 1.0])
    shapes: dict[str, Any] = {"background": make_splats_shape(make_splats(60, 1, scales=(0.05, 0.2)))}
    for number in (1, 2):
        pose[0, 3] = 0.5 * number - 0.75
        thing = make_splats(300, number + 1, scales=(0.02, 0.1))
        shapes[f"thing_{number}"] = make_splats_shape(thing, pose, instance=number)
    return mi.load_dict({"type": "scene", **shapes, **meshes})


def plate(pose: Any) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": pose, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}


CUTTING = plate(mi.ScalarTransform4f().translate([0, 0.6, 0]).rotate([1, 0, 0], 20).scale(0.4))
"""Mesh that intersects all splats."""


def layers_of(scene: Any, camera: Camera, quality: Quality, **properties: Any) -> Layers:
    properties = {"shadow": "none", **properties}
    return render_layers(make_integrator(quality=quality, **properties), scene, camera)


def changed_by(smooth: Layers, plain: Layers) -> np.ndarray:
    return np.asarray((smooth.rgb != plain.rgb).any(axis=-1) | (smooth.alpha != plain.alpha))


def means_of_four(values: np.ndarray) -> np.ndarray:
    height, width, *rest = values.shape
    return np.asarray(values.reshape(height // 2, 2, width // 2, 2, *rest).mean(axis=(1, 3)))


@pytest.mark.parametrize(("preset", "lens"), [*(("fast", lens) for lens in LENSES), ("balanced", "pinhole")])
def test_edge_pixels_are_means_of_an_image_twice_as_large(preset: str, lens: str) -> None:
    camera, scene = replace(CAMERA, **LENSES[lens]), scene_of(plate=CUTTING)
    quality = replace(PRESETS[preset], kernel="mip")
    smooth, plain = (layers_of(scene, camera, replace(quality, samples=samples)) for samples in ("edges", 1))
    order = quality.tolerance if preset == "fast" else 0.0  # resampled edges are sorted along each ray
    large = layers_of(scene, camera.resized(2 * camera.width, 2 * camera.height), replace(quality, tolerance=order))
    changed = changed_by(smooth, plain)
    assert 0.05 < changed.mean() < 0.6
    for name in ("rgb", "alpha", "captured"):
        twin = means_of_four(getattr(large, name))
        np.testing.assert_allclose(getattr(smooth, name)[changed], twin[changed], atol=2e-5, err_msg=name)
    for field in fields(smooth):
        own, other = getattr(smooth, field.name), getattr(plain, field.name)
        if field.name in ("rgb", "alpha", "captured"):
            own, other = own[~changed], other[~changed]
        assert np.array_equal(own, other), field.name


def test_edges_are_smooth_for_each_point_of_a_lens() -> None:
    camera, scene = replace(CAMERA, aperture_radius=0.02, focus_distance=1.5), scene_of()
    smooth, plain = (layers_of(scene, camera, replace(FINE, samples=samples, lens_rings=1)) for samples in ("edges", 1))
    size = 2 * camera.width, 2 * camera.height
    twin = means_of_four(layers_of(scene, camera.resized(*size), replace(FINE, samples=1, lens_rings=1)).rgb)
    changed = changed_by(smooth, plain)
    before, after = (np.sqrt(np.mean((layers.rgb - twin)[changed] ** 2)) for layers in (plain, smooth))
    assert after < 0.5 * before


@pytest.mark.parametrize("zoom", [2, 4])
def test_pixels_beside_another_instance_are_sampled_again(zoom: int) -> None:
    from mitsplat.renderer.instances.antialiasing import Edges
    from mitsplat.renderer.layers import make_sensor
    from mitsplat.renderer.rays.sensors import view_of

    view = view_of(make_sensor(CAMERA))
    keys = np.zeros((CAMERA.height, CAMERA.width), np.uint32)
    assert Edges.find(mi.UInt32(keys.ravel()), view, zoom) is None
    keys[7:20, 10:31], keys[19, 30], keys[37, 48] = 3, 0, 9
    around = np.pad(keys, 1, mode="edge")
    height, width = keys.shape
    beside = [around[dy : dy + height, dx : dx + width] != keys for dy in range(3) for dx in range(3)]
    rows, columns = np.nonzero(np.any(beside, axis=0))
    edges = Edges.find(mi.UInt32(keys.ravel()), view, zoom)
    assert edges is not None
    blocks = np.unique(rows // (TILE_HEIGHT // zoom) * edges.fine.tiles_x + columns // (TILE_WIDTH // zoom))
    assert np.array_equal(np.array(edges.subset.number), blocks)


def test_selected_tiles_agree_with_a_slow_count() -> None:
    from mitsplat.renderer.layers import make_sensor
    from mitsplat.renderer.rays.sensors import view_of
    from mitsplat.renderer.rays.tile_subset import TileSubset

    view, random = view_of(make_sensor(CAMERA)), np.random.default_rng(1)
    flags = random.random((view.tiles_y, view.tiles_x)) < 0.1
    chosen = TileSubset.of(mi.Bool(flags.ravel()), view)
    assert np.array_equal(np.array(chosen.number), np.flatnonzero(flags))
    (x0, x1), (y0, y1) = (np.sort(random.integers(0, n + 1, (2, 200)), axis=0) for n in (view.tiles_x, view.tiles_y))
    found = np.array(chosen.any_in(*(mi.UInt32(v.astype(np.uint32)) for v in (x0, x1, y0, y1))))
    assert np.array_equal(found, [flags[c:d, a:b].any() for a, b, c, d in zip(x0, x1, y0, y1, strict=True)])
    first, size = chosen.among(mi.UInt32([0, 3, flags.size]), mi.UInt32([flags.size, 40, 0]))
    flat = flags.ravel()
    assert np.array(first).tolist() == [0, flat[:3].sum(), flat.sum()]
    assert np.array(size).tolist() == [flat.sum(), flat[3:43].sum(), 0]
    halves = chosen.halves(view)
    assert np.array_equal(np.concatenate([np.array(half.number) for half in halves]), np.flatnonzero(flags))


def test_marked_pixels_are_sampled_again() -> None:
    from mitsplat.renderer.instances.antialiasing import Edges
    from mitsplat.renderer.layers import make_sensor
    from mitsplat.renderer.rays.sensors import view_of

    view, zoom = view_of(make_sensor(CAMERA)), 2
    keys = np.zeros((CAMERA.height, CAMERA.width), np.uint32)
    keys[7:20, 10:31] = 3
    marked = np.zeros_like(keys, bool)
    marked[[13, 30, 31, 37], [20, 3, 4, 48]] = True
    rows, columns = np.nonzero(marked)
    borders = Edges.find(mi.UInt32(keys.ravel()), view, zoom)
    edges = Edges.find(mi.UInt32(keys.ravel()), view, zoom, mi.Bool(marked.ravel()))
    assert borders is not None and edges is not None
    blocks = rows // (TILE_HEIGHT // zoom) * edges.fine.tiles_x + columns // (TILE_WIDTH // zoom)
    assert not set(blocks) & set(np.array(borders.subset.number))
    assert np.array_equal(np.array(edges.subset.number), np.union1d(np.array(borders.subset.number), blocks))


def test_light_of_another_surface_is_found_up_to_three_pixels_away() -> None:
    from mitsplat.renderer.instances.antialiasing import Edges
    from mitsplat.renderer.layers import make_sensor
    from mitsplat.renderer.rays.sensors import view_of

    view, border = view_of(make_sensor(CAMERA)), 22
    column = np.tile(np.arange(CAMERA.width), CAMERA.height)
    keys = mi.UInt32(np.where(column < border, 1, 2))
    edges = Edges.find(keys, view, 2, mi.Bool(np.full(column.shape, True)))
    assert edges is not None
    pixels = np.array(edges.pixels())
    found = column[np.array(edges.nearest_other(keys, mi.UInt32(np.array(keys)[pixels])))]
    here = column[pixels]
    expected = np.where((here < border) & (here >= border - 3), border, here)
    expected[(here >= border) & (here < border + 3)] = border - 1
    assert set(here) == set(range(CAMERA.width))
    assert np.array_equal(found, expected)


def test_a_box_of_tiles_equals_the_same_tiles_selected_singly() -> None:
    from mitsplat.renderer.layers import make_sensor
    from mitsplat.renderer.rays.sensors import view_of
    from mitsplat.renderer.rays.tile_subset import TileBox, TileSubset

    view = view_of(make_sensor(CAMERA))
    box = TileBox.around(mi.UInt32([3, 5, 2, 4, 2, 4, 3, 7]), view)
    flags = np.zeros((view.tiles_y, view.tiles_x), bool)
    flags[2:7, 2:5] = True
    chosen = TileSubset.of(mi.Bool(flags.ravel()), view)
    assert (box.count, np.array(box.number).tolist()) == (15, np.array(chosen.number).tolist())
    begin, size = (mi.UInt32([row * view.tiles_x + 3 for row in range(2, 7)]), mi.UInt32([2, 1, 0, 2, 1]))
    for own, other in zip(box.among(begin, size), chosen.among(begin, size), strict=True):
        assert np.array(own).tolist() == np.array(other).tolist()


def test_antialiasing_keeps_the_dilation_of_splats() -> None:
    """The dilation is in pixels of the image, as with four rays in every pixel."""
    quality, scene = replace(PRESETS["exact"], kernel="3dgs"), scene_of()
    smooth, plain, everywhere = (layers_of(scene, CAMERA, replace(quality, samples=s)) for s in ("edges", 1, 2))
    changed = changed_by(smooth, plain)
    np.testing.assert_allclose(smooth.alpha[changed], everywhere.alpha[changed], atol=2e-5)


def test_both_sides_of_a_border_have_their_own_light() -> None:
    """An object has ten times the light of the plate behind it; its soft edge lies between pixel centres.

    The picture is the object lit alone over the plate lit alone, each with its own light where both are mixed.
    """

    def square(half: float) -> Splats:
        grid = np.stack(np.meshgrid(*[np.arange(-half, half + 1e-6, 0.015)] * 2), axis=-1).reshape(-1, 2)
        count = len(grid)
        return Splats(
            np.column_stack([grid, np.zeros(count)]).astype(np.float32),
            np.tile(np.float32([0, 0, 0, 1]), (count, 1)),
            np.tile(np.float32([0.02, 0.02, 0.001]), (count, 1)),
            np.full(count, 0.99, np.float32),
            np.full((count, 1, 3), 0.5, np.float32),
        )

    turn = np.eye(4)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    turn[2, 3] = -0.7
    lamp = {"type": "point", "position": [0, 0, -1.3], "intensity": {"type": "rgb", "value": 3.0}}
    ground = plate(mi.ScalarTransform4f().translate([0, 0, 0.7]).scale(3))
    lit = {"shadow": "traced", "white": 3.0, "bounce": False, "highlight": False}
    large = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)

    def layers(shapes: dict[str, Any], camera: Camera, samples: Any = 1) -> Layers:
        scene = mi.load_dict({"type": "scene", "lamp": lamp, **shapes})
        return layers_of(scene, camera, replace(FINE, samples=samples), **lit)

    things = [make_splats_shape(square(half), turn, instance=1, capture_light="uniform") for half in (0.3, 0.9)]
    scene = {"square": things[0], "plate": ground}
    smooth, plain, several, many = (layers(scene, CAMERA, samples) for samples in ("edges", 1, 2, 3))
    changed = changed_by(smooth, plain)
    inside, outside = (plain.light[plain.instance == i].mean() for i in (1, 0))
    assert inside > 5 * outside
    assert changed.mean() > 0.02
    opacity = layers({"square": things[0]}, large).alpha[..., None]
    everywhere, behind = layers({"square": things[1]}, large).rgb, layers({"plate": ground}, large).rgb
    twin = means_of_four(opacity * everywhere + (1 - opacity) * behind)

    def error(layers: Layers) -> float:
        return float(np.sqrt(np.mean((layers.rgb - twin)[changed] ** 2)))

    assert max(error(smooth), error(several)) < 0.1 * error(plain)
    assert error(many) < 0.25 * error(plain)  # the mean of 16 rays instead of 4


def test_both_sides_of_a_border_of_meshes_have_their_own_light() -> None:
    """A dark plate has ten times the light of the bright plate behind it."""
    dark = mi.ScalarTransform4f().translate([0, 0, -0.7]).rotate([0, 0, 1], 37).scale(0.3)
    lamp = {"type": "point", "position": [0, 0, -1.3], "intensity": {"type": "rgb", "value": 3.0}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "lamp": lamp,
            "near": plate(dark) | {"bsdf": {"type": "twosided", "b": {"type": "diffuse", "reflectance": 0.1}}},
            "far": plate(mi.ScalarTransform4f().translate([0, 0, 0.7]).scale(3)),
        }
    )
    lit = {"shadow": "traced", "white": 3.0, "bounce": False, "highlight": False}
    smooth, plain = (layers_of(scene, CAMERA, replace(FINE, samples=samples), **lit) for samples in ("edges", 1))
    large = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
    twin = means_of_four(layers_of(scene, large, replace(FINE, samples=1), **lit).rgb)
    changed = changed_by(smooth, plain)
    assert changed.mean() > 0.02
    error = [float(np.sqrt(np.mean((layers.rgb - twin)[changed] ** 2))) for layers in (smooth, plain)]
    assert error[0] < 0.1 * error[1]


def test_crowded_edges_are_sampled_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsplat.renderer.instances import antialiasing as edges
    from mitsplat.renderer.splatting import pairs

    scene = scene_of()
    whole = layers_of(scene, CAMERA, FINE)
    bins, sizes = edges.bin_gaussians, []

    def crowded(*given: Any, subset: Any) -> Any:
        if subset.count > 20:
            raise pairs.CrowdedError
        sizes.append(subset.count)
        return bins(*given, subset=subset)

    monkeypatch.setattr(edges, "bin_gaussians", crowded)
    parts = layers_of(scene, CAMERA, FINE)
    assert len(sizes) > 2
    assert np.array_equal(parts.rgb, whole.rgb)


def test_a_silhouette_is_as_bright_as_both_of_its_sides() -> None:
    """A white object is lit ten times less than a dark plane behind it, so that both look alike.

    With one light factor for a ray that sees both of them, the outline would be up to 3 times too bright or too dark.
    """
    level, pose = 0.1, np.eye(4)
    pose[2, 3] = 0.2
    body = trimesh.creation.box(bounds=[[-0.1, -0.1, -0.01], [0.1, 0.1, 0]])
    ground = floor(1.0, float(encode_srgb(np.array(level))))
    scene = {
        "type": "scene",
        "thing": make_splats_shape(floor(0.1, 1.0), pose, body, instance=1, capture_light="uniform"),
        "ground": make_splats_shape(ground, proxy=slab()),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": level}},
    }
    quality = replace(PRESETS["fast"], samples="edges")
    layers = layers_of(mi.load_dict(scene), down_camera(size=40, fov=26), quality, shadow="traced", bounce=False)
    assert 0.1 < (layers.instance == 1).mean() < 0.5
    assert layers.rgb.max() < 1.02 * level
