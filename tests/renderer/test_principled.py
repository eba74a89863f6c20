"""Specular lobe of the principled BSDF: against Mitsuba, and against laws of reflection."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest

from mitsplat.runtime.variant import ensure_variant

ensure_variant()
from mitsplat.renderer.materials.principled import SpecularLobe, diffuse_reflectance, mirrored_uniform  # noqa: E402

COUNT = 4096
BASE = (0.8, 0.4, 0.2)
Case = tuple[float, float, float, float]
CASES: list[Case] = [
    (0.3, 1.0, 0.5, 0.0),
    (0.5, 0.0, 0.5, 0.0),
    (0.2, 0.4, 0.8, 0.0),
    (0.1, 1.0, 0.5, 0.0),
    (1.0, 0.7, 1.0, 0.0),
    (0.3, 1.0, 0.5, 0.6),
    (0.5, 0.2, 0.5, 1.0),
]
"""Roughness, metallic, specular and ``anisotropic`` of the BSDF ``principled``."""


def directions(seed: int) -> mi.Vector3f:
    """Return random unit vectors of the upper hemisphere, at least 3 degrees above the horizon."""
    rng = np.random.default_rng(seed)
    z, angle = rng.uniform(0.05, 1, COUNT), rng.uniform(0, 2 * np.pi, COUNT)
    side = np.sqrt(1 - z**2)
    return mi.Vector3f(np.stack([side * np.cos(angle), side * np.sin(angle), z]).astype(np.float32))


def lobe(
    view: mi.Vector3f, roughness: float, metallic: float, specular: float, anisotropic: float = 0.0
) -> SpecularLobe:
    """``principled`` has the GGX parameters roughness^2 / aspect and roughness^2 aspect."""
    aspect = np.sqrt(1 - 0.9 * anisotropic)
    bend = roughness**2 * np.sqrt(1 / aspect**2 - aspect**2)
    parameters = mi.Float(float(roughness * np.sqrt(aspect))), mi.Float(metallic), mi.Float(specular)
    return SpecularLobe.of(mi.Vector3f(0, 0, 1), view, *parameters, mi.Vector3f(float(bend), 0, 0))


def reflected(view: mi.Vector3f, light: mi.Vector3f, case: Case) -> npt.NDArray[np.float64]:
    """Return f cos of the specular lobe for the base colour, shape (3, COUNT)."""
    own = lobe(view, *case)
    value, _, cos_half = own.evaluate(light)
    fresnel = own.fresnel(cos_half)
    return np.array(mi.Color3f(value * (fresnel.tint * mi.Color3f(BASE) + fresnel.white)), np.float64)


@pytest.mark.parametrize("case", CASES)
def test_lobe_and_diffuse_share_equal_those_of_mitsuba(case: Case) -> None:
    """The diffuse part is that of Burley 2012, for the base colour (1 - metallic)."""
    roughness, metallic, specular, anisotropic = case
    description = {"type": "principled", "base_color": {"type": "rgb", "value": list(BASE)}, "roughness": roughness}
    bsdf = mi.load_dict({**description, "metallic": metallic, "specular": specular, "anisotropic": anisotropic})
    view, light = directions(0), directions(1)
    si = mi.SurfaceInteraction3f()
    si.wi = view
    expected = np.array(bsdf.eval(mi.BSDFContext(), si, light), np.float64)
    cos_half = lobe(view, *case).evaluate(light)[2]
    matt = diffuse_reflectance(light.z, view.z, cos_half, mi.Float(roughness)) * light.z / dr.pi
    diffuse = (1 - metallic) * np.array(BASE)[:, None] * np.array(matt, np.float64)
    np.testing.assert_allclose(reflected(view, light, case) + diffuse, expected, rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("case", CASES)
def test_light_and_camera_can_be_exchanged(case: Case) -> None:
    """Helmholtz reciprocity: f(v, w) = f(w, v)."""
    view, light = directions(2), directions(3)
    there = reflected(view, light, case) / np.array(light.z)
    back = reflected(light, view, case) / np.array(view.z)
    np.testing.assert_allclose(there, back, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("case", CASES)
def test_samples_have_the_stated_density_and_weight(case: Case) -> None:
    own = lobe(directions(4), *case)
    rng = np.random.default_rng(5)
    direction, weight, cos_half = own.sample(mi.Point2f(rng.random((2, COUNT)).astype(np.float32)))
    value, density, same = own.evaluate(direction)
    above = np.array(own.frame.to_local(direction).z) > 1e-3
    ratio = np.array(value, np.float64)[above] / np.array(density, np.float64)[above]
    np.testing.assert_allclose(ratio, np.array(weight)[above], rtol=1e-3)
    np.testing.assert_allclose(np.array(same)[above], np.array(cos_half)[above], atol=1e-4)
    assert not np.array(weight)[np.array(own.frame.to_local(direction).z) < 0].any()


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
def test_sampled_reflectance_equals_the_sum_over_the_hemisphere(roughness: float) -> None:
    view = mi.Vector3f(0.6, 0.0, 0.8)
    own, n = lobe(view, roughness, 0.0, 0.5), 512
    x, y = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n)
    upward = mi.warp.square_to_uniform_hemisphere(mi.Point2f(x.ravel(), y.ravel()))
    value, _, cos_half = own.evaluate(upward)
    summed = 2 * np.pi * np.mean(np.array(value * own.fresnel(cos_half).white, np.float64))
    assert float(mirrored_uniform(own)[0]) == pytest.approx(summed, rel=0.03)


def test_no_lobe_reflects_more_light_than_arrives() -> None:
    """Random materials of base colour 1 under uniform light."""
    rng = np.random.default_rng(6)
    parameters = [mi.Float(rng.random(COUNT).astype(np.float32)) for _ in range(3)]
    own, total = SpecularLobe.of(mi.Vector3f(0, 0, 1), directions(7), *parameters), np.zeros(COUNT)
    for x, y in rng.random((256, 2)):
        _, weight, cos_half = own.sample(mi.Point2f(float(x), float(y)))
        fresnel = own.fresnel(cos_half)
        total += np.array(weight * (fresnel.tint + fresnel.white), np.float64) / 256
    assert 0.9 < total.max() < 1.001
