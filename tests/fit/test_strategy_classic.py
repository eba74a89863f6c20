"""Classic densification: clones, splits, removals and resets, and the image gradients that control them."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.assets.strategy_classic import Classic, control_density, image_gradient, lower_opacities
from mitsplat.fit.optimizer import GaussianModel
from mitsplat.fit.strategy_mcmc import seed_splats
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.layers import make_sensor
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_backward import QUALITY, loss_of_twin, separated, weights
from tests.renderer.test_render import CAMERA

UNIT = 0.7


def tracked(splats: Splats) -> GaussianModel:
    """Return a model with the gradients of the loss of :func:`loss_of_twin`."""
    ensure_variant()
    from mitsplat.renderer.differentiation.backward import render_differentiable
    from mitsplat.renderer.rays.sensors import view_of

    own = GaussianModel(splats, UNIT)
    own.track()
    rgb, alpha = render_differentiable(own.cloud(), view_of(make_sensor(CAMERA)), QUALITY)
    colour_weight, alpha_weight = weights()
    loss = dr.sum(alpha * mi.Float(alpha_weight.ravel()))
    for i in range(3):
        loss += dr.sum(rgb[i] * mi.Float(colour_weight[..., i].ravel()))
    dr.backward(loss)
    return own


def test_gradient_in_the_image_is_the_change_of_the_loss_by_the_change_of_place() -> None:
    """The gradient equals finite differences of the float64 reference loss over those of the projected centres.

    Image coordinates span 2 in width and 2 in height.
    """
    splats = separated(8, 1)
    pull, seen = image_gradient(tracked(splats), CAMERA)
    assert np.array(seen).all()
    half = np.array([CAMERA.width, CAMERA.height]) / 2
    expected = np.zeros((8, 2))
    for row in range(8):
        for axis in range(2):
            losses, places = [], []
            for sign in (1, -1):
                means = splats.means.astype(np.float64)
                means[row] += sign * 1e-3 * CAMERA.world_from_camera[:3, axis]
                moved = replace(splats, means=means)
                losses.append(loss_of_twin(moved))
                places.append(CAMERA.project(moved.means[row])[0][0, axis] / half[axis])
            expected[row, axis] = (losses[0] - losses[1]) / (places[0] - places[1])
    np.testing.assert_allclose(np.array(pull), np.linalg.norm(expected, axis=1), rtol=5e-3)


def test_what_the_photo_does_not_show_is_not_counted() -> None:
    ensure_variant()
    inverse, size = CAMERA.world_from_camera, np.array([CAMERA.width, CAMERA.height])
    slope = 0.5 * size / (CAMERA.fx, CAMERA.fy)
    places = np.array([[0, 0, 2], [0, 0, -2], [2.2 * slope[0], 0, 2], [2.2 * slope[0], 0, 2], [0, -2.2 * slope[1], 2]])
    scales = np.full((5, 3), 0.01)
    scales[3, 1] = 0.2 * slope[0]  # the extents of three of these reach back into the image
    splats = seed_splats(places @ inverse[:3, :3].T + inverse[:3, 3], np.full((5, 3), 0.5), 0)
    own = GaussianModel(replace(splats, scales=scales), UNIT)
    own.track()
    np.testing.assert_array_equal(np.array(image_gradient(own, CAMERA)[1]), [True, False, False, True, False])


def model() -> GaussianModel:
    """Build six Gaussians in a row, in the model's unit: two small, two large, one faint, one very large."""
    ensure_variant()
    splats = seed_splats(np.arange(18.0).reshape(6, 3), np.full((6, 3), 0.5), 0)
    size = np.array([0.002, 0.002, 0.05, 0.05, 0.002, 0.5])
    opacities = np.where(np.arange(6) == 4, 0.004, 0.8)
    own = GaussianModel(replace(splats, scales=UNIT * np.repeat(size[:, None], 3, axis=1), opacities=opacities), UNIT)
    own.second["means"] = own.second["means"] + 1
    return own


HOT = np.array([3e-4, 0, 5e-4, 0, 1, 0])


def test_small_ones_are_cloned_large_ones_split_and_faint_ones_removed() -> None:
    own = model()
    before = own.splats()
    control_density(own, HOT, 100, np.random.default_rng(0), remove_large=False)
    after = own.splats()
    assert len(after) == 7  # minus the faint one, plus a clone and a second part
    rows = np.array([0, 1, 2, 3, 5, 2, 0])
    part = rows == 2
    np.testing.assert_allclose(after.scales, before.scales[rows] / np.where(part, 1.6, 1)[:, None], rtol=1e-5)
    np.testing.assert_array_equal(after.means[~part], before.means[rows[~part]])
    distance = np.linalg.norm(after.means[part] - before.means[2], axis=1)
    assert (distance > 0).all() and (distance < 5 * before.scales[2, 0]).all()
    moments = np.array(own.second["means"]).reshape(-1, 3)[:, 0]
    np.testing.assert_array_equal(moments, [1, 1, 0, 1, 1, 0, 0])


def test_very_large_ones_go_once_opacities_were_reset() -> None:
    own = model()
    before = own.splats()
    control_density(own, np.zeros(6), 100, np.random.default_rng(0), remove_large=True)
    np.testing.assert_array_equal(own.splats().means, before.means[:4])


@pytest.mark.parametrize(("most", "count", "largest"), [(3, 5, 0.05), (5, 5, 0.05), (6, 6, 0.05 / 1.6)])
def test_the_budget_goes_to_the_largest_gradients(most: int, count: int, largest: float) -> None:
    """Two Gaussians qualify for densification. A budget for one more goes to the large one."""
    own = model()
    control_density(own, HOT, most, np.random.default_rng(0), remove_large=False)
    assert own.count == count
    assert own.splats().scales[2, 0] == pytest.approx(UNIT * largest)


def test_a_cloud_of_which_nothing_would_be_left_is_kept() -> None:
    own = model()
    own.values["opacities"] = own.values["opacities"] - 20
    control_density(own, HOT, 100, np.random.default_rng(0), remove_large=False)
    assert own.count == 6


def test_parts_are_spread_as_what_they_are_parts_of() -> None:
    ensure_variant()
    count, turn = 20_000, Rotation.from_rotvec([0.3, -0.8, 0.5])
    splats = seed_splats(np.zeros((count, 3)) + np.arange(count)[:, None], np.full((count, 3), 0.5), 0)
    scales = np.tile([0.3, 0.1, 0.02], (count, 1))
    splats = replace(splats, means=np.zeros((count, 3)), quats=np.tile(turn.as_quat(), (count, 1)), scales=scales)
    own = GaussianModel(splats, 1.0)
    control_density(own, np.ones(count), 2 * count, np.random.default_rng(0), remove_large=False)
    assert own.count == 2 * count
    spread = turn.inv().apply(own.splats().means).std(axis=0)
    np.testing.assert_allclose(spread, scales[0], rtol=0.02)


def test_opacities_are_lowered_and_their_moments_forgotten() -> None:
    own = model()
    own.first["opacities"] = own.first["opacities"] + 1
    lower_opacities(own)
    np.testing.assert_allclose(own.splats().opacities, [0.01] * 4 + [0.004, 0.01], rtol=1e-4)
    assert not np.array(own.first["opacities"]).any() and np.array(own.second["means"]).all()


def test_gradients_are_averaged_over_the_photos_that_show_a_gaussian() -> None:
    splats = separated(8, 1)
    own = tracked(splats)
    once = np.array(image_gradient(own, CAMERA)[0])
    away = replace(CAMERA, world_from_camera=CAMERA.world_from_camera @ np.diag([-1.0, 1, -1, 1]))
    classic = Classic(100, 10)
    for camera in (CAMERA, away, CAMERA):
        classic.accumulate(own, camera)
    again = Classic(100, 10)
    again.restore(classic.state())
    np.testing.assert_allclose(again.state()["pull"] / again.state()["photos"], once, rtol=1e-6)
    # A change resets the sums. The means are then as before.
    classic.refine(own, 10, 0.2, 1e-3, np.random.default_rng(0))
    changed = tracked(own.splats())
    expected = np.array(image_gradient(changed, CAMERA)[0])
    for _ in range(3):
        classic.accumulate(changed, CAMERA)
    assert (classic.state()["photos"] == 3).all()
    np.testing.assert_allclose(classic.state()["pull"] / 3, expected, rtol=1e-6)
