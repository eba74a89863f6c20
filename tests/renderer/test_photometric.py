"""L1 + D-SSIM against scikit-image and finite differences."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from skimage.metrics import structural_similarity

from mitsplat.fit import image_metrics as metrics
from mitsplat.runtime.variant import ensure_variant

WIDTH, HEIGHT = 45, 37
BORDER = 11


def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Return two images (3, H, W) that are equal and flat where windows extend beyond the border."""
    rng = np.random.default_rng(2)
    a = np.zeros((3, HEIGHT, WIDTH))
    inner = np.s_[:, BORDER:-BORDER, BORDER:-BORDER]
    a[inner] = rng.random(a[inner].shape)
    b = a.copy()
    b[inner] = np.clip(a[inner] + rng.normal(0, 0.2, a[inner].shape), 0, 1)
    return a, b


def loss(a: np.ndarray, b: np.ndarray, share: float) -> tuple[float, np.ndarray]:
    ensure_variant()
    from mitsplat.renderer.differentiation.photometric_loss import photometric_loss

    seen = [mi.Float(c.ravel().astype(np.float32)) for c in a]
    dr.enable_grad(seen)
    value = photometric_loss(seen, [mi.Float(c.ravel().astype(np.float32)) for c in b], WIDTH, HEIGHT, share)
    result = float(value.numpy()[0])
    dr.backward(value)
    return result, np.stack([np.array(dr.grad(c)).reshape(HEIGHT, WIDTH) for c in seen])


def test_dssim_agrees_with_scikit_image() -> None:
    a, b = pictures()
    _, full = structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=0, full=True
    )
    assert abs(loss(a, b, 1.0)[0] - (1 - full.mean())) < 1e-5


def test_l1_is_the_mean_difference() -> None:
    a, b = pictures()
    assert abs(loss(a, b, 0.0)[0] - np.abs(a - b).mean()) < 1e-6


def test_gradient_equals_finite_differences() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.random((3, HEIGHT, WIDTH)), rng.random((3, HEIGHT, WIDTH))
    for share in (0.2, 1.0):
        _, gradient = loss(a, b, share)
        direction = np.where(a > b, 1.0, -1.0) * rng.random(a.shape)  # no difference changes its sign
        step = 1e-3
        expected = (loss(a + step * direction, b, share)[0] - loss(a - step * direction, b, share)[0]) / (2 * step)
        np.testing.assert_allclose((gradient * direction).sum(), expected, rtol=5e-3)


def test_ssim_of_equal_and_psnr_of_shifted_images_equal_closed_forms() -> None:
    a = np.full((20, 30, 3), 0.5)
    assert metrics.ssim(a, a) == 1
    assert abs(metrics.psnr(a, a + 0.1) - 20) < 1e-9
