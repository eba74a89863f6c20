"""Warnings of masses that indicate a wrong unit of length."""

from __future__ import annotations

import pytest
import trimesh

from mitsplat.asset import Asset
from mitsplat.bake.size_checks import describe_size, mass_warnings
from mitsplat.gaussians.splat_cloud import Splats


def block(metres_per_unit: float, density: float = 1000.0, kind: str = "object") -> Asset:
    """Return a part of 60 x 100 x 20 units."""
    mesh = trimesh.creation.box((60, 100, 20)).apply_scale(metres_per_unit)
    splats = Splats([[0, 0, 0]], [[0, 0, 0, 1]], [[0.1, 0.1, 0.1]], [0.5], [[[0, 0, 0]]])
    return Asset(name="a", class_name="a", splats=splats, mesh=mesh, pieces=(mesh,), kind=kind, density=density)


@pytest.mark.parametrize(
    ("metres_per_unit", "density", "kilograms"),
    [(0.001, 1000, None), (0.01, 1000, 120), (0.01, 400, None), (0.0254, 8000, 15700), (0.001, 22000, None)],
)
def test_masses_of_wrong_units_are_reported(metres_per_unit: float, density: float, kilograms: float | None) -> None:
    found = mass_warnings(block(metres_per_unit, density), metres_per_unit)
    assert len(found) == (kilograms is not None)
    if kilograms is not None:
        size = f"{100 * metres_per_unit:.3g} m long and has {kilograms:.3g} kg"
        assert size in found[0] and f"{metres_per_unit:g} metres per unit" in found[0] and "--units 0.001" in found[0]


def test_masses_of_surroundings_are_not_judged() -> None:
    assert mass_warnings(block(0.1, kind="environment"), 0.1) == []


def test_sizes_are_shown_in_millimetres() -> None:
    assert describe_size(block(0.01).mesh) == "600 x 1000 x 200 mm"
