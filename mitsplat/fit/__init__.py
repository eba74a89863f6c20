"""Gaussians fitted to photographs.

In: a :class:`~mitsplat.capture.capture.Capture`. Out: splats, and how well they show photos that took no part. The
trainer starts from the capture's points, and a strategy (MCMC or classic) adds Gaussians where they are missing.
"""

from __future__ import annotations

from mitsplat.fit.fit_folder import FitResult
from mitsplat.fit.trainer import FitProgress, FitSettings, fit_capture

__all__ = ["FitProgress", "FitResult", "FitSettings", "fit_capture"]
