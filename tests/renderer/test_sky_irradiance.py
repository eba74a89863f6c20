"""Irradiance of environment maps by normal, against a quadrature of the same map."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.renderer.emitters.emitter_sampling import Emitters, receiver, sky_irradiance
from mitsplat.renderer.emitters.sky_irradiance import _folded, _unfolded
from mitsplat.runtime.variant import ensure_variant


def sky_with_a_sun() -> dict[str, object]:
    """Return clouds, and a sun of four degrees with as much irradiance as the clouds."""
    rng = np.random.default_rng(3)
    sky = rng.uniform(0.2, 0.8, (96, 192, 3)).astype(np.float32)
    sky[30:32, 50:52] = (900, 800, 600)
    turn = mi.ScalarTransform4f().rotate([0.36, 0.48, 0.8], 70)
    return {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": turn}


def by_quadrature(emitter: object, normals: np.ndarray) -> np.ndarray:
    """Return irradiance (N, 3) on unit normals (N, 3), by the midpoint rule over the sphere."""
    rows, columns = 384, 768
    theta = (np.arange(rows) + 0.5) / rows * np.pi
    phi = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = mi.Vector3f(-directions.T.astype(np.float32))
    radiance = np.array(emitter.eval(si)).T  # type: ignore[attr-defined]
    weight = np.sin(theta) * (np.pi / rows) * (2 * np.pi / columns)
    weighted = (radiance * weight[:, None]).astype(np.float32)
    cosines = normals.astype(np.float32) @ directions.T.astype(np.float32)
    return np.maximum(cosines, 0, out=cosines) @ weighted


def test_the_irradiance_table_agrees_with_a_quadrature() -> None:
    """Errors are within 1 % of the sky's largest irradiance where the sun sets.

    They are within 0.25 % in the mean of all normals.
    """
    ensure_variant()
    scene = mi.load_dict({"type": "scene", "sky": sky_with_a_sun()})
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(400, 3))
    normals = np.concatenate([normals / np.linalg.norm(normals, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    expected = by_quadrature(scene.emitters()[0], normals)
    table = sky_irradiance(scene.emitters_dr())
    found = np.array(table.at(mi.Vector3f(normals.T.astype(np.float32)), True)).T
    error = np.abs(found - expected) / expected.max()
    assert error.max() < 0.01
    assert error.mean() < 0.0025


def test_samples_of_an_environment_map_have_its_irradiance_as_mean() -> None:
    """With and without the sun above the horizon. The densities of directions integrate to 1 over the hemisphere."""
    ensure_variant()
    scene = mi.load_dict({"type": "scene", "sky": sky_with_a_sun()})
    normals = np.array([[0.0, 0, 1], [0, 0, -1], [0.6, 0, -0.8]])
    emitters, count = Emitters(scene, (0, 0, 0)), 1 << 18
    points = mi.Point2f(np.random.default_rng(0).random((2, count), dtype=np.float32))
    for normal, expected in zip(normals, by_quadrature(scene.emitters()[0], normals), strict=True):
        si = receiver(dr.zeros(mi.Point3f, count), mi.Vector3f(*normal.tolist()))
        beam = emitters.sample(si, points, mi.Bool(True))
        irradiance = np.array(beam.irradiance)
        error = irradiance.std(axis=1) / np.sqrt(count)
        np.testing.assert_array_less(np.abs(irradiance.mean(axis=1) - expected), 4 * error + 2e-3 * expected)
        above = np.array(dr.dot(beam.direction, mi.Vector3f(*normal.tolist()))) > 0
        inverse = np.where(above, 1 / np.maximum(np.array(beam.density), 1e-6), 0)
        assert inverse.mean() == pytest.approx(2 * np.pi, rel=0.02)


def test_the_octahedral_map_is_bijective() -> None:
    """The round trip is exact to rounding, also for directions on the fold and on the axes."""
    ensure_variant()
    rng = np.random.default_rng(1)
    vectors = np.concatenate([rng.normal(size=(1000, 3)), np.eye(3), -np.eye(3), [[1, 1, 0], [-1, 0, -1], [0, -1, -1]]])
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    x, y = _folded(mi.Vector3f(vectors.T.astype(np.float32)))
    assert np.all((np.array([x, y]) >= 0) & (np.array([x, y]) <= 1))
    np.testing.assert_allclose(np.array(_unfolded(x, y)).T, vectors, atol=2e-6)
