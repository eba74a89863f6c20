"""Isolation of the object: weights against the slow twin, and removal of planted floaters."""

from __future__ import annotations

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.reconstruct.segment_splats import MaskedView, VisibleWeights, find_floaters, isolate_object
from tests.conftest import KnownObject
from tests.reference import responses
from tests.renderer.test_backward import separated
from tests.renderer.test_render import CAMERA


def test_weights_equal_those_of_the_slow_twin() -> None:
    """Blended weight T a of every Gaussian, computed ray by ray in float64."""
    splats = separated(12, 1)
    mask = np.random.default_rng(0).random((CAMERA.height, CAMERA.width)).astype(np.float32)
    expected = np.zeros((12, 2))
    x, y = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    for (u, v), share in zip(CAMERA.ray_slopes(np.stack([x.ravel(), y.ravel()], axis=1)), mask.ravel(), strict=True):
        opacity, z = responses(splats, CAMERA, u, v)
        order = np.argsort(z, kind="stable")
        behind = np.concatenate([[1.0], np.cumprod(1 - opacity[order])[:-1]])
        expected[order] += (behind * opacity[order])[:, None] * (share, 1 - share)
    found = VisibleWeights(splats)(MaskedView(CAMERA, mask))
    assert expected.max() > 3
    # Contributions after the cut-off at an opacity of 0.002 are missing.
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.05)


def test_a_mask_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="24 x 32 px"):
        MaskedView(CAMERA, np.ones((32, 24), dtype=np.float32))


def rubbish(means: np.ndarray, scale: object, opacity: float = 0.9) -> Splats:
    count = len(means)
    return Splats(
        means=means,
        quats=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        scales=np.broadcast_to(scale, (count, 3)),
        opacities=np.full(count, opacity),
        sh=np.zeros((count, 1, 3)),
    )


def test_surroundings_floaters_and_needles_are_removed(known_object: KnownObject) -> None:
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 40), np.linspace(-0.2, 0.2, 40))
    table = rubbish(np.stack([x.ravel(), y.ravel(), np.full(x.size, -0.06)], axis=1), (0.006, 0.006, 0.001))
    speck = rubbish(np.array([[-0.01, 0.0, 0.035], [-0.009, 0.0, 0.035]]), 5e-4)  # floats inside the pocket
    needle = rubbish(np.array([[0.045, 0.01, 0.02]]), (0.0005, 0.02, 0.0005))
    buried = rubbish(np.array([[0.0, 0.0, -0.01]]), 0.001)
    parts = [known_object.splats, table, speck, needle, buried]
    views = [
        MaskedView(camera, mask)
        for camera, _, mask, _ in (photo.fitted(160) for photo in known_object.capture.photos)
        if mask is not None and camera.centre[2] > 0  # no camera is below the table
    ]
    found = isolate_object(Splats.concatenate(parts), views)
    ends = np.cumsum([len(part) for part in parts])
    own, table_kept, speck_kept, needle_kept, buried_kept = np.split(found.kept, ends[:-1])
    seen_from_above = known_object.splats.means[:, 2] > 0
    assert own[seen_from_above].mean() > 0.97
    assert not table_kept.any()
    assert not speck_kept.any()
    assert not needle_kept.any()
    assert not buried_kept.any()
    assert found.needles >= 1
    assert found.floaters >= 2
    assert found.unseen + found.outside + found.needles + found.floaters == (~found.kept).sum()
    assert found.lost < 0.02
    assert len(found.splats) == found.kept.sum()


def test_lost_alpha_is_the_share_that_masks_omit(known_object: KnownObject) -> None:
    """The lost alpha equals the share of uncovered pixels if splats are missing in the middle of the masks."""
    views = [
        MaskedView(camera, mask if number % 2 else np.zeros_like(mask))
        for number, (camera, _, mask, _) in enumerate(photo.fitted(160) for photo in known_object.capture.photos)
        if mask is not None
    ]
    assert isolate_object(known_object.splats, views).lost > 0.05


def test_masks_that_do_not_fit_the_splats_are_refused(known_object: KnownObject) -> None:
    views = [
        MaskedView(photo.camera, np.zeros((photo.camera.height, photo.camera.width), dtype=np.float32))
        for photo in known_object.capture.photos[:4]
    ]
    with pytest.raises(InputError, match="do the masks belong to this capture"):
        isolate_object(known_object.splats, views)
    with pytest.raises(InputError, match="isolation of an object needs views with masks"):
        isolate_object(known_object.splats, [])


def test_separate_dense_clusters_are_not_floaters() -> None:
    """A row of sixty touching clusters of twenty Gaussians each, and one separate cluster."""
    places = np.append(np.arange(60) * 0.01, 1.0)
    means = np.zeros((61 * 20, 3))
    means[:, 0] = np.repeat(places, 20) + np.random.default_rng(6).uniform(-1e-4, 1e-4, 61 * 20)
    found = find_floaters(rubbish(means, 0.005), np.ones(len(means)))
    np.testing.assert_array_equal(found, np.arange(1200, 1220))
