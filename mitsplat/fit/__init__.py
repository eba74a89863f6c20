"""Fit of Gaussian splats to photographs.

Input: a :class:`~mitsplat.capture.capture.Capture`.
Output: splats, and their image quality on held-out photos.
The trainer starts from the points of the capture. A densification strategy (MCMC) adds Gaussians.
"""

from __future__ import annotations

from mitsplat.fit.fit_folder import FitResult
from mitsplat.fit.fit_settings import FitProgress, FitSettings
from mitsplat.fit.trainer import fit_capture

__all__ = ["FitProgress", "FitResult", "FitSettings", "fit_capture"]
