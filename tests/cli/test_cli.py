"""The command line: arguments to calls, one sentence and status 2 for bad input."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import trimesh
import typer
import typer.core
import typer.main
from PIL import Image, ImageSequence
from ruamel.yaml import YAML

from mitsplat import device as devices
from mitsplat import surroundings
from mitsplat.asset import Asset
from mitsplat.bake.bake import BakeSettings
from mitsplat.capture.capture import Capture
from mitsplat.capture.pipeline import CaptureSettings
from mitsplat.cli import app, main
from mitsplat.dataset import remake
from mitsplat.dataset import write as dataset
from mitsplat.dataset.write import DatasetSummary
from mitsplat.device import CPU, Device
from mitsplat.errors import InputError, MissingResourceError, PartialResultError
from mitsplat.fit import depth_network as depth_model
from mitsplat.fit import depth_priors as depth_maps
from mitsplat.fit import trainer as fit
from mitsplat.fit.depth_priors import DepthMaps
from mitsplat.fit.folder import FitResult
from mitsplat.fit.trainer import FitProgress, FitSettings
from mitsplat.fit.training_view import HeldOut
from mitsplat.frames import frame
from mitsplat.frames import mitsuba_xml as xml_scene
from mitsplat.frames import speed_accuracy as chart
from mitsplat.physics import settle
from mitsplat.reconstruct import pipeline
from mitsplat.reconstruct.evaluation import Verdict
from mitsplat.reconstruct.pipeline import AssetResult
from mitsplat.reconstruct.surface import SurfaceSettings
from mitsplat.scene.layout import Layout
from mitsplat.scene.scene import Scene
from tests.conftest import WriteScene, box_asset


def run(*args: object) -> int:
    with pytest.raises(SystemExit) as exited:
        main([str(arg) for arg in args])
    return int(exited.value.code or 0)


class Calls:
    """Stands in for a function: keeps what it was called with."""

    def __init__(self, result: Any = None, error: BaseException | None = None) -> None:
        self.result, self.error = result, error
        self.args: tuple[Any, ...] = ()
        self.kwargs: dict[str, Any] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.args, self.kwargs = args, kwargs
        if self.error is not None:
            raise self.error
        return self.result


@pytest.fixture
def scene_path(scene_data: dict[str, Any], write_scene: WriteScene) -> Path:
    return write_scene(scene_data)


@pytest.fixture
def write_dataset(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Calls:
    summary = DatasetSummary(
        path=tmp_path / "out",
        frames=3,
        rendered=3,
        images={"train": 2, "val": 1},
        instances={"nut": 4, "bolt": 5},
        dropped={"small": 2, "hidden": 0},
        marked={"occluded": 1},
        contact_sheet=tmp_path / "out/contact_sheet.jpg",
    )
    calls = Calls(summary)
    monkeypatch.setattr(dataset, "write_dataset", calls)
    return calls


def test_render_passes_every_option_on(
    scene_path: Path, write_dataset: Calls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = run(
        "render", scene_path, "-o", tmp_path / "out", "-n", 3, "--size", "32x24", "--seed", 9, "--quality", "fast",
        "--workers", 2, "--format", "yolo,coco", "--overwrite",
    )  # fmt: skip
    assert status == 0
    scene, out = write_dataset.args
    assert isinstance(scene, Scene)
    assert out == tmp_path / "out"
    assert (scene.spec.output.width, scene.spec.output.height) == (32, 24)
    assert scene.spec.output.formats == ("yolo", "coco")
    assert (scene.spec.seed, scene.spec.quality) == (9, "fast")
    write_dataset.kwargs.pop("progress")
    assert write_dataset.kwargs == {
        "frames": 3, "shard": None, "workers": 2, "cluster": None, "overwrite": True, "device": CPU,
        "any_device": False,
    }  # fmt: skip
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"dataset: {tmp_path / 'out'} (2 train, 1 val; 9 labelled instances)"
    assert lines[1] == "not labelled: 2 small; marked: 1 occluded"
    assert lines[-1] == f"contact sheet: {tmp_path / 'out/contact_sheet.jpg'}"


@pytest.mark.parametrize(
    ("made", "status", "told"),
    [
        ({"compared": 2}, 0, "the same bytes as in"),
        ({}, 0, "has no frame 3"),
        ({"compared": 2, "differing": ("a.png",), "cause": "seed was 0 and is 1"}, 1, "a.png (seed was 0 and is 1)"),
    ],
)
def test_render_makes_one_frame_again(
    scene_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    made: dict[str, Any],
    status: int,
    told: str,
) -> None:
    calls = Calls(remake.RemadeFrame(tmp_path, {"files": {}}, **made))
    monkeypatch.setattr(remake, "remake_frame", calls)
    assert run("render", scene_path, "-o", tmp_path / "out", "--only", 3, "--size", "32x24") == status
    scene, index, out = calls.args
    assert (scene.spec.output.width, index, out) == (32, 3, tmp_path / "out-000003")
    assert calls.kwargs["dataset"] == tmp_path / "out"
    assert told in capsys.readouterr().out
    assert run("render", scene_path, "--only", 3, "-n", 2) == 2


def test_render_leaves_to_the_file_what_no_option_says(scene_path: Path, write_dataset: Calls) -> None:
    assert run("render", scene_path) == 0
    scene, out = write_dataset.args
    assert out == Path("out/scene")
    assert (scene.spec.output.width, scene.spec.seed, scene.spec.quality) == (64, 7, "balanced")
    write_dataset.kwargs.pop("progress")
    assert write_dataset.kwargs == {
        "frames": None, "shard": None, "workers": None, "cluster": None, "overwrite": False, "device": CPU,
        "any_device": False,
    }  # fmt: skip


@pytest.mark.parametrize("command", [("chart",), ("render", "--tolerance", "0.02")])
def test_presets_are_measured_on_a_scene_with_files_outside_only_if_allowed(
    command: tuple[str, ...],
    scene_data: dict[str, Any],
    write_scene: WriteScene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def load(path: Path, step: chart.Step, frames: int, overrides: Any, allow_outside: bool, _device: Device) -> None:
        chart._scene_shooter(path, step.quality or chart.PRESETS["fast"], frames, overrides, allow_outside)
        raise InputError("loaded")

    write_scene(scene_data)
    (tmp_path / "inner").mkdir()
    inner = tmp_path / "inner" / "scene.yaml"
    asset = (tmp_path / scene_data["objects"][0]["asset"]).resolve()
    YAML(typ="safe", pure=True).dump(scene_data | {"objects": [{"asset": str(asset)}]}, inner)
    monkeypatch.setattr(chart, "_run_alone", load)
    out = "-o", tmp_path / "chart.png"
    assert run(command[0], inner, *command[1:], *out) == 2
    assert "must be inside the scene's folder" in capsys.readouterr().err
    assert run(command[0], inner, *command[1:], *out, "--allow-outside") == 2
    assert "loaded" in capsys.readouterr().err


def test_render_chooses_the_preset_within_a_tolerance(
    scene_path: Path, write_dataset: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = Calls(chart.Row("fast", 0.5, 0.01, 40.0, 0.1, 0.9, 0.9, 1.0, 0.0))
    monkeypatch.setattr(chart, "choose_preset", chosen)
    assert run("render", scene_path, "--tolerance", "0.02", "--seed", 3) == 0
    assert chosen.args == (scene_path, 0.02)
    assert chosen.kwargs["overrides"] == {"seed": 3}
    scene, _ = write_dataset.args
    assert (scene.spec.quality, scene.spec.seed) == ("fast", 3)
    assert "preset: fast (RMSE 0.01, 0.50 s an image)" in capsys.readouterr().out


def test_progress_bar_tells_images_and_rate(
    scene_path: Path, write_dataset: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write(*args: Any, progress: Any, **kwargs: Any) -> DatasetSummary:
        for done in range(5, 13):
            progress(done, 12, "rendering")
        return DatasetSummary(**vars(write_dataset.result))

    monkeypatch.setattr(dataset, "write_dataset", write)
    assert run("render", scene_path) == 0
    bar = capsys.readouterr().err
    assert "12/12" in bar
    assert "images/s" in bar


def test_render_xml(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "one.png"
    calls = Calls(picture)
    monkeypatch.setattr(xml_scene, "render_apart", calls)
    assert run("render", "one.xml", "-o", tmp_path) == 0
    assert calls.args == (Path("one.xml"), tmp_path)
    assert str(picture) in capsys.readouterr().out
    assert run("render", "one.xml", "--seed", 3) == 2
    assert "a Mitsuba scene says size, seed and quality itself" in capsys.readouterr().err


class TestDevice:
    """What commands do with ``--device``, on a machine with or without a GPU."""

    @pytest.fixture
    def lacking(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(devices, "visible_gpus", lambda: devices.Lack("there is none", "buy one"))

    @pytest.mark.usefixtures("lacking")
    def test_auto_says_in_one_line_which_and_why(
        self, scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert run("render", scene_path, "--device", "auto", "--any-device") == 0
        assert "device: cpu, as there is none\n" in capsys.readouterr().err
        assert (write_dataset.kwargs["device"].kind, write_dataset.kwargs["any_device"]) == ("cpu", True)
        assert run("render", scene_path, "--device", "auto", "--json") == 0
        assert all(json.loads(line) for line in capsys.readouterr().err.splitlines())

    @pytest.mark.usefixtures("lacking")
    @pytest.mark.parametrize("name", ["cuda", "cuda:1", "tpu"])
    def test_one_that_is_not_here(
        self, scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
    ) -> None:
        """Every command that renders refuses it in one sentence, before anything is written."""
        ball = tmp_path / "ball.ply"
        trimesh.creation.icosphere().export(ball)
        words = "device must be cpu, cuda" if name == "tpu" else f"{name} cannot be used, as there is none: buy one, or"
        commands: list[list[object]] = [
            ["render", scene_path, "-o", tmp_path / "out"],
            ["render", tmp_path / "one.xml", "-o", tmp_path / "out"],
            ["chart", scene_path, "-o", tmp_path / "out.png"],
            ["preview", scene_path, "-o", tmp_path / "out.png"],
            ["bake", ball, "-o", tmp_path / "out"],
            ["asset", tmp_path, "-o", tmp_path / "out"],
            ["mesh", tmp_path, tmp_path, "-o", tmp_path / "out"],
        ]
        for command in commands:
            assert run(*command, "--device", name) == (2 if name == "tpu" else 3), command
            assert words in capsys.readouterr().err, command
        assert not list(tmp_path.glob("out*"))

    def test_commands_take_it_before_they_render(
        self, scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fit_capture: Calls
    ) -> None:
        taken: list[str] = []
        monkeypatch.setattr(devices, "choose_variant", taken.append)
        monkeypatch.setattr(devices, "visible_gpus", lambda: (devices.Gpu("One", 2**40, 0, "", ""),))
        monkeypatch.setattr(frame, "render_frame", Calls(error=InputError("rendered")))
        assert run("preview", scene_path, "-o", tmp_path / "a.png", "--device", "cuda") == 2
        assert taken == ["cuda_ad_rgb"]
        assert run("fit", "capture", "-o", tmp_path / "fit", "--device", "auto") == 0
        assert run("fit", "capture", "-o", tmp_path / "fit") == 0
        assert taken == ["cuda_ad_rgb", "cuda_ad_rgb", "llvm_ad_rgb"]

    def test_another_gpu_is_taken_by_beginning_again(
        self, scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """By the command line itself only: whoever calls it is told what to set."""
        gpus = tuple(devices.Gpu("One", 2**40, number, str(number), f"GPU-{number}") for number in range(2))
        monkeypatch.setattr(devices, "visible_gpus", lambda: gpus)
        monkeypatch.delenv(devices.NUMBER, raising=False)
        command = ["preview", str(scene_path), "-o", str(tmp_path / "a.png"), "--device", "cuda:1"]
        assert run(*command) == 2
        assert "set CUDA_VISIBLE_DEVICES=GPU-1 before" in capsys.readouterr().err
        begun = Calls(error=SystemExit(0))
        monkeypatch.setattr("mitsplat.cli.os.execve", begun)
        monkeypatch.setattr("sys.argv", ["mitsplat", *command])
        monkeypatch.setattr("sys.orig_argv", ["python", "/bin/mitsplat", *command])
        with pytest.raises(SystemExit):
            main()
        assert begun.args[1][1:] == ["/bin/mitsplat", *command]
        assert {"CUDA_VISIBLE_DEVICES": "GPU-1", "MITSPLAT_GPU": "1"}.items() <= begun.args[2].items()


def test_preview_writes_a_picture(scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    image = np.full((4, 6, 3), (10, 20, 30), dtype=np.uint8)
    calls = Calls(SimpleNamespace(image=image))
    monkeypatch.setattr(frame, "render_frame", calls)
    options = ("--frame", 5, "-o", tmp_path / "a.png", "--size", "6x4", "--no-layers")
    assert run("preview", scene_path, *options) == 0
    scene, index = calls.args
    assert (scene.spec.output.width, index) == (6, 5)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), image)


@pytest.mark.parametrize("name", ["a.gif", "no/such/folder/a.png"])
def test_preview_refuses_a_bad_output_before_rendering(
    scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    monkeypatch.setattr(frame, "render_frame", Calls(error=AssertionError("rendered")))
    assert run("preview", scene_path, "-o", tmp_path / name) == 2


def test_export(scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = Calls()
    monkeypatch.setattr(xml_scene, "export_xml", calls)
    assert run("export", scene_path, "--frame", 2, "-o", tmp_path / "a.xml") == 0
    assert calls.args[1:] == (2, tmp_path / "a.xml")


@pytest.fixture
def fit_capture(monkeypatch: pytest.MonkeyPatch) -> Calls:
    seen = HeldOut(name="a.jpg", psnr=28.0, ssim=0.9, psnr_object=25.0, psnr_corrected=26.0)
    calls = Calls(
        FitResult(box_asset("nut").splats, 70, 3.5, (seen,), "inputs", validation=(replace(seen, psnr=29.0),))
    )
    monkeypatch.setattr(fit, "fit_capture", calls)
    monkeypatch.setattr(Capture, "load", lambda folder: folder)
    return calls


def test_fit_passes_every_option_on(fit_capture: Calls, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    status = run(
        "fit", "photos", "-o", tmp_path, "--gaussians", 70, "--densification", "classic", "--iterations", 80,
        "--budget", "1.5min", "--target-psnr", 27, "--edge", 90, "--sh-degree", 2, "--masks", "ignore",
        "--background", "black", "--depth", 0.7, "--exposure", "--seed", 4, "--overwrite",
    )  # fmt: skip
    assert status == 0
    assert fit_capture.args[:2] == (Path("photos"), tmp_path) and fit_capture.kwargs["overwrite"]
    assert fit_capture.args[2] == FitSettings(
        gaussians=70, densification="classic", iterations=80, budget=90.0, target_psnr=27, size=90, sh_degree=2,
        masks="ignore", background="black", depth_weight=0.7, exposure=True, seed=4,
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
    fit_capture.result = replace(fit_capture.result, warnings=("depth maps that are left out: a.jpg (…)",))
    given, made = (Path("maps"), "photos", "metric"), ("photos", Path("a.onnx"), tmp_path / "depths", "metric")
    for module, name, options, args in (
        (depth_maps, "find_maps", ("--depths", "maps"), given),
        (depth_model, "model_maps", ("--depth-model", "a.onnx"), made),
    ):
        found = Calls(DepthMaps({}, "metric"))
        monkeypatch.setattr(module, name, found)
        assert run("fit", "photos", "-o", tmp_path, "--depth-kind", "metric", *options) == 0
        assert found.args == args and fit_capture.kwargs["depths"] is found.result
        assert "warning: depth maps that are left out: a.jpg" in capsys.readouterr().out
    for options, text in (
        (("--depths", "maps", "--depth-model", "a.onnx"), "give --depths or --depth-model"),
        (("--depth-kind", "metric"), "--depth-kind metric is of depth maps: give --depths or --depth-model"),
        (("--depths", "maps", "--depth", 0), "depth maps are of no use with --depth 0"),
    ):
        assert run("fit", "photos", "-o", tmp_path, *options) == 2
        assert text in capsys.readouterr().err


def test_fit_below_its_target_exits_with_4(
    fit_capture: Calls, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run("fit", "photos", "-o", tmp_path, "--target-psnr", 30) == 4
    out, err = capsys.readouterr()
    assert "held-out photos: 28.00 dB" in out and "target: 29.00 dB on 1 photos set aside for it" in out
    assert "PSNR must reach 30.00 dB (got 29.00)" in err


@pytest.mark.parametrize("budget", ["10", "ten min", "1d"])
def test_fit_wants_a_budget_with_a_unit(
    fit_capture: Calls, capsys: pytest.CaptureFixture[str], tmp_path: Path, budget: str
) -> None:
    assert run("fit", "photos", "-o", tmp_path, "--budget", budget) == 2
    assert "--budget must be a time such as 90s" in capsys.readouterr().err


def test_bake_takes_every_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What each does is read from the asset; processes of their own bake in full in test_shell.py."""
    few = partial(BakeSettings, directions=4, samples=2, fit_views=2, fit_steps=2, verify_views=1)
    monkeypatch.setattr("mitsplat.bake.bake.BakeSettings", few)
    box_asset("gear", (20.0, 30.0, 10.0)).mesh.export(tmp_path / "gear.glb")
    options = (
        "--class", "wheel", "--light", "studio", "--gaussians", 60, "--sh-degree", 1, "--units", 0.001, "--up", "y",
        "--density", 7800, "--friction", 0.2, "--seed", 4, "--kind", "environment", "--name", "cog",
        "--colour", "steelblue", "--roughness", 0.3, "--metallic", 1, "--specular", 0.05, "--any-size",
    )  # fmt: skip
    assert run("bake", tmp_path / "gear.glb", "-o", tmp_path / "gear", *options) == 0
    asset = Asset.load(tmp_path / "gear")
    assert (asset.name, asset.class_name, asset.kind) == ("cog", "wheel", "environment")
    assert (asset.density, asset.friction, asset.splats.sh_degree) == (7800.0, 0.2, 1)
    assert 30 < len(asset.splats) < 120
    np.testing.assert_allclose(asset.mesh.extents, (0.02, 0.01, 0.03), atol=1e-6)
    assert asset.roughness == pytest.approx(0.3)
    red, _, blue = asset.splats.sh[:, 0].mean(axis=0)
    assert red < blue
    assert (tmp_path / "gear/report.html").is_file()
    assert re.search(r"Gaussians, \d+\.\d dB", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--units", "0"], "--units must be finite and > 0 (got 0.0)"),
        (["--density", "nan"], "density must be a number > 0 in kg/m^3 (got nan)"),
        (["--seed", "-1"], "--seed must be >= 0 (got -1)"),
        (["--gaussians", "0"], "gaussians must be at least 1 (got 0)"),
    ],
)
def test_bad_option_of_bake_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    box_asset("gear").mesh.export(tmp_path / "gear.stl")
    assert run("bake", tmp_path / "gear.stl", "-o", tmp_path / "gear", *options) == 2
    assert capsys.readouterr().err == f"mitsplat: {sentence}\n"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "bake plant.splat -o a",
            "plant.splat: must be a mesh (.glb, .obj, .stl, .ply) (got splats, which an asset.yaml",
        ),
        (
            "bake nut.step -o a",
            "nut.step: must be a mesh (.glb, .obj, .stl, .ply) (got solids of a CAD program",
        ),
        ("bake folder -o a", "folder: must be a mesh (.glb, .obj, .stl, .ply) (got a folder)"),
        ("bake part.stl -o part.stl", "--out must be a folder (got the file part.stl)"),
        ("check plant.splat", "plant.splat: must be a scene file (.yaml) (got splats, which an asset.yaml names"),
        ("render plant.splat", "plant.splat: must be a scene file (.yaml) (got splats, which an asset.yaml names"),
        (
            "render part.stl",
            "part.stl: must be a scene file (.yaml) (got a mesh, of which `mitsplat bake` makes an asset)",
        ),
        ("render nut", "nut: must be a scene file (.yaml) (got a folder: an asset, which a scene names"),
        ("preview scene.xml", "scene.xml: must be a scene file (.yaml) (got a Mitsuba scene, which `mitsplat render`"),
        ("audit folder", "folder must be a dataset of mitsplat (dataset.json: No such file or directory)"),
        ("audit gone", "gone must be a dataset of mitsplat (no such folder)"),
        ("render gone.yaml --address auto", "--address and --resources are of a cluster: give --engine ray as well"),
    ],
)
def test_another_kind_of_file_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    box_asset("nut").save("nut")
    box_asset("nut").splats.save("plant.splat")
    box_asset("nut").mesh.export("part.stl")
    Path("folder").mkdir()
    Path("scene.xml").write_text('<scene version="3.9.0"/>')
    Path("nut.step").touch()
    assert run(*words.split()) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"mitsplat: {sentence}") and told.count("\n") == 1


def test_schema_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("schema") == 0
    assert json.loads(capsys.readouterr().out)["properties"]["camera"]


def test_doctor_says_what_to_do(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("doctor") == 0
    assert "LLVM" in capsys.readouterr().out
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/no/such/libLLVM.so")
    assert run("doctor") == 1
    lines = capsys.readouterr().out.splitlines()
    failing = next(number for number, line in enumerate(lines) if line.startswith("FAIL  LLVM: /no/such/libLLVM.so"))
    assert "set DRJIT_LIBLLVM_PATH" in lines[failing + 1]


def test_settle_prints_certificates_and_shows_the_drop(
    scene_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The GIF moves, ends on the layout at rest, and shows the drop every 0.04 s as fast as it was."""
    monkeypatch.setattr(settle, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setenv("COLUMNS", "80")  # its headings and numbers are whole all the same
    gif = tmp_path / "drop.gif"
    assert run("settle", scene_path, "-n", 2, "--preview", "-o", gif, "--size", "64x36") == 0
    out = capsys.readouterr().out
    layouts = [Layout.from_json(json.loads(path.read_bytes())) for path in sorted((tmp_path / "cache").rglob("*.json"))]
    assert [layout.index for layout in layouts] == [0, 1]
    rows = [row.split("│")[1:-1] for row in out.splitlines() if row.startswith("│")]
    for layout, row in zip(layouts, rows, strict=True):
        assert int(row[0]) == layout.index
        assert int(row[1]) == len(layout.instances)
        assert float(row[2]) == pytest.approx(layout.certificate.time_to_rest, abs=0.005)
        assert float(row[6]) == pytest.approx(layout.certificate.collider_penetration * 1e3, abs=5e-4)
    pictures = int(re.search(rf"drop: {re.escape(str(gif))} \((\d+) pictures\)", out)[1])
    assert pictures == pytest.approx(layouts[0].certificate.time_to_rest / 0.04 + 2, abs=1.5)
    with Image.open(gif) as picture:
        shown = [
            (np.array(frame.convert("RGB"), dtype=float), frame.info["duration"])
            for frame in ImageSequence.Iterator(picture)
        ]
    assert shown[0][0].shape == (36, 64, 3)
    assert np.abs(shown[0][0] - shown[-1][0]).max() > 20
    # Equal pictures are stored once: only how long all are shown tells their number.
    assert sum(duration for _, duration in shown) == (pictures - 1) * 40 + 1500


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["-o", "drop.png"], "--out must end in .gif (got drop.png)"),
        (["-o", "gone/drop.gif"], "--out must be in a folder that exists (got gone/drop.gif)"),
        (["-n", "4"], "--layouts must be 1 to 3, the scene's output.layouts (got 4)"),
        (["--workers", "0"], "workers must be at least 1 (got 0)"),
    ],
)
def test_bad_option_of_settle_is_one_sentence(
    scene_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    assert run("settle", scene_path, *options) == 2
    assert sentence in capsys.readouterr().err


# Bad input


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--size", "12"], "--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got 12)"),
        (["--size", "-1x3"], "--size must be WIDTHxHEIGHT"),
        (["--size", "0x3"], "--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got 0x3)"),
        (["--seed", "-1"], "--seed must be >= 0 (got -1)"),
        (["--format", "yolo,zip"], "--format must be among yolo, yolo-detect, "),
        (["-n", "13"], "(got 13)"),
        (["-n", "0"], "(got 0)"),
        (["--workers", "0"], "(got 0)"),
        (["--quality", "fast", "--tolerance", "0.1"], "--quality and --tolerance both choose the preset"),
    ],
)
def test_bad_option_is_one_sentence(
    scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    assert run("render", scene_path, "-o", tmp_path / "out", *options) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert sentence in err
    assert "Traceback" not in err
    assert not list(tmp_path.glob("out/images/*/*"))


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (InputError("a.ply: broken"), "mitsplat: a.ply: broken\n"),
        (PermissionError(13, "Permission denied", "/out"), "mitsplat: /out: Permission denied\n"),
        (OSError("disk on fire"), "mitsplat: disk on fire\n"),
    ],
)
def test_input_and_file_errors_are_one_sentence(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str], error: Exception, sentence: str
) -> None:
    write_dataset.error = error
    assert run("render", scene_path) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status"), [(MissingResourceError("no GPU"), 3), (PartialResultError("too dark"), 4)]
)
def test_other_errors_have_a_status_of_their_own(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str], error: Exception, status: int
) -> None:
    write_dataset.error = error
    assert run("render", scene_path) == status
    assert f"mitsplat: {error}\n" in capsys.readouterr().err


def test_our_own_bugs_are_a_sentence(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset.error = ZeroDivisionError()
    assert run("render", scene_path) == 70
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith(
        "mitsplat: this is a fault of mitsplat, not of what it was given: ZeroDivisionError (the log"
    )


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (InputError("a.ply: broken"), 2),
        (MissingResourceError("disk full"), 3),
        (OSError(28, "No space left on device"), 3),
        (MemoryError(), 3),
        (PartialResultError("half"), 4),
        (KeyError("ours"), 70),
        (KeyboardInterrupt(), 130),
    ],
)
def test_a_log_for_machines_holds_the_error(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str], error: BaseException, status: int
) -> None:
    write_dataset.error = error
    assert run("render", scene_path, "--json") == status
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines() if line.startswith("{")]
    assert [event["event"] for event in events] == ["started", "failed"]
    assert (events[-1]["status"], events[-1]["error"]) == (status, type(error).__name__)


def test_a_log_for_machines_holds_bad_scenes_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("render", "gone.yaml", "--json") == 2
    event = json.loads(capsys.readouterr().err.splitlines()[-1])
    assert (event["command"], event["status"], event["message"]) == ("render", 2, "gone.yaml: no such file")


def test_interrupt_ends_with_130(scene_path: Path, write_dataset: Calls) -> None:
    write_dataset.error = KeyboardInterrupt()
    assert run("render", scene_path) == 130


def test_missing_scene(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("render", "gone.yaml") == 2
    assert capsys.readouterr().err == "mitsplat: gone.yaml: no such file\n"


def cut(data: bytes) -> bytes:
    return data[:-7]


def promise_billions(data: bytes) -> bytes:
    return data.replace(b"element vertex 12\n", b"element vertex 4000000000\n")


def first_mean_nan(data: bytes) -> bytes:
    head, _, body = data.partition(b"end_header\n")
    return head + b"end_header\n" + np.float32(np.nan).tobytes() + body[4:]


@pytest.mark.parametrize("damage", [cut, promise_billions, first_mean_nan])
def test_damaged_splats_are_one_sentence(
    scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: Callable[[bytes], bytes]
) -> None:
    splats = tmp_path / "assets/nut/splats.ply"
    data = splats.read_bytes()
    assert damage(data) != data
    splats.write_bytes(damage(data))
    assert run("render", scene_path, "-o", tmp_path / "out") == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"mitsplat: {scene_path}:")
    assert str(splats) in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_output_that_is_no_folder_is_one_sentence(
    scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").write_text("in the way")
    assert run("render", scene_path, "-o", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert str(tmp_path / "out") in err
    assert "Traceback" not in err


# Help


def test_every_command_and_option_is_explained() -> None:
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    for name, command in group.commands.items():
        assert command.get_short_help_str(80).endswith("."), name
        unexplained = [param.name for param in command.params if not getattr(param, "help", None)]
        assert unexplained == [], name


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    from importlib.metadata import version

    assert run("--version") == 0
    assert capsys.readouterr().out == f"mitsplat {version('mitsplat')}\n"


def finished(folder: Path, **changes: Any) -> AssetResult:
    figures = Verdict(
        photos=9, rejected=1, psnr=27.0, psnr_object=26.0, splat_iou=0.97, mesh_iou=0.96, offset=0.001, spread=0.001,
        lost=0.0, scale_error=None, units="metre", gaussians=12, faces=99, watertight=True, solid=True,
    )  # fmt: skip
    return AssetResult(folder, replace(figures, **changes), kept=False)


@pytest.mark.parametrize(
    ("kind", "maker"), [("object", (pipeline, "make_asset")), ("environment", (surroundings, "make_surroundings"))]
)
def test_mesh_passes_every_option_on(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
    maker: tuple[Any, str],
) -> None:
    box_asset("nut").mesh.export(tmp_path / "cad.stl")
    (tmp_path / "matrix.txt").write_text("2 0 0 1\n0 2 0 0\n0 0 2 0\n")
    calls = Calls(finished(tmp_path / "nut"))
    monkeypatch.setattr(*maker, calls)
    status = run(
        "mesh", "capture", "fit", "-o", tmp_path / "nut", "--name", "m6", "--class", "nut", "--kind", kind,
        "--faces", 500, "--voxels", 64, "--dissent", 1, "--size", 0.1, "--import", tmp_path / "cad.stl",
        "--normalisation", tmp_path / "matrix.txt", "--units", 0.001,
    )  # fmt: skip
    assert status == 0
    capture, fit_folder, out, job = calls.args
    assert (capture, fit_folder, out) == (Path("capture"), Path("fit"), tmp_path / "nut")
    assert (job.name, job.class_name, job.kind, job.settings.size) == ("m6", "nut", kind, 0.1)
    assert job.settings.surface == SurfaceSettings(voxels=64, faces=500, dissent=1)
    assert job.imported.metres_per_unit == 0.001
    np.testing.assert_allclose(job.imported.capture_from_mesh @ [1, 0, 0, 1], [0, 0, 0, 1], atol=1e-12)
    assert "held-out PSNR 27.00 dB; IoU with held-out masks splats 0.970, mesh 0.960" in capsys.readouterr().out


def test_a_missed_threshold_is_status_4_and_a_sentence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pipeline, "make_asset", Calls(finished(tmp_path, psnr=12.0)))
    assert run("mesh", "capture", "fit", "-o", tmp_path) == 4
    shown = capsys.readouterr()
    assert "held-out photos are met at only 12.0 dB (at least 24 is wanted): use even light" in shown.err
    assert f"report: {tmp_path / 'report.html'}" in shown.out
    assert run("mesh", "capture", "fit", "-o", tmp_path, "--units", 0.001) == 2


@pytest.mark.parametrize(
    ("kind", "maker", "masks"),
    [
        ("object", (pipeline, "make_photo_asset"), "alpha"),
        ("environment", (surroundings, "make_photo_surroundings"), "off"),
    ],
)
def test_asset_passes_every_option_on(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    kind: Literal["object", "environment"],
    maker: tuple[Any, str],
    masks: Literal["alpha", "off"],
) -> None:
    calls = Calls(finished(tmp_path))
    monkeypatch.setattr(*maker, calls)
    status = run(
        "asset", "photos", "-o", tmp_path / "mug", "--class", "cup", "--kind", kind, "--size", 0.1,
        "--scale-from", "a.jpg", "b.jpg", 0.5, "--poses", "model", "--masks", "masks", "--gaussians", 70,
        "--iterations", 80, "--budget", "1.5min", "--edge", 90, "--faces", 500, "--seed", 4,
    )  # fmt: skip
    assert status == 0
    photos, out, job = calls.args
    assert (photos, out, job.name, job.class_name) == (Path("photos"), tmp_path / "mug", "mug", "cup")
    assert (job.kind, job.settings.size, job.settings.surface.faces) == (kind, 0.1, 500)
    assert calls.kwargs["capture"] == CaptureSettings(
        kind=kind, scale_from=("a.jpg", "b.jpg", 0.5), poses=Path("model"), masks=Path("masks")
    )
    assert calls.kwargs["fit"] == FitSettings(gaussians=70, iterations=80, budget=90.0, size=90, seed=4, masks=masks)


def test_every_command_and_option_is_documented() -> None:
    page = (Path(__file__).parents[2] / "docs/first_dataset.md").read_text()
    commands = typer.main.get_command(app).commands
    assert set(commands) >= {"render", "audit", "report", "preview", "bake", "export", "schema", "doctor"}
    for name, command in commands.items():
        line = next((row for row in page.splitlines() if row.startswith(f"| `mitsplat {name}")), None)
        assert line is not None, name
        for parameter in command.params:
            if parameter.param_type_name == "option" and parameter.name != "help":
                spelt = [form for o in parameter.opts for form in (f"`{o}`", f"/{o}", f"{o}/")]
                assert any(form in line for form in spelt), parameter.opts
