"""Invariance of a fit: a moved, rotated and scaled capture gives splats that are transformed alike.

===================================  =============================================
Transformation                       Result
===================================  =============================================
Scaling by a power of two            Exactly equal, because no digit changes.
Other scaling, and translation       Equal within an optimiser step.
Rotation                             Differences as between fits with two seeds.
===================================  =============================================

Other scaling and a translation round the means differently. Where a gradient vanishes, rounding decides its sign. Adam
then moves a parameter by its rate for any size of the gradient.

A rotation is no symmetry of a fit. Adam scales every coordinate by its own gradients. Gaussians start aligned with the
axes of the world and are stretched along these axes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsplat.capture.capture import Capture
from mitsplat.fit import trainer as fit
from mitsplat.fit.fit_folder import FitResult
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.fit.image_metrics import psnr
from mitsplat.fit.trainer import fit_capture
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.layers import render_splats
from tests.fit.test_fit import SMALL, photograph, seeing


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Return photos of the ball with their visible points, so that depths contribute to the loss."""
    return seeing(photograph(tmp_path_factory.mktemp("photos")))


def similarity(scale: float, translation: tuple[float, float, float], rotation: Rotation | None = None) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * (rotation or Rotation.identity()).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def fitted(capture: Capture, folder: Path, matrix: np.ndarray, settings: FitSettings) -> tuple[FitResult, FitResult]:
    """Fit the capture and the transformed capture, and return both results."""
    moved = fit_capture(capture.transformed(matrix), folder / "moved", settings)
    return fit_capture(capture, folder / "still", settings), moved


def test_scaling_by_a_power_of_two_changes_no_bit_of_a_fit(capture: Capture, tmp_path: Path) -> None:
    still, moved = fitted(capture, tmp_path, similarity(4, (0, 0, 0)), SMALL)
    assert len(still.splats) > 600 and moved.psnr == still.psnr
    for name, factor in (("means", 4), ("scales", 4), ("quats", 1), ("opacities", 1), ("sh", 1)):
        expected = np.float32(factor) * getattr(still.splats, name)
        np.testing.assert_array_equal(getattr(moved.splats, name), expected, err_msg=name)


def test_moving_and_scaling_changes_a_fit_by_less_than_an_optimiser_step(capture: Capture, tmp_path: Path) -> None:
    matrix = similarity(1.7, (1, -2, 0.5))
    still, moved = fitted(capture, tmp_path, matrix, replace(SMALL, iterations=20, refine_every=5))
    splats, expected = moved.splats, still.splats.transformed(matrix)
    assert len(splats) == len(expected) > 600 and moved.psnr == pytest.approx(still.psnr, abs=0.01)
    centres = np.array([photo.camera.centre for photo in capture.training])
    extent = 1.7 * 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    logits = [np.log(s.opacities / (1 - s.opacities)) for s in (splats, expected)]
    for rate, one, other in (
        (SMALL.rate_means * extent, splats.means, expected.means),
        (SMALL.rate_scales, np.log(splats.scales), np.log(expected.scales)),
        (SMALL.rate_opacities, *logits),
        (SMALL.rate_sh, splats.sh, expected.sh),
    ):
        # Rounding may reverse the sign of a gradient, so that a first step goes in the opposite direction.
        steps = np.abs(one - other) / rate
        assert steps.max() < 2 and (steps > 1 + 1e-6).mean() < 0.002


def test_rotating_changes_a_fit_no_more_than_another_seed(capture: Capture, tmp_path: Path) -> None:
    settings = replace(SMALL, iterations=40, rate_sh=0.01)
    matrix = similarity(1.7, (1, -2, 0.5), Rotation.from_rotvec([0.7, -0.4, 1.1]))
    still, moved = fitted(capture, tmp_path, matrix, settings)
    other = fit_capture(capture, tmp_path / "other", replace(settings, seed=1))

    def pictures(splats: Splats) -> np.ndarray:
        return np.stack([render_splats(splats, p.camera, quality=fit.QUALITY).rgb for p in capture.held_out])

    still_seen = pictures(still.splats)
    back = moved.splats.transformed(np.linalg.inv(matrix))
    assert psnr(pictures(back), still_seen) > psnr(pictures(other.splats), still_seen)
    assert moved.psnr == pytest.approx(still.psnr, abs=0.3)
