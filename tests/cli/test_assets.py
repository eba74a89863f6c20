"""Command ``mitsplat bake``."""

from __future__ import annotations

import re
from dataclasses import make_dataclass
from pathlib import Path

import numpy as np
import pytest

from mitsplat.asset import Asset
from mitsplat.bake.bake import BakeSettings
from tests.cli.typed import run
from tests.conftest import box_asset
from tests.mesh_files.test_step import assembly


def quick_settings(verify_views: int) -> type:
    """Return settings of a bake without a fit, by default."""
    fields = [("fit_steps", int, 0), ("verify_views", int, verify_views)]
    return make_dataclass("QuickSettings", fields, bases=(BakeSettings,), frozen=True)


def test_bake_applies_every_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every option changes the written asset. test_documented_commands.py runs complete bakes in processes of their
    own.
    """
    monkeypatch.setattr("mitsplat.bake.bake.BakeSettings", quick_settings(1))
    box_asset("gear", (20.0, 30.0, 10.0)).mesh.export(tmp_path / "gear.glb")
    options = (
        "--class", "wheel", "--gaussians", 60, "--units", 0.001, "--up", "y",
        "--density", 7800, "--friction", 0.2, "--seed", 4, "--kind", "environment", "--name", "cog",
        "--colour", "steelblue", "--roughness", 0.3, "--metallic", 1, "--specular", 0.05, "--any-size",
    )  # fmt: skip
    assert run("bake", tmp_path / "gear.glb", "-o", tmp_path / "gear", *options) == 0
    asset = Asset.load(tmp_path / "gear")
    assert (asset.name, asset.class_name, asset.kind) == ("cog", "wheel", "environment")
    assert (asset.density, asset.friction, asset.splats.sh_degree) == (7800.0, 0.2, 0)
    assert 30 < len(asset.splats) < 120
    np.testing.assert_allclose(asset.mesh.extents, (0.02, 0.01, 0.03), atol=1e-6)
    np.testing.assert_allclose(asset.splats.materials.roughness, 0.3, atol=0.002)
    np.testing.assert_array_equal(asset.splats.materials.metallic, 1)
    red, _, blue = asset.splats.sh[:, 0].mean(axis=0)
    assert red < blue
    assert (tmp_path / "gear/report.html").is_file()
    assert re.search(r"Gaussians, \d+\.\d dB", capsys.readouterr().out)


def test_bake_splits_a_step_file_into_its_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("mitsplat.bake.bake.BakeSettings", quick_settings(0))
    step = assembly(tmp_path / "frame.step")
    assert run("bake", step, "-o", tmp_path / "parts", "--split", "--tolerance", 0.5, "--gaussians", 60) == 0
    output = capsys.readouterr().out
    assert "facets: within 0.5 mm" in output
    assert "part: block (1 of 3 parts)\npart: pin_no._1 (2 of 3 parts)\n" in output
    assert "0.001 m, z up (units stated by the file)" in output
    block, pin = (Asset.load(tmp_path / "parts" / name) for name in ("block", "pin_no._1"))
    assert (block.name, pin.class_name) == ("block", "pin_no._1")
    np.testing.assert_allclose(block.mesh.extents, (0.01, 0.02, 0.03), atol=1e-7)
    assert pin.mesh.extents[2] == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--split"], "--split applies to STEP files (got {mesh})"),
        (["--tolerance", "0.1"], "--tolerance applies to STEP files (got {mesh})"),
        (["--split", "--name", "a"], "--name applies to one asset, but --split names each by its part (got a)"),
        (["--units", "0"], "--units must be finite and > 0 (got 0.0)"),
        (["--units", "1e-6", "--any-size"], "{mesh}: a mesh must be 1e-05 to 100000 m across (got 3e-08 m)"),
        (["--units", "1e30", "--any-size"], "{mesh}: a mesh must be 1e-05 to 100000 m across (got 3e+28 m)"),
        (["--density", "nan"], "density must be a number > 0 in kg/m^3 (got nan)"),
        (["--seed", "-1"], "--seed must be 0 to 4294967295 (got -1)"),
        (["--seed", "4294967296"], "--seed must be 0 to 4294967295 (got 4294967296)"),
        (["--gaussians", "0"], "gaussians must be at least 1 (got 0)"),
    ],
)
def test_invalid_options_of_bake_are_refused_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    box_asset("gear").mesh.export(tmp_path / "gear.stl")
    assert run("bake", tmp_path / "gear.stl", "-o", tmp_path / "gear", *options) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"mitsplat: {sentence.format(mesh=tmp_path / 'gear.stl')}"
