"""Refinement of splats towards given images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsplat.fit.optimizer import QUALITY
from mitsplat.fit.refine_splats import Picture, refine_splats
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.layers import render_splats
from tests.renderer.test_render import make_splats


def cameras(count: int) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [2.2 * np.array([np.cos(a), np.sin(a), 0.3]) for a in angles]
    return [Camera.look_at(eye, (0, 0, 0), width=48, height=40, fov_x=45) for eye in eyes]


def picture(splats: Splats, camera: Camera) -> Picture:
    layers = render_splats(splats, camera, quality=QUALITY)
    alpha = layers.alpha[..., None]
    colour = np.clip(encode_srgb(layers.rgb / np.maximum(alpha, 1e-6)), 0, None) * alpha
    return Picture(camera, colour.astype(np.float32), layers.alpha)


def error(splats: Splats, truth: Splats, camera: Camera) -> float:
    return float(np.mean((picture(splats, camera).rgb - picture(truth, camera).rgb) ** 2))


def test_refinement_recovers_disturbed_splats_on_unseen_views() -> None:
    truth = make_splats(60, 41, bands=4)
    rng = np.random.default_rng(0)
    start = replace(
        truth,
        means=truth.means + rng.normal(0, 0.03, truth.means.shape),
        scales=truth.scales * np.exp(rng.normal(0, 0.2, truth.scales.shape)),
        sh=truth.sh + rng.normal(0, 0.2, truth.sh.shape),
    )
    shown = [picture(truth, camera) for camera in cameras(8)]
    steps: list[float] = []
    fitted = refine_splats(start, shown, iterations=160, observe=lambda step, psnr: steps.append(psnr))
    unseen = Camera.look_at((1.5, 1.6, 0.5), (0, 0, 0), width=48, height=40, fov_x=45)
    assert len(steps) == 17 and steps[-1] > steps[0]
    assert error(fitted, truth, unseen) < 0.15 * error(start, truth, unseen)


def test_refinement_without_pictures_is_refused() -> None:
    with pytest.raises(ValueError, match="pictures"):
        refine_splats(make_splats(2), [], iterations=1)
