"""Fit splats to pictures by gradient descent through the renderer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.camera import Camera
from mitsplat.quality import Quality
from mitsplat.render import ensure_variant, make_sensor
from mitsplat.splats import Splats

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera saw.

    Attributes:
        camera: From where; its distortion is followed by the rays.
        rgb: Display-encoded colour times alpha, (H, W, 3).
        alpha: Share of the pixel that the subject covers, (H, W).
    """

    camera: Camera
    rgb: FloatArray
    alpha: FloatArray


@dataclass(frozen=True)
class FitSettings:
    """Steps and learning rates of the fit; rates fall exponentially to ``final_rate`` times their start.

    Attributes:
        iterations: Optimiser steps; each takes one picture, all pictures in turn.
        rate_means: Per step, as a share of the splats' own mean size.
        rate_quats: Of the quaternions' components.
        rate_scales: Of the logarithms of the scales.
        rate_opacities: Of the logits of the opacities.
        rate_sh: Of the constant SH coefficient; higher bands take ``rest_rate`` of it.
        rest_rate: Share of ``rate_sh`` for higher bands, which few pictures determine.
        final_rate: Factor on all rates at the end.
        seed: Decides the order of the pictures and the backgrounds.
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


def fit_splats(
    splats: Splats,
    pictures: Sequence[Picture],
    settings: FitSettings = FitSettings(),
    *,
    progress: Callable[[int, float], None] | None = None,
) -> Splats:
    """Splats that look more like the pictures, by Adam on the mean squared error of encoded colours.

    The error is taken over a random grey background, the same behind both, so that it also measures alpha. The number
    of Gaussians stays as it is.

    Args:
        splats: Where to start.
        pictures: What to come close to.
        settings: Steps and rates.
        progress: Told after every step its number and its PSNR [dB].

    Raises:
        ValueError: If there are no pictures, or no splats.
    """
    if not pictures or not len(splats):
        raise ValueError(f"a fit needs pictures and splats (got {len(pictures)} and {len(splats)})")
    ensure_variant()
    from mitsplat.plugins.backward import pack_cloud, render_differentiable
    from mitsplat.plugins.splat_proxy import view_of

    bands = splats.sh.shape[1]
    unit = float(np.mean(splats.scales))
    band_rate = np.broadcast_to(np.r_[1.0, np.full(bands - 1, settings.rest_rate)][None, :, None], splats.sh.shape)
    band_weight = mi.Float(band_rate.astype(np.float32).ravel())
    opacities = np.clip(splats.opacities.astype(np.float64), 1e-4, 1 - 1e-4)
    start = {
        "means": splats.means / unit,
        "quats": splats.quats,
        "scales": np.log(splats.scales),
        "opacities": np.log(opacities / (1 - opacities)),
        "sh": splats.sh / band_rate,
    }
    optimiser = mi.ad.Adam(lr=1.0, params={k: mi.Float(np.ravel(v).astype(np.float32)) for k, v in start.items()})
    rates = {name: getattr(settings, f"rate_{name}") for name in start}

    def activated() -> list[Any]:
        p = optimiser
        opacity = 1 / (1 + dr.exp(-p["opacities"]))
        return [p["means"] * unit, p["quats"], dr.exp(p["scales"]), opacity, p["sh"] * band_weight]

    views = [view_of(make_sensor(picture.camera)) for picture in pictures]
    targets = [
        ([mi.Float(np.ravel(p.rgb[..., c]).astype(np.float32)) for c in range(3)], mi.Float(np.ravel(p.alpha)))
        for p in pictures
    ]
    rng = np.random.default_rng(settings.seed)
    order: list[int] = []
    for step in range(settings.iterations):
        order = order or list(rng.permutation(len(pictures)))
        picture = order.pop()
        decay = settings.final_rate ** (step / max(1, settings.iterations - 1))
        optimiser.set_learning_rate({name: rate * decay for name, rate in rates.items()})
        rgb, alpha = render_differentiable(pack_cloud(*activated(), bands), views[picture], QUALITY)
        seen, cover = targets[picture]
        grey = dr.opaque(mi.Float, float(rng.random()))
        loss = mi.Float(0)
        for channel, target in zip(rgb, seen, strict=True):
            loss += dr.mean(dr.square(channel - target + grey * (cover - alpha)))
        dr.backward(loss)
        optimiser.step()
        if progress is not None:
            progress(step, float(-10 * np.log10(max(loss.numpy()[0] / 3, 1e-12))))
    means, quats, scales, opacity, sh = (np.array(dr.detach(value)) for value in activated())
    return Splats(
        means=means.reshape(-1, 3),
        quats=quats.reshape(-1, 4),
        scales=scales.reshape(-1, 3),
        opacities=opacity,
        sh=sh.reshape(splats.sh.shape),
    )
