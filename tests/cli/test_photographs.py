"""Commands that make assets from photographs: ``capture``, ``fit``, ``mesh`` and ``asset``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from mitsplat.capture.boards.targets import Board
from mitsplat.capture.capture import Capture
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.cli.console import stage_bar
from mitsplat.errors import InputError
from mitsplat.fit import depth_network as depth_model
from mitsplat.fit import depth_priors as depth_maps
from mitsplat.fit.depth_priors import DepthMaps
from mitsplat.fit.fit_settings import FitProgress, FitSettings
from mitsplat.reconstruct.asset_evaluation import Verdict
from mitsplat.reconstruct.pipeline import asset_pipeline as pipeline
from mitsplat.reconstruct.pipeline.asset_pipeline import AssetResult
from mitsplat.reconstruct.reconstruct import ReconstructSettings
from mitsplat.reconstruct.surface import SurfaceSettings
from tests.cli.typed import Calls, run
from tests.conftest import box_asset


def test_fit_passes_every_option_on(fit_capture: Calls, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    status = run(
        "fit", "photos", "-o", tmp_path, "--gaussians", 70, "--iterations", 80,
        "--budget", "1.5min", "--target-psnr", 27, "--max-size", 90, "--sh-degree", 2, "--seed", 4, "--overwrite",
    )  # fmt: skip
    assert status == 0
    assert fit_capture.args[:2] == (Path("photos"), tmp_path) and fit_capture.kwargs["overwrite"]
    assert fit_capture.args[2] == FitSettings(
        gaussians=70, iterations=80, budget=90.0, target_psnr=27, max_size=90, sh_degree=2, seed=4,
    )  # fmt: skip
    assert "(12 Gaussians; 1 held-out photos: 28.00 dB, SSIM 0.900)" in capsys.readouterr().out
    fit_capture.kwargs["progress"](FitProgress(40, 0.5, 24.5, 23.0, 60))


def test_fit_defaults_are_those_of_the_settings(fit_capture: Calls, tmp_path: Path) -> None:
    assert run("fit", "photos", "-o", tmp_path) == 0
    assert fit_capture.args[2] == FitSettings() and not fit_capture.kwargs["overwrite"]


def test_fit_takes_depth_maps_of_a_folder_or_of_a_network(
    fit_capture: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(Capture, "load", lambda folder: SimpleNamespace(training="photos"))
    fit_capture.result = replace(fit_capture.result, warnings=("depth maps that are not used: a.jpg (…)",))
    given, made = (Path("maps"), "photos", "metric"), ("photos", Path("a.onnx"), tmp_path / "depths", "metric")
    for module, name, options, args in (
        (depth_maps, "find_maps", ("--depths", "maps"), given),
        (depth_model, "model_maps", ("--depth-model", "a.onnx"), made),
    ):
        found = Calls(DepthMaps({}, "metric"))
        monkeypatch.setattr(module, name, found)
        assert run("fit", "photos", "-o", tmp_path, "--depth-kind", "metric", *options) == 0
        assert found.args == args and fit_capture.kwargs["depths"] is found.result
        assert "warning: depth maps that are not used: a.jpg" in capsys.readouterr().out
    for options, text in (
        (("--depths", "maps", "--depth-model", "a.onnx"), "both define the depth maps: give only one"),
        (("--depth-kind", "metric"), "--depth-kind metric needs depth maps: add --depths or --depth-model"),
    ):
        assert run("fit", "photos", "-o", tmp_path, *options) == 2
        assert text in capsys.readouterr().err


def test_fit_below_its_target_exits_with_4(
    fit_capture: Calls, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run("fit", "photos", "-o", tmp_path, "--target-psnr", 30) == 4
    out, err = capsys.readouterr()
    assert "held-out photos: 28.00 dB" in out and "target: 29.00 dB on 1 validation photos" in out
    assert "PSNR must reach 30.00 dB (got 29.00)" in err


@pytest.mark.parametrize("budget", ["10", "ten min", "1d"])
def test_fit_refuses_a_time_limit_without_a_unit(
    fit_capture: Calls, capsys: pytest.CaptureFixture[str], tmp_path: Path, budget: str
) -> None:
    assert run("fit", "photos", "-o", tmp_path, "--budget", budget) == 2
    assert "--budget must be a time such as 90s" in capsys.readouterr().err


def finished(folder: Path, **changes: Any) -> AssetResult:
    figures = Verdict(
        photos=9, rejected=1, psnr=27.0, psnr_object=26.0, splat_iou=0.97, mesh_iou=0.96, offset=0.001, spread=0.001,
        lost=0.0, scale_error=None, units="metre", gaussians=12, faces=99, watertight=True, solid=True,
    )  # fmt: skip
    return AssetResult(folder, replace(figures, **changes), kept=False)


def test_capture_passes_every_option_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = Calls(error=InputError("captured"))
    module = import_module("mitsplat.capture.pipeline.capture_pipeline")  # the package exports a function of this name
    monkeypatch.setattr(module, "capture_photos", calls)
    common = (
        "--frames", 40, "--max-size", 800, "--squares", "6x4", "--square", 0.02, "--tag", 0.05,
        "--scale-from", "a.jpg", "b.jpg", 0.5, "--poses", "model", "--metric", "--undistort",
    )  # fmt: skip
    told = {
        "frames": 40, "max_size": 800, "board": Board(6, 4, 0.02), "tag": 0.05,
        "scale_from": ("a.jpg", "b.jpg", 0.5), "poses": Path("model"), "metric": True, "undistorted": True,
    }  # fmt: skip
    for options, further in (
        (("--masks", "masks"), {"masks": Path("masks")}),
        (("--mask-model", "a.onnx"), {"mask_model": Path("a.onnx")}),
        (("--kind", "environment"), {"kind": "environment"}),
        (
            ("--pick", "a.jpg:1,2", "--pick", "b.jpg:3,4", "--pick-not", "a.jpg:5,6", "--box", -1, -2, 0, 1, 2, 3),
            {"picks": ("a.jpg:1,2", "b.jpg:3,4"), "picks_not": ("a.jpg:5,6",), "box": (-1, -2, 0, 1, 2, 3)},
        ),
    ):
        assert run("capture", "photos", "-o", tmp_path, *common, *options) == 2
        assert calls.args == (Path("photos"), tmp_path, CaptureSettings(**told, **further))


@pytest.mark.parametrize("command", ["capture", "asset"])
@pytest.mark.parametrize("count", [0, 40])
def test_a_number_of_video_frames_is_refused_for_photographs(
    command: str, count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    assert run(command, tmp_path / "photos", "-o", tmp_path / "out", "--frames", count) == 2
    message = f"mitsplat: --frames does not apply to photographs ({tmp_path / 'photos'}), which are all used"
    assert capsys.readouterr().err.splitlines()[-1] == message
    assert run(command, tmp_path / "photos", "-o", tmp_path / "out") == 2
    assert "must hold at least 3 photographs (got 0)" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["object", "environment"])
def test_mesh_passes_every_option_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    box_asset("nut").mesh.export(tmp_path / "cad.stl")
    (tmp_path / "matrix.txt").write_text("2 0 0 1\n0 2 0 0\n0 0 2 0\n")
    calls = Calls(finished(tmp_path / "nut"))
    monkeypatch.setattr(pipeline, "make_asset", calls)
    monkeypatch.setattr(Capture, "load", lambda folder: folder)
    status = run(
        "mesh", "capture", "fit", "-o", tmp_path / "nut", "--name", "m6", "--class", "nut", "--kind", kind,
        "--faces", 500, "--voxels", 64, "--size", 0.1, "--import", tmp_path / "cad.stl",
        "--normalisation", tmp_path / "matrix.txt", "--units", 0.001, "--metallic", 1, "--roughness", 0.3,
    )  # fmt: skip
    assert status == 0
    capture, fit_folder, out, job = calls.args
    assert (capture, fit_folder, out) == (Path("capture"), Path("fit"), tmp_path / "nut")
    assert (job.name, job.class_name, job.kind, job.settings.size) == ("m6", "nut", kind, 0.1)
    assert job.settings.surface == SurfaceSettings(voxels=64, faces=500)
    assert job.imported.metres_per_unit == 0.001
    assert job.material == {"metallic": 1.0, "roughness": 0.3}
    np.testing.assert_allclose(job.imported.capture_from_mesh @ [1, 0, 0, 1], [0, 0, 0, 1], atol=1e-12)
    assert "held-out PSNR 27.00 dB; IoU with held-out masks splats 0.970, mesh 0.960" in capsys.readouterr().out


def test_a_missed_threshold_has_status_4_and_one_sentence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pipeline, "make_asset", Calls(finished(tmp_path, psnr=12.0)))
    monkeypatch.setattr(Capture, "load", lambda folder: folder)
    assert run("mesh", "capture", "fit", "-o", tmp_path) == 4
    shown = capsys.readouterr()
    assert "held-out photos have a PSNR of only 12.0 dB (at least 24 is required): use even light" in shown.err
    assert f"report: {tmp_path / 'report.html'}" in shown.out
    assert run("mesh", "capture", "fit", "-o", tmp_path, "--units", 0.001) == 2


@pytest.mark.parametrize(("kind", "gaussians"), [("object", 30_000), ("environment", 60_000)])
def test_asset_passes_every_option_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: Literal["object", "environment"], gaussians: int
) -> None:
    calls = Calls(finished(tmp_path))
    monkeypatch.setattr(pipeline, "asset_from_photos", calls)
    status = run(
        "asset", "photos", "-o", tmp_path / "mug", "--class", "cup", "--kind", kind, "--size", 0.1,
        "--scale-from", "a.jpg", "b.jpg", 0.5, "--poses", "model", "--masks", "masks", "--budget", "1.5min",
        "--metallic", 1, "--roughness", 0.3,
    )  # fmt: skip
    assert status == 0
    photos, out, job = calls.args
    assert (photos, out, job.name, job.class_name) == (Path("photos"), tmp_path / "mug", "mug", "cup")
    assert (job.kind, job.settings) == (kind, ReconstructSettings(size=0.1))
    assert job.material == {"metallic": 1.0, "roughness": 0.3}
    assert job.light is None
    assert run("asset", "photos", "-o", tmp_path / "mug", "--roughness", 2) == 2
    assert calls.kwargs["capture"] == CaptureSettings(
        kind=kind, scale_from=("a.jpg", "b.jpg", 0.5), poses=Path("model"), masks=Path("masks")
    )
    assert calls.kwargs["fit"] == FitSettings(gaussians=gaussians, budget=90.0)


def test_asset_and_mesh_read_the_lights_of_the_photos(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls, lights = Calls(finished(tmp_path)), tmp_path / "lamps.yaml"
    monkeypatch.setattr(pipeline, "asset_from_photos", calls)
    monkeypatch.setattr(pipeline, "make_asset", calls)
    monkeypatch.setattr(Capture, "load", lambda folder: folder)
    lights.write_text("lights: [{kind: environment, radiance: 2}]")
    assert run("mesh", "capture", "fit", "-o", tmp_path / "mug", "--lights", lights) == 0
    assert [light.radiance for light in calls.args[3].light.lights] == [2]
    assert run("asset", "photos", "-o", tmp_path / "mug", "--lights", lights) == 0
    assert [light.radiance for light in calls.args[2].light.lights] == [2]
    assert run("asset", "photos", "-o", tmp_path / "mug", "--lights", lights, "--metallic", 1) == 2
    assert "lights and a given material both define the materials: omit one of the two" in capsys.readouterr().err


@pytest.fixture
def log_of(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Return a function that reports steps at given times [s] and returns the log, which replaces the bar in a file."""

    def log(times: Sequence[float], *steps: tuple[int, int, str]) -> list[str]:
        clock = iter(times)
        monkeypatch.setattr("mitsplat.cli.console.time.monotonic", lambda: next(clock))
        with stage_bar() as progress:
            for step in steps:
                progress(*step)
        return capsys.readouterr().err.splitlines()

    return log


def test_a_log_has_stages_and_the_remaining_time(log_of: Callable[..., list[str]]) -> None:
    matching = [(done, 10, "matching") for done in (0, 1, 5)]
    told = log_of([0.0, 5.0, 70.0, 80.0, 90.0], *matching, (1, 4, "fitting: 20.0 dB"), (2, 4, "fitting: 21.0 dB"))
    assert told == ["  0 %: matching", " 50 %: matching, 70 s left", " 25 %: fitting: 20.0 dB"]


def test_a_log_states_no_remaining_time_at_the_start_of_a_stage(log_of: Callable[..., list[str]]) -> None:
    """The first step of segmentation takes a minute for all photos, and the other steps a second each."""
    told = log_of([0.0, 62.0, 63.0, 124.0], *[(done, 30, "cutting out") for done in (1, 2, 3, 25)])
    assert told == ["  3 %: cutting out", "  6 %: cutting out", " 83 %: cutting out, 26 s left"]
