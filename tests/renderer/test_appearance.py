"""Appearance changes against a slow twin in NumPy, and their rendering."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import SH_C0, evaluate_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb, hue_matrix, saturation_matrix
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.runtime.variant import ensure_variant

MATRIX = np.diag([0.8, 1.0, 1.2]) @ saturation_matrix(0.6) @ hue_matrix(25.0)
TEXT = " ".join(map(repr, MATRIX.ravel().tolist()))


def hashed(key: int) -> int:
    key = (key ^ key >> 16) * 0x7FEB352D & 0xFFFFFFFF
    key = (key ^ key >> 15) * 0x846CA68B & 0xFFFFFFFF
    return key ^ key >> 16


def value_noise(point: np.ndarray, seed: int) -> float:
    low = np.floor(point).astype(int)
    share = point - low
    share = share * share * (3 - 2 * share)
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        place = low + corner
        key = seed * 0x9E3779B1 + place[0] * 0x8DA6B343 + place[1] * 0xD8163841 + place[2] * 0xCB1AB31F
        weight = np.prod(np.where(corner, share, 1 - share))
        total += weight * (hashed(int(key) & 0xFFFFFFFF) >> 8) / 2**24
    return total


def twin(encoded: np.ndarray, points: np.ndarray, matrix: np.ndarray, wear: float, seed: int, size: float) -> Any:
    """Return the changed colours (N, 3) of Gaussians at points (N, 3)."""
    result = []
    for colour, point in zip(encoded, points, strict=True):
        p = point * 3 / size
        noise = sum(0.5**o * value_noise(p * 2**o, seed + o) for o in range(3)) / 1.75
        t = np.clip((noise - 0.4) / 0.3, 0, 1)
        cover = wear * t * t * (3 - 2 * t)
        linear = matrix @ decode_srgb(colour) * (1 - cover * (1 - np.array([0.12, 0.09, 0.06])))
        result.append(np.minimum(encode_srgb(linear), max(1, colour.max())))
    return np.array(result)


def test_colours_and_dirt_equal_those_of_the_slow_twin() -> None:
    ensure_variant()
    from mitsplat.renderer.projection.splat_appearance import SplatAppearance, apply_appearance

    rng = np.random.default_rng(1)
    encoded, points = rng.uniform(0, 1.2, (300, 3)), rng.uniform(-0.05, 0.05, (300, 3))
    points[:4] = 0.0  # a corner of the lattice
    for matrix, wear, seed, size in (
        (MATRIX, 0.0, 0, 0.1),
        (np.eye(3), 1.0, 8388607, 0.07),
        (3 * MATRIX, 0.5, 12345, 0.1),
    ):
        row = [mi.Float(v) for v in SplatAppearance(tuple(matrix.ravel()), wear, seed, size).row]
        point = mi.Vector3f(*points.T.astype(np.float32))
        seen = apply_appearance([mi.Float(c.astype(np.float32)) for c in encoded.T], row, point)
        expected = twin(encoded, points, matrix, wear, seed, size)
        np.testing.assert_allclose(np.stack(seen, axis=1), expected, atol=2e-4)
        if wear == 1:
            dirty = (expected < twin(encoded, points, matrix, 0, seed, size) - 1e-3).all(axis=1).mean()
            assert 0.3 < dirty < 0.9  # dirt in patches
    colours = [mi.Float(c.astype(np.float32)) for c in encoded.T]
    same = apply_appearance(colours, [mi.Float(0)] * 13, mi.Vector3f(*points.T.astype(np.float32)))
    assert all((np.array(a) == np.array(b)).all() for a, b in zip(same, colours, strict=True))


def test_dirt_patches_scale_with_the_object_and_depend_on_the_seed() -> None:
    ensure_variant()
    from mitsplat.renderer.projection.splat_appearance import dirt_thickness

    rng = np.random.default_rng(2)
    points = rng.uniform(-50, 50, (20000, 3))

    def at(offset: float, seed: int = 5) -> np.ndarray:
        moved = points + offset * np.array([0.6, 0.8, 0])
        return np.array(dirt_thickness(mi.Vector3f(*moved.T.astype(np.float32)), mi.UInt32(seed)))

    here = at(0)
    assert 0.2 < here.mean() < 0.45 and here.min() == 0 and here.max() == 1
    near, far, other = (np.corrcoef(here, values)[0, 1] for values in (at(0.05), at(3.0), at(0, 6)))
    # The correlation of 20,000 independent pairs is 0 +- 0.007.
    assert near > 0.9 and abs(far) < 0.04 and abs(other) < 0.04


def ball(**properties: Any) -> tuple[Splats, Any]:
    """Return opaque Gaussians on a sphere, with colours that vary with direction, and their shape."""
    rng = np.random.default_rng(3)
    mesh = trimesh.creation.icosphere(3, 0.05)
    count = len(mesh.vertices)
    splats = Splats(
        means=mesh.vertices,
        quats=np.tile([0.0, 0, 0, 1], (count, 1)),
        scales=np.full((count, 3), 0.003),
        opacities=np.full(count, 0.99),
        sh=rng.normal(0, 0.3, (count, 4, 3)) * [[1.0], [0.3], [0.3], [0.3]],
    )
    return splats, make_splats_shape(splats, instance=1, **properties)


def seen(shape: Any) -> Any:
    camera = Camera.look_at((0.3, 0.1, 0.1), (0, 0, 0), width=64, height=48, fov_x=25)
    integrator = make_integrator(shadow="none", quality="exact")
    return camera, render_layers(integrator, mi.load_dict({"type": "scene", "ball": shape}), camera)


def test_appearance_renders_as_splats_with_changed_colours() -> None:
    splats, shape = ball(colours=TEXT, wear=0.7, wear_seed=99)
    camera, layers = seen(shape)
    towards = splats.means - camera.centre
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    size = float(np.ptp(splats.means, axis=0).max())
    colours = twin(evaluate_sh(splats.sh, towards), splats.means, MATRIX, 0.7, 99, size)
    fixed = Splats(splats.means, splats.quats, splats.scales, splats.opacities, ((colours - 0.5) / SH_C0)[:, None])
    _, expected = seen(make_splats_shape(fixed, instance=1))
    _, plain = seen(ball()[1])
    assert np.abs(layers.rgb - expected.rgb).max() < 1e-3 < 0.05 < np.abs(layers.rgb - plain.rgb).max()
    for name in ("depth", "instance", "alpha"):
        np.testing.assert_array_equal(getattr(layers, name), getattr(plain, name))


def test_dirt_rotates_with_its_object() -> None:
    """Rotating object and camera together does not change the image."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.3, 0.7, 1.0]).as_matrix(), (0.4, -0.2, 0.1)
    splats, shape = ball(wear=1.0, wear_seed=4)
    camera, here = seen(shape)
    moved = replace(camera, world_from_camera=pose @ camera.world_from_camera)
    turned = make_splats_shape(splats, pose, instance=1, wear=1.0, wear_seed=4)
    integrator = make_integrator(shadow="none", quality="exact")
    there = render_layers(integrator, mi.load_dict({"type": "scene", "ball": turned}), moved)
    # Rounding adds or drops Gaussians at the border of a pixel's footprint.
    assert np.abs(here.rgb - there.rgb).mean() < 1e-4


def test_mirrors_show_appearances() -> None:
    """A ball with a quarter of the reflectance is also darker in the mirror."""
    ensure_variant()
    _, plain = ball(capture_light="scene")
    _, dark = ball(capture_light="scene", colours=" ".join(map(str, (0.25 * np.eye(3)).ravel())))
    mirror = mi.load_dict(
        {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([-0.1, 0, 0]).rotate([0, 1, 0], 90).scale(0.5),
            "bsdf": {"type": "conductor", "material": "none"},
        }
    )
    camera = Camera.look_at((0.4, 0.25, 0), (-0.1, 0.1, 0), width=64, height=48, fov_x=30)
    pictures = []
    for shape in (plain, dark):
        integrator = make_integrator(shadow="none", quality="fast", mesh_samples=16)
        scene = mi.load_dict({"type": "scene", "ball": shape, "mirror": mirror})
        pictures.append(render_layers(integrator, scene, camera))
    # Excludes the ball itself; the mirror shows through its rim.
    beside = ~cv2.dilate(np.uint8(pictures[0].instance == 1), np.ones((5, 5))).astype(bool)
    before, after = (layers.rgb[beside].sum() for layers in pictures)
    assert before > 20 and after == pytest.approx(0.25 * before, rel=0.05)


@pytest.mark.parametrize(
    ("properties", "sentence"),
    [
        ({"wear": 1.5}, "'wear' must be in"),
        ({"colours": "1 2 3"}, "'colours' must be nine numbers (got '1 2 3')"),
        ({"colours": "a b c d e f g h i"}, "'colours' must be nine numbers"),
        ({"wear_seed": -1}, "'wear_seed' must be from 0 to 8388607"),
    ],
)
def test_invalid_properties_are_refused(properties: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError) as error:
        ball(**properties)
    assert sentence in str(error.value)
