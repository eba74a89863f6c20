"""Settings and progress of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mitsplat.arguments import check_fields, check_least
from mitsplat.errors import InputError


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit. Learning rates are those of 3DGS; regularisation is that of its MCMC densification.

    Attributes:
        gaussians: Largest number of Gaussians; their number grows to this by the middle of the fit.
        iterations: Optimiser steps, each with one photo; all photos are used in turn.
        budget: Time limit [s] of the schedule, which then skips iterations if necessary. The result then depends on the
            machine.
        target_psnr: Mean PSNR [dB] at which the fit ends early. It is measured on one in eight of the training photos,
            which are then not fitted. Held-out photos never affect a decision.
        max_size: Longest edge of the pictures [px]; photos are reduced, never enlarged.
        crop: True to fit only the area around the object in each photo, with ``max_size`` for this area; only if masks
            supervise alpha. Held-out photos are compared as a whole.
        sh_degree: Degree of the spherical harmonics, 0 to 3; it increases by one every fifth of the fit.
        masks: ``alpha``: only masked pixels are fitted, and masks supervise alpha; ``off``: masks are not read.
        background: Background behind splats and mask: a random colour in every step, or black.
        ssim_share: Weight of D-SSIM relative to L1.
        alpha_weight: Weight of the difference between alpha and mask.
        depth_weight: Weight of the difference between inverse depths of the splats and of the visible points or the
            depth map, relative to the inverse of the fit's length unit, in every fourth step; 0 disables depth. Without
            depth, Gaussians inside and behind an object explain its photos as well as those on its surface. The weight
            of maps falls exponentially to a hundredth, as published, because maps are smooth and may be bent.
        opacity_weight: Weight of the mean opacity. The MCMC authors use 0.01 in fits ten times as long; in short fits
            it makes surfaces transparent.
        scale_weight: Weight of the mean scale in units of the cameras' extent, as published for MCMC.
        coarse: Share of the fit that uses pictures of half the size.
        refine_every: Steps between removals or relocations of dead Gaussians and additions of new ones.
        rate_means: Initial learning rate of the means in units of the cameras' extent; falls exponentially to a
            hundredth.
        rate_quats: Learning rate of the quaternions' components.
        rate_scales: Learning rate of the logarithms of the scales.
        rate_opacities: Learning rate of the logits of the opacities.
        rate_sh: Learning rate of the constant SH coefficients; the others have a twentieth.
        seed: Seed of all random numbers.
    """

    gaussians: int = 30_000
    iterations: int = 3000
    budget: float | None = None
    target_psnr: float | None = None
    max_size: int = 800
    crop: bool = True
    sh_degree: int = 3
    masks: Literal["alpha", "off"] = "alpha"
    background: Literal["random", "black"] = "random"
    ssim_share: float = 0.2
    alpha_weight: float = 0.1
    depth_weight: float = 0.5
    opacity_weight: float = 0.0
    scale_weight: float = 0.01
    coarse: float = 0.25
    refine_every: int = 100
    rate_means: float = 1.6e-4
    rate_quats: float = 1e-3
    rate_scales: float = 5e-3
    rate_opacities: float = 5e-2
    rate_sh: float = 2.5e-3
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        check_least(self, gaussians=2, iterations=1, max_size=64, refine_every=1, seed=0)
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree must be 0, 1, 2 or 3 (got {self.sh_degree})")
        if self.target_psnr is not None and not np.isfinite(self.target_psnr):
            raise InputError(f"target_psnr must be finite (got {self.target_psnr})")
        if self.budget is not None and not self.budget > 0:
            raise InputError(f"budget must be > 0 s (got {self.budget})")
        if not 0 <= self.depth_weight < np.inf:
            raise InputError(f"depth_weight must be a number of at least 0 (got {self.depth_weight})")
        for name in ("ssim_share", "coarse"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} must be in [0, 1] (got {getattr(self, name)})")


@dataclass(frozen=True)
class FitProgress:
    """Progress of a fit.

    Attributes:
        step: Number of finished steps.
        fraction: Finished share of the schedule.
        psnr: PSNR of the photos of the last steps [dB].
        validation: Mean PSNR of the validation photos at their last evaluation [dB], or None.
        gaussians: Number of Gaussians.
    """

    step: int
    fraction: float
    psnr: float
    validation: float | None
    gaussians: int
