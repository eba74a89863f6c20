"""Refinement of given splats towards pictures by gradient descent through the renderer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float32Array
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.fit.optimizer import GaussianModel
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.quality import Quality
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


@dataclass(frozen=True)
class RefineSettings:
    """Steps and learning rates; rates fall exponentially to ``final_rate`` times their start.

    Attributes:
        iterations: Optimiser steps, each with one picture; all pictures are used in turn.
        rate_means: Rate of the means per step, as a share of the mean scale of the splats.
        rate_quats: Rate of the quaternions' components.
        rate_scales: Rate of the logarithms of the scales.
        rate_opacities: Rate of the logits of the opacities.
        rate_sh: Rate of the constant SH coefficient.
        rest_rate: Share of ``rate_sh`` for higher bands, which few pictures determine.
        final_rate: Factor on all rates at the end.
        seed: Seed of the picture order and of the backgrounds.
    """

    iterations: int = 300
    rate_means: float = 0.02
    rate_quats: float = 0.004
    rate_scales: float = 0.01
    rate_opacities: float = 0.05
    rate_sh: float = 0.01
    rest_rate: float = 0.2
    final_rate: float = 0.1
    seed: int = 0


QUALITY = Quality(transmittance_min=1e-3)
_REPORT_STEPS = 10
"""Steps between reports; reading a loss waits for the device."""


def refine_splats(
    splats: Splats,
    pictures: Sequence[Picture],
    settings: RefineSettings = RefineSettings(),
    *,
    observe: Callable[[int, float], None] | None = None,
) -> Splats:
    """Refine splats with Adam on the mean squared error of display-encoded colours.

    Picture and rendering are composited over the same random grey background, so the error also measures alpha. The
    number of Gaussians does not change.

    Args:
        splats: Initial splats.
        pictures: Target pictures.
        settings: Steps and learning rates.
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
    rng = np.random.default_rng(settings.seed)
    order: list[int] = []
    for step in range(settings.iterations):
        order = order or list(rng.permutation(len(pictures)))
        picture = order.pop()
        seen = model.render(eyes[picture], QUALITY)
        colour, alpha, loss = _gradients(seen.rgb, seen.alpha, *targets[picture], on_device(rng.random()))
        model.set_gradients(eyes[picture], QUALITY, [seen.gradient(colour, alpha)])
        decay = settings.final_rate ** (step / max(1, settings.iterations - 1))
        rates = {name: getattr(settings, f"rate_{name}") * decay for name in model.values}
        model.update(rates | {"sh": model.sh_rates(rates["sh"], rates["sh"] * settings.rest_rate)})
        if observe is not None and (step % _REPORT_STEPS == 0 or step == settings.iterations - 1):
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
