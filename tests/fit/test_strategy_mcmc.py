"""MCMC densification: moved and added Gaussians do not change the image."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.fit.optimizer import QUALITY, GaussianModel
from mitsplat.fit.strategy_mcmc import grow, jitter, relocate, seed_splats, split_opacity
from mitsplat.renderer.layers import make_sensor, render_splats
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_render import CAMERA, make_splats


@pytest.mark.parametrize("copies", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.97])
def test_copies_absorb_as_much_light_along_a_line_as_one_gaussian(copies: int, opacity: float) -> None:
    """The integral over x of 1 - (1 - o' exp(-x^2 / 2 s^2))^n equals that of o exp(-x^2 / 2)."""
    (own,), (factor,) = split_opacity(np.array([opacity]), np.array([copies]))
    x = np.linspace(-12, 12, 20001)
    several = 1 - (1 - own * np.exp(-0.5 * (x / factor) ** 2)) ** copies
    assert np.trapezoid(several, x) == pytest.approx(opacity * np.sqrt(2 * np.pi), rel=1e-6)
    assert 1 - (1 - own) ** copies == pytest.approx(opacity)


def model() -> GaussianModel:
    ensure_variant()
    splats = make_splats(40, 9, bands=4)
    return GaussianModel(replace(splats, opacities=np.where(np.arange(40) < 10, 0.001, splats.opacities)), 1.0)


def test_a_model_returns_its_splats_unchanged() -> None:
    ensure_variant()
    splats = make_splats(12, 3, bands=4)
    again = GaussianModel(splats, 0.7).splats()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(again, name), getattr(splats, name), rtol=2e-5, atol=1e-6, err_msg=name)


def test_dead_gaussians_are_moved_onto_live_ones() -> None:
    own = model()
    own.second["means"] = own.second["means"] + 1
    before = own.splats()
    picture = render_splats(before, CAMERA).rgb
    assert relocate(own, np.random.default_rng(0)) == 10
    after = own.splats()
    assert len(after) == 40 and (after.opacities > 0.004).all()
    living = {tuple(mean) for mean in before.means[10:]}
    assert all(tuple(mean) in living for mean in after.means)
    assert np.sqrt(np.mean((render_splats(after, CAMERA).rgb - picture) ** 2)) < 0.02
    # The moments of moved Gaussians, and of those at the same positions, are reset.
    moments = np.array(own.second["means"]).reshape(40, 3)
    assert (moments[:10] == 0).all() and 0 < (moments[10:, 0] == 0).sum() < 30


def test_growing_keeps_the_picture_and_reaches_the_requested_count() -> None:
    own = model()
    picture = render_splats(own.splats(), CAMERA).rgb
    grow(own, 55, np.random.default_rng(0))
    assert own.count == 55
    assert np.sqrt(np.mean((render_splats(own.splats(), CAMERA).rgb - picture) ** 2)) < 0.02
    grow(own, 50, np.random.default_rng(0))
    assert own.count == 55


def test_noise_follows_shape_and_spares_the_opaque() -> None:
    ensure_variant()
    count = 20000
    axis = np.tile([0.2, 0.1, 0.02], (count, 1))
    splats = seed_splats(np.random.default_rng(0).normal(size=(count, 3)), np.full((count, 3), 0.5), 0)
    faint = GaussianModel(replace(splats, scales=axis, opacities=np.full(count, 0.0005)), 1.0)
    before = np.array(faint.values["means"]).reshape(-1, 3)
    jitter(faint, 1e-5, (3, 4))
    moved = np.array(faint.values["means"]).reshape(-1, 3) - before
    gate = 1 / (1 + np.exp(-100 * (0.005 - 0.0005)))
    np.testing.assert_allclose(moved.std(axis=0), 5 * gate * axis[0] ** 2, rtol=0.03)
    assert np.abs(moved.mean(axis=0) / moved.std(axis=0)).max() < 0.03
    opaque = GaussianModel(replace(splats, scales=axis, opacities=np.full(count, 0.9)), 1.0)
    jitter(opaque, 1e-5, (3, 4))
    np.testing.assert_array_equal(np.array(opaque.values["means"]).reshape(-1, 3), before)


def test_gradients_and_rates_move_parameters_as_adam_does() -> None:
    own = model()
    own.track()
    weight = mi.Float(np.random.default_rng(0).normal(size=120).astype(np.float32))
    before = np.array(dr.detach(own.values["means"]))
    dr.backward(dr.sum(own.values["means"] * weight))
    own.update(dict.fromkeys(own.values, 0.001))
    # Adam's first step has the size of the rate for any size of the gradient.
    np.testing.assert_allclose(np.array(own.values["means"]), before - 1e-3 * np.sign(weight), atol=1e-6)


def test_gaussians_at_the_camera_stay_finite_and_do_not_move() -> None:
    ensure_variant()
    from mitsplat.renderer.differentiation.backward import render_differentiable
    from mitsplat.renderer.rays.sensors import view_of

    splats = make_splats(20, 3, bands=4)
    means = splats.means.copy()
    means[0], means[1] = CAMERA.centre, CAMERA.centre + 0.1 * CAMERA.world_from_camera[:3, 0]
    own = GaussianModel(replace(splats, means=means), 1.0)
    own.track()
    rgb, alpha = render_differentiable(own.cloud(), view_of(make_sensor(CAMERA)), QUALITY)
    dr.backward(dr.sum(rgb[0] + alpha))
    own.update(dict.fromkeys(own.values, 1e-3))
    after = own.splats()  # raises an exception for values that are not finite
    np.testing.assert_array_equal(after.means[:2], means[:2])
    assert (after.means[2:] != means[2:]).any()
