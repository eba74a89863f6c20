"""The chart of speed against accuracy."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from ruamel.yaml import YAML
from typer.testing import CliRunner

from mitsplat.asset import Asset
from mitsplat.cli import app
from mitsplat.errors import InputError
from mitsplat.frames.accuracy import speed_accuracy
from mitsplat.frames.accuracy.accuracy_chart import curve_of, draw_chart
from mitsplat.frames.accuracy.speed_accuracy import Row, Step, fastest_preset, measure_steps, tolerance_steps
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.images.colour import encode_srgb
from mitsplat.quality import PRESETS
from tests.renderer.test_render import make_splats


@pytest.fixture(scope="module")
def splat_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("chart") / "cloud.ply"
    make_splats(400, 3, scales=(0.02, 0.1)).save(file)
    return file


def row(name: str, seconds: float, rmse: float) -> Row:
    psnr = -20 * math.log10(rmse) if rmse else math.inf
    return Row(
        name, seconds, rmse, psnr, largest=rmse, ssim=1.0, mask_iou=1.0, memory=0.5, estimate=0.0, objects=math.nan
    )


ROWS = [row("fast", 1.0, 0.01), row("balanced", 2.0, 0.001), row("exact", 9.0, 0.0), row("fast, no shadow", 0.5, 0.0)]


def metal_ball(folder: Path) -> Path:
    """Write a scene of a metal ball on a table under a lamp and a sky."""
    mesh = trimesh.creation.icosphere(3, 0.03)
    surfels = place_surfels(mesh, 1.0, 2000, np.random.default_rng(0))
    gold = encode_srgb(np.array([1.0, 0.782, 0.344]))
    splats = surfels.splats(np.tile((gold - 0.5) / SH_C0, (len(surfels), 1, 1))).with_material(
        metallic=1, roughness=0.3
    )
    Asset(name="ball", class_name="ball", splats=splats, mesh=mesh, pieces=(mesh,)).save(folder / "ball")
    box = {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}
    scene = {
        "name": "metal",
        "shapes": [{"name": "table", "box": box, "visible": True}],
        "objects": [{"asset": "ball"}],
        "region": {"min": [-0.05, -0.05, 0.0], "max": [0.05, 0.05, 0.1]},
        "settle": {"arrangement": "upright"},
        "camera": {"kind": "orbit", "target": [0, 0, 0.02], "radius": 0.2, "height": 0.15},
        "lights": [{"kind": "area", "position": [0.3, 0.2, 0.6], "size": [0.2, 0.2]}, {"kind": "environment"}],
        "output": {"width": 64, "height": 48, "layouts": 1, "views": 1},
    }
    YAML(typ="safe", pure=True).dump(scene, folder / "scene.yaml")
    return folder / "scene.yaml"


def test_objects_are_compared_with_their_path_traced_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Splats with materials show the reflections of the meshes; the same splats as captured colours do not."""
    monkeypatch.setattr(speed_accuracy, "_run_job", lambda job, _: job(0, lambda _: None))  # in this process
    fast = PRESETS["fast"]
    monkeypatch.setitem(PRESETS, "exact", fast)  # whose kernels are compiled anyway
    meshes = (Step(f"meshes, {paths} paths", fast, mesh_paths=paths) for paths in (4, 64))
    rows = measure_steps(
        metal_ball(tmp_path), [Step("fast", fast), Step("captured", fast, captured=True), *meshes], frames=1
    )
    splats, captured, few_paths, many_paths = (row.objects for row in rows)
    assert captured < 20 and splats > 28 and few_paths < many_paths == math.inf
    assert rows[0].mask_iou > 0.99 and math.isnan(rows[2].mask_iou)
    draw_chart([*ROWS, *rows[1:]], tmp_path / "chart.png", title="", tolerance=0.002)
    assert np.asarray(Image.open(tmp_path / "chart.png")).shape[1] > 1500  # both panels


@pytest.mark.parametrize(("tolerance", "name"), [(0.02, "fast"), (0.002, "balanced"), (0.0, "exact")])
def test_the_fastest_preset_within_a_tolerance_is_chosen(tolerance: float, name: str) -> None:
    assert fastest_preset(ROWS, tolerance).name == name


def test_negative_tolerance_is_refused() -> None:
    with pytest.raises(InputError, match="tolerance must be at least 0"):
        fastest_preset(ROWS, -1.0)


def test_coarser_presets_have_larger_measured_errors(splat_file: Path) -> None:
    coarse = Step("coarse", replace(PRESETS["fast"], alpha_min=0.2))
    steps = (coarse, Step("fast", PRESETS["fast"]), Step("exact", PRESETS["exact"]))
    rows = measure_steps(splat_file, steps, frames=2, overrides={"output.width": 64, "output.height": 48})
    assert [r.name for r in rows] == ["coarse", "fast", "exact"]
    assert rows[0].rmse > 2 * rows[1].rmse > 0 and rows[0].ssim < rows[1].ssim < 1
    assert (rows[2].rmse, rows[2].largest, rows[2].ssim, rows[2].mask_iou) == (0, 0, 1, 1)
    assert all(r.seconds > 0 and 0.05 < r.memory < 8 for r in rows)


def test_chart_command_writes_table_csv_and_picture(
    splat_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed_accuracy, "_run_job", lambda job, _: job(0, lambda _: None))  # in this process
    out = tmp_path / "chart.png"
    result = CliRunner().invoke(
        app,
        f"chart {splat_file} --size 48x32 -n 1 --tolerance 0 --order-tolerance 0 -o {out}".split(),
    )
    assert result.exit_code == 0, result.output
    assert "exact *" in result.output and "[dB]" in result.output and "[GiB]" in result.output
    with out.with_suffix(".csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert {"fast", "balanced", "exact"} < {line["name"] for line in lines}
    in_ray_order = next(line for line in lines if line["name"] == "balanced at 0")
    assert float(in_ray_order["estimate"]) == 0 < float(in_ray_order["rmse"])
    exact, balanced, fast = (next(li for li in lines if li["name"] == name) for name in ("exact", "balanced", "fast"))
    assert float(exact["rmse"]) == float(exact["estimate"]) == 0
    assert 0 <= float(balanced["estimate"]) <= PRESETS["balanced"].tolerance and fast["estimate"] == "nan"


def test_chart_shows_every_step(tmp_path: Path) -> None:
    draw_chart(ROWS, tmp_path / "a.png", title="", tolerance=0.002)
    draw_chart(ROWS[1:], tmp_path / "b.png", title="", tolerance=0.002)
    a, b = (np.asarray(Image.open(tmp_path / name)) for name in ("a.png", "b.png"))
    assert a.shape[0] > 300 and (a != 255).mean() > 0.01
    assert a.shape != b.shape or (a != b).any()


def test_the_curve_goes_from_the_largest_tolerance_to_the_smallest() -> None:
    rows = [
        *ROWS,
        row("balanced at 0", 4.0, 0.0),
        row("balanced at 0.03", 1.5, 0.004),
        row("balanced at 1e-05", 3.0, 0.0),
    ]
    assert curve_of(rows, 1e-4) == [(1.5, 0.004), (2.0, 0.001), (3.0, 1e-4), (4.0, 1e-4)]
    with pytest.raises(InputError, match="tolerance must be at least 0"):
        tolerance_steps([0.01, -1.0])
