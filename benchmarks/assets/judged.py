"""Comparison of reconstructed assets with thresholds and with the true cameras."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from pathlib import Path

import numpy as np

from benchmarks.record import figure
from mitsplat.arrays import Float64Array
from mitsplat.capture.alignment.target_evidence import fit_similarity
from mitsplat.capture.capture import Capture
from mitsplat.geometry.camera import Camera
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE


def on_truth(asset: Path, truth: Mapping[str, Camera]) -> tuple[Capture, Float64Array, Float64Array]:
    """Align an asset's capture with the truth.

    Returns the capture in the asset's frame, the similarity transform (4, 4) of its cameras to the true ones, and the
    residuals.

    Args:
        asset: Folder written by ``mitsplat asset``.
        truth: True cameras by the names of their photos.
    """
    verdict = json.loads((asset / VERDICT_FILE).read_text())
    moved = Capture.load(asset / "capture").transformed(verdict["asset_from_capture"])
    found = np.array([photo.camera.centre for photo in moved.photos])
    matrix, residuals = fit_similarity(found, np.array([truth[photo.name].centre for photo in moved.photos]))
    return moved, matrix, residuals


def tell_wanted(found: Mapping[str, float], wanted: Mapping[str, float], least: Container[str]) -> int:
    """Print and record figures with their thresholds, minima in ``least``; return the number missed or absent."""
    missed = 0
    for name, limit in wanted.items():
        value = found.get(name, float("nan"))
        met = value >= limit if name in least else value <= limit
        missed += not met
        figure(value, "", name)
        figure(limit, "", "wanted", name)
        print(f"{name:45} {value:8.3f}  {'>=' if name in least else '<='} {limit:g}{'' if met else '  missed'}")
    return missed
