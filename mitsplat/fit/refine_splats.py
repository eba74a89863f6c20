"""Refinement of given splats towards pictures by gradient descent through the renderer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float32Array
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.fit.optimizer import QUALITY, GaussianModel
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.differentiation.backward import Eye
from mitsplat.renderer.layers import make_sensor
from mitsplat.renderer.rays.device_arrays import number, on_device, wrapped
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.runtime.recorded_kernels import recorded
from mitsplat.runtime.variant import ensure_variant


@dataclass(frozen=True, eq=False)
class Picture:
    """A target picture.

    Attributes:
        camera: Camera of the picture; the rays follow its lens distortion.
        rgb: Display-encoded colour times alpha, (H, W, 3).
        alpha: Share of each pixel that the subject covers, (H, W).
    """

    camera: Camera
    rgb: Float32Array
    alpha: Float32Array


_RATES = {"means": 0.02, "quats": 0.004, "scales": 0.01, "opacities": 0.05, "sh": 0.01}
"""Initial learning rates per step: of the means, as a share of the mean scale of the splats; of the quaternions'
components, the logarithms of the scales, the logits of the opacities, and the constant SH coefficients.
"""
_HIGHER_BANDS = 0.2
"""Rate of the higher SH bands, which few pictures determine, relative to that of the constant ones."""
_FINAL_RATE = 0.1
"""Factor on all rates at the end, to which they fall exponentially."""
_REPORT_STEPS = 10
"""Steps between reports; reading a loss waits for the device."""


def refine_splats(
    splats: Splats,
    pictures: Sequence[Picture],
    *,
    iterations: int,
    seed: int = 0,
    observe: Callable[[int, float], None] | None = None,
) -> Splats:
    """Refine splats with Adam on the mean squared error of display-encoded colours.

    Picture and rendering are composited over the same random grey background, so the error also measures alpha. The
    number of Gaussians does not change.

    Args:
        splats: Initial splats.
        pictures: Target pictures.
        iterations: Optimiser steps, each with one picture; all pictures are used in turn.
        seed: Seed of the picture order and of the backgrounds.
        observe: Called after every tenth step and the last step, with the step number and its PSNR [dB].

    Returns:
        The refined splats.

    Raises:
        ValueError: If there are no pictures, or no splats.
    """
    if not pictures or not len(splats):
        raise ValueError(f"refining needs pictures and splats (got {len(pictures)} and {len(splats)})")
    ensure_variant()
    model = GaussianModel(splats, float(np.mean(splats.scales)))
    eyes = [Eye(view_of(make_sensor(picture.camera))) for picture in pictures]
    targets = [
        ([wrapped(mi.Float, p.rgb[..., c].astype(np.float32)) for c in range(3)], wrapped(mi.Float, p.alpha))
        for p in pictures
    ]
    rng = np.random.default_rng(seed)
    order: list[int] = []
    for step in range(iterations):
        order = order or list(rng.permutation(len(pictures)))
        picture = order.pop()
        seen = model.render(eyes[picture], QUALITY)
        colour, alpha, loss = _gradients(seen.rgb, seen.alpha, *targets[picture], on_device(rng.random()))
        model.set_gradients(eyes[picture], QUALITY, [seen.gradient(colour, alpha)])
        decay = _FINAL_RATE ** (step / max(1, iterations - 1))
        rates = {name: _RATES[name] * decay for name in model.values}
        model.update(rates | {"sh": model.sh_rates(rates["sh"], rates["sh"] * _HIGHER_BANDS)})
        if observe is not None and (step % _REPORT_STEPS == 0 or step == iterations - 1):
            observe(step, psnr_of(float(loss.numpy()[0]) / 3))
    return model.splats()


@recorded
def _gradients(
    rgb: list[mi.Float], alpha: mi.Float, target: list[mi.Float], cover: mi.Float, grey: mi.Float
) -> tuple[list[mi.Float], mi.Float, mi.Float]:
    """Return the gradients of the loss with respect to colours and alpha, and the loss."""
    rgb, alpha = [mi.Float(channel) for channel in rgb], mi.Float(alpha)
    dr.enable_grad(rgb, alpha)
    behind, loss = number(grey, 0), mi.Float(0)
    for channel, wanted in zip(rgb, target, strict=True):
        loss += dr.mean(dr.square(channel - wanted + behind * (cover - alpha)))
    dr.backward(loss)
    return [dr.grad(channel) for channel in rgb], dr.grad(alpha), dr.detach(loss)
