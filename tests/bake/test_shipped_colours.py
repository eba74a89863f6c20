"""Colours of the shipped parts are those that the present baker samples at their Gaussians."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from mitsplat.asset import Asset
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.runtime.variant import ensure_variant
from scenes.build.recolour import ASSETS, recolour

LEVEL = 1 / (0.15 / SH_C0 * 255)
"""Step of a display-encoded colour in an SPZ file."""


@pytest.mark.parametrize("name", ["relay_box", "proximity_sensor"])
def test_shipped_parts_have_colours_of_the_present_baker(name: str, tmp_path: Path) -> None:
    """Fine print shows its mean radiance, and only colours change, so that labels stay the same.

    Means of display-encoded values would make the print of the relay up to 0.2 darker.
    """
    ensure_variant()
    shutil.copytree(ASSETS / name, tmp_path / name)
    recolour(name, tmp_path / name)
    shipped, anew = (Asset.load(folder / name).splats for folder in (ASSETS, tmp_path))
    for field in ("means", "quats", "scales", "opacities"):
        assert np.array_equal(getattr(shipped, field), getattr(anew, field)), field
    difference = SH_C0 * np.abs(anew.sh[:, 0] - shipped.sh[:, 0])
    # A processor that rounds otherwise may sample another triangle at an edge.
    assert np.percentile(difference, 99) < 1.5 * LEVEL
    assert difference.mean() < 0.1 * LEVEL
