"""Tabulated rectangular lamps against Mitsuba's plugins."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.runtime.variant import ensure_variant

ensure_variant()
from mitsplat.renderer.emitters.emitter_sampling import Emitters, receiver  # noqa: E402
from mitsplat.renderer.emitters.rectangle_lights import Rectangles  # noqa: E402


def lamp(place: tuple[float, float, float], scale: tuple[float, float, float], **more: Any) -> dict[str, Any]:
    pose = mi.ScalarTransform4f().look_at(origin=list(place), target=[0, 0, 0], up=[0, 1, 0.2])
    light = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}
    return {"type": "rectangle", "to_world": pose @ mi.ScalarTransform4f().scale(list(scale)), "emitter": light, **more}


LAMPS = {
    "plain": lamp((0.3, 0.2, 1.0), (0.2, 0.3, 1.0)),
    "mirrored": lamp((-0.5, 0.4, 0.7), (-0.1, 0.05, 1.0)),
    "flipped": lamp((0.1, -0.4, 0.9), (0.3, 0.1, 1.0), flip_normals=True),
    "sky": {"type": "constant"},
}


def test_sampled_directions_and_light_equal_those_of_mitsuba() -> None:
    scene = mi.load_dict({"type": "scene", **LAMPS})
    emitters, pointers = scene.emitters(), scene.emitters_dr()
    sky = next(i for i, emitter in enumerate(emitters) if emitter.class_name() == "ConstantBackgroundEmitter")
    table = Rectangles.of(emitters, sky)
    assert table is not None
    rng = np.random.default_rng(1)
    count = 3000
    index = mi.UInt32(rng.choice([i for i in range(4) if i != sky], count).astype(np.uint32))
    point = mi.Point2f(rng.random((2, count)).astype(np.float32))
    si = receiver(mi.Point3f(rng.uniform(-2, 2, (3, count)).astype(np.float32)), mi.Vector3f(0, 0, 1))
    direction, distance, light, _ = table.towards(si.p, index, point)
    sample, radiance = dr.gather(mi.EmitterPtr, pointers, index).sample_direction(si, point, True)
    np.testing.assert_allclose(np.array(direction), np.array(sample.d), atol=1e-5)
    np.testing.assert_allclose(np.array(distance), np.array(sample.dist), rtol=1e-5)
    np.testing.assert_allclose(np.array(light), np.array(radiance), rtol=1e-3, atol=1e-5)
    assert 0.2 < np.mean(np.array(light)[0] > 0) < 0.8


def test_irradiance_equals_the_sum_over_many_points_of_mitsuba() -> None:
    """Places lie on all sides of the lamps, and many lamps cross the horizon of a place.

    The terms of Lambert's sum nearly cancel for a small distant lamp. Each is half the radiance times the angle of an
    edge, rounded at most 16 times by 2^-24: cross product 2, dot product 3, root 2, quotient 4, arc tangent 4, and
    product 1. Quotients and roots of CUDA are approximate.
    """
    tiny = lamp((3.0, -4.0, 5.0), (0.002, 0.004, 1.0))
    close = lamp((0.0, 0.1, 0.3), (1.0, 0.8, 1.0))
    # Sums of the angles of all edges: at most circumference over distance, and 2 pi per lamp.
    for lamps, angles in (({"tiny": tiny}, 0.024 / 5), ({"close": close}, 2 * np.pi), (LAMPS, 6 * np.pi)):
        scene = mi.load_dict({"type": "scene", **lamps})
        emitters = scene.emitters()
        sky = next((i for i, emitter in enumerate(emitters) if emitter.is_environment()), None)
        table = Rectangles.of(emitters, sky)
        assert table is not None
        rng, count, grid = np.random.default_rng(2), 60, 256
        normals = rng.normal(size=(3, count))
        normals /= np.linalg.norm(normals, axis=0)
        places = mi.Point3f(rng.uniform(-1, 1, (3, count)).astype(np.float32))
        found = np.array(table.irradiance(places, mi.Vector3f(normals.astype(np.float32)), mi.Bool(True)))
        lane = dr.arange(mi.UInt32, count * grid * grid)
        row, cell = lane // (grid * grid), lane % (grid * grid)
        point = mi.Point2f(mi.Float(cell % grid) + 0.5, mi.Float(cell // grid) + 0.5) / grid
        normal = dr.gather(mi.Vector3f, mi.Vector3f(normals.astype(np.float32)), row)
        si = receiver(dr.gather(mi.Point3f, places, row), normal)
        expected = np.zeros((3, count))
        for i, emitter in enumerate(emitters):
            if i != sky:
                sample, radiance = emitter.sample_direction(si, point, True)
                light = np.array(radiance * dr.maximum(dr.dot(normal, sample.d), 0), np.float64)
                expected += light.reshape(3, count, -1).mean(axis=2)
        assert 0.2 < np.mean(expected[0] > 0) < 0.9
        rounding = 3.0 / 2 * angles * 16 * 2.0**-24
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-5 * expected.max() + rounding)


@pytest.mark.parametrize(
    "other",
    [
        {"type": "point", "position": [0, 0, 1]},
        {"type": "disk", "emitter": {"type": "area"}},
        {
            "type": "rectangle",
            "emitter": {"type": "area", "radiance": {"type": "checkerboard"}},
        },
    ],
    ids=["point", "disk", "textured"],
)
def test_other_lamps_are_sampled_by_mitsuba(other: dict[str, Any]) -> None:
    scene = mi.load_dict({"type": "scene", "lamp": LAMPS["plain"], "other": other})
    assert Rectangles.of(scene.emitters(), None) is None


def test_rays_towards_sample_points_hit_the_rectangle_with_the_same_radiance_and_density() -> None:
    scene = mi.load_dict({"type": "scene", **{name: LAMPS[name] for name in ("plain", "mirrored", "flipped")}})
    table = Rectangles.of(scene.emitters(), None)
    assert table is not None
    rng, count = np.random.default_rng(3), 500
    place = mi.Point3f(rng.uniform(-0.3, 0.3, (3, count)).astype(np.float32))
    index = mi.UInt32(rng.integers(0, len(scene.emitters()), count).astype(np.uint32))
    point = mi.Point2f(rng.uniform(0.01, 0.99, (2, count)).astype(np.float32))
    direction, _, light, density = table.towards(place, index, point)
    number, distance, radiance, same = (np.array(v, np.float64) for v in table.along(mi.Ray3f(place, direction)))
    hit = scene.ray_intersect(mi.Ray3f(place, direction))
    front = (np.array(light).sum(axis=0) > 0) & (number == np.array(index))
    assert front.sum() > 100
    np.testing.assert_allclose(distance[front], np.array(hit.t)[front], rtol=1e-4)
    np.testing.assert_allclose(same[front], np.array(density)[front], rtol=1e-3)
    np.testing.assert_allclose(radiance[:, front] / same[front], np.array(light)[:, front], rtol=1e-3)
    backwards = table.along(mi.Ray3f(place, -direction))[1]
    assert np.isinf(np.array(backwards)).mean() > 0.9


def test_rays_hit_sheared_lamps_as_in_mitsuba() -> None:
    """A square that is turned in its plane and then stretched is a parallelogram."""
    transform = mi.ScalarTransform4f()
    down = transform.translate([0, 0, 1]) @ transform.rotate([1, 0, 0], 180)
    pose = down @ transform.scale([1, 0.3, 1]) @ transform.rotate([0, 0, 1], 40)
    scene = mi.load_dict(
        {"type": "scene", "lamp": {"type": "rectangle", "to_world": pose, "emitter": {"type": "area"}}}
    )
    rng, count = np.random.default_rng(5), 2000
    direction = np.append(rng.uniform(-1.5, 1.5, (2, count)), np.ones((1, count)), axis=0)
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), dr.normalize(mi.Vector3f(direction.astype(np.float32))))
    si = receiver(dr.zeros(mi.Point3f, count), mi.Vector3f(0, 0, 1))
    radiance, density = Emitters(scene, (0, 0, 0)).emission(scene, si, ray, dr.full(mi.Bool, True, count))
    hit = np.array(scene.ray_intersect(ray).is_valid())
    np.testing.assert_array_equal(np.array(radiance)[0] > 0, hit)
    # The sampling density integrates to 1 over the lamp; dw = cos^3 du dv over slopes.
    cosine = np.array(ray.d)[2]
    assert 9 * np.mean(np.array(density) * cosine**3) == pytest.approx(1, rel=0.1)
