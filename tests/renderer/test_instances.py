"""Instance image: each pixel has the id of the instance with the largest share of its centre ray."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.frames.scene_builder import NO_SPLATS
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import PRESETS, Quality
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.runtime.variant import ensure_variant
from tests.reference import reference_shares

CAMERA = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=24, height=20, fov_x=40)
EXACT = replace(PRESETS["exact"], alpha_min=1e-7, transmittance_min=0.0)
TIE = 2e-5
"""Difference of two shares below which either may win: float32 against float64, and the cut-off."""


def gaussians(means: npt.ArrayLike, quats: npt.ArrayLike, scales: npt.ArrayLike, opacities: npt.ArrayLike) -> Splats:
    return Splats(means, quats, scales, opacities, np.zeros((len(np.asarray(means)), 1, 3)))


def porous(count: int, seed: int) -> tuple[Splats, npt.NDArray[np.int64]]:
    """Return instances (some are the environment) of small, half-transparent Gaussians, all in one place."""
    rng = np.random.default_rng(seed)
    n = 60 * count
    splats = gaussians(
        rng.normal(0, 0.25, (n, 3)),
        Rotation.random(n, rng=rng).as_quat(),
        np.exp(rng.uniform(np.log(0.03), np.log(0.15), (n, 3))),
        rng.uniform(0.02, 0.5, n),
    )
    ids = rng.choice(np.arange(10 * count), count, replace=False)
    return splats, ids[rng.integers(0, count, n)]


def layered(count: int, seed: int) -> tuple[Splats, npt.NDArray[np.int64]]:
    """Return wide sheets of different instances, one behind the other, also in the order of the tile lists."""
    rng = np.random.default_rng(seed)
    n = 24
    splats = gaussians(
        np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)), np.linspace(-0.8, 0.8, n)]),
        np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
        np.column_stack([rng.uniform(0.1, 0.6, (n, 2)), np.full(n, 1e-3)]),
        rng.uniform(0.03, 0.6, n),
    )
    return splats, rng.integers(1, count + 1, n)


def shown(splats: Splats, ids: npt.NDArray[np.int64], quality: Quality, camera: Camera = CAMERA) -> npt.NDArray:
    """Render the instance image of Gaussians that belong to instances by row."""
    ensure_variant()
    shapes = {f"instance_{i}": make_splats_shape(splats.select(ids == i), instance=int(i)) for i in np.unique(ids)}
    integrator = make_integrator(quality=quality, shadow="none")
    return render_layers(integrator, mi.load_dict({"type": "scene", **shapes}), camera).instance


def differences(found: npt.NDArray, shares: npt.NDArray) -> tuple[int, int]:
    """Count the pixels whose instance has a smaller share than another one, and the pixels with a tie."""
    mine = np.take_along_axis(shares, found[..., None].astype(int), axis=2)[..., 0]
    first, second = np.sort(shares, axis=2)[..., :-3:-1].transpose(2, 0, 1)
    return np.count_nonzero(mine < first - TIE), np.count_nonzero(first - second < TIE)


@pytest.mark.parametrize("count", range(3, 9))
def test_porous_instances_in_one_place_have_the_ids_of_the_slow_twin(count: int) -> None:
    splats, ids = porous(count, count)
    shares = reference_shares(splats, ids, CAMERA)
    assert len(np.unique(shares.argmax(axis=2))) >= count  # each instance is visible somewhere
    wrong, ties = differences(shown(splats, ids, EXACT), shares)
    assert wrong == 0 and ties < 8


@pytest.mark.parametrize("before", range(1, 4))
def test_shapes_without_gaussians_do_not_shift_other_ids(before: int) -> None:
    """Proxies have no Gaussians, and come first in a scene without an environment."""
    ensure_variant()
    ball = gaussians([(0, 0, 0)], [(0, 0, 0, 1)], [(0.1, 0.1, 0.1)], [0.9])
    poses = [mi.ScalarTransform4f().translate([x, y, 0]).matrix for x, y in ((-0.4, 0.2), (0, -0.3), (0.4, 0.1))]
    balls = {f"ball_{i}": make_splats_shape(ball, np.array(pose), instance=i) for i, pose in enumerate(poses, start=1)}
    proxy = trimesh.creation.box((0.1, 0.1, 0.1), np.array(mi.ScalarTransform4f().translate([0, 0, 9]).matrix))
    proxies = {f"proxy_{i}": make_splats_shape(NO_SPLATS, proxy=proxy) for i in range(before)}
    integrator = make_integrator(quality=EXACT, shadow="none")
    alone, first = (
        render_layers(integrator, mi.load_dict({"type": "scene", **shapes}), CAMERA).instance
        for shapes in (balls, proxies | balls)
    )
    assert set(np.unique(alone)) == {0, 1, 2, 3}
    assert (first == alone).all()


@pytest.mark.parametrize("tolerance", [0.0, 1e-3, math.inf])
def test_sheets_in_any_order_have_the_ids_of_the_slow_twin(tolerance: float) -> None:
    wrong = ties = 0
    for count, seed in itertools.product((3, 4, 5, 8, 20), (1, 2)):
        splats, ids = layered(count, seed)
        found = shown(splats, ids, replace(EXACT, tolerance=tolerance))
        wrong, ties = np.add((wrong, ties), differences(found, reference_shares(splats, ids, CAMERA)))
    assert wrong == 0 and ties < 20


@pytest.mark.parametrize("tolerance", [0.0, 1e-3, math.inf])
def test_the_largest_share_wins_for_a_sheet_met_in_small_pieces(tolerance: float) -> None:
    """Weights .20, .16 and .636: the last consists of forty Gaussians, each below the other weights."""
    last = 1 - (1 - 0.636 / 0.64) ** (1 / 40)
    opacities = np.array([0.2, 0.2, *[last] * 40])
    n = len(opacities)
    means = np.column_stack([np.zeros((n, 2)), np.linspace(-0.5, 0.5, n)])
    splats = gaussians(means, np.tile([0.0, 0, 0, 1], (n, 1)), np.tile([50, 50, 1e-4], (n, 1)), opacities)
    ids = np.array([1, 2, *[3] * 40])
    np.testing.assert_allclose(reference_shares(splats, ids, CAMERA)[10, 12], [0.004, 0.2, 0.16, 0.636], atol=1e-3)
    assert (shown(splats, ids, replace(EXACT, tolerance=tolerance)) == 3).all()


def test_a_hundred_instances_on_one_ray_have_the_id_of_the_largest_share() -> None:
    """A second walk cannot separate them all; the largest share comes last, in pieces below all other weights."""
    rng = np.random.default_rng(1)
    ids = np.concatenate([rng.permutation(np.arange(1, 101)), np.resize([101, 50, 101, 7], 600)])
    n = len(ids)
    means = np.column_stack([np.zeros((n, 2)), np.linspace(-0.5, 0.5, n)])
    scales = np.tile([0.5, 0.4, 1e-5], (n, 1))
    splats = gaussians(means, np.tile([0.0, 0, 0, 1], (n, 1)), scales, np.where(np.arange(n) < 100, 0.01, 0.009))
    shares = reference_shares(splats, ids, CAMERA)
    assert (shares.argmax(axis=2) == 101).sum() > 100
    wrong, ties = differences(shown(splats, ids, EXACT), shares)
    assert wrong == 0 and ties < 8


@pytest.mark.cpu(reason="there is nothing else to compare with on a GPU, which is never waited for")
def test_ids_are_equal_without_waiting_for_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skipping the check for ambiguous rays, as on a GPU, changes no id."""
    from mitsplat.renderer.splatting import march

    looked = []
    settle = march.resolve_instances
    monkeypatch.setattr(march, "resolve_instances", lambda *args: looked.append(0) or settle(*args))
    alone, crowd = porous(2, 3), porous(5, 3)
    expected = [shown(*splats, EXACT) for splats in (alone, crowd)]
    assert len(looked) == 1
    monkeypatch.setattr(dr, "backend_v", lambda _: dr.JitBackend.CUDA)
    found = [shown(*splats, EXACT) for splats in (alone, crowd)]
    assert len(looked) == 3
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_array_equal(a, b)
