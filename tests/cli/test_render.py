"""Command ``mitsplat render``: arguments passed on, refused input, and choice of the preset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from mitsplat.dataset import rerender
from mitsplat.dataset import write as dataset
from mitsplat.dataset.write import DatasetSummary
from mitsplat.errors import InputError
from mitsplat.frames import mitsuba_xml as xml_scene
from mitsplat.frames.accuracy import speed_accuracy as chart
from mitsplat.runtime.device import CPU, Device
from mitsplat.scene.scene import Scene
from tests.cli.typed import Calls, run
from tests.conftest import WriteScene


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


def test_render_states_that_a_dataset_keeps_more_images_than_asked_for(
    scene_path: Path, write_dataset: Calls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run("render", scene_path, "-o", out, "-n", 2) == 0
    assert capsys.readouterr().out.splitlines()[-1] == (
        f"kept: all 3 images of {out}, although only 2 are asked for; --overwrite removes them and renders anew"
    )
    for options in (["-n", 3], [], ["-n", 2, "--shard", "1/1"]):
        assert run("render", scene_path, "-o", out, *options) == 0
        assert "kept:" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("made", "status", "told"),
    [
        ({"compared": 2}, 0, "all files are identical to those in"),
        ({}, 0, "has no frame 3"),
        ({"compared": 2, "differing": ("a.png",), "cause": "seed was 0 and is 1"}, 1, "a.png (seed was 0 and is 1)"),
    ],
)
def test_render_only_makes_one_frame_and_compares_it(
    scene_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    made: dict[str, Any],
    status: int,
    told: str,
) -> None:
    calls = Calls(rerender.RerenderedFrame(tmp_path, {"files": {}}, **made))
    monkeypatch.setattr(rerender, "rerender_frame", calls)
    assert run("render", scene_path, "-o", tmp_path / "out", "--only", 3, "--size", "32x24") == status
    scene, index, out = calls.args
    assert (scene.spec.output.width, index, out) == (32, 3, tmp_path / "out-000003")
    assert calls.kwargs["dataset"] == tmp_path / "out"
    assert told in capsys.readouterr().out
    assert run("render", scene_path, "--only", 3, "-n", 2) == 2


def test_render_without_options_uses_the_values_of_the_file(scene_path: Path, write_dataset: Calls) -> None:
    assert run("render", scene_path) == 0
    scene, out = write_dataset.args
    assert out == Path("out/scene")
    assert (scene.spec.output.width, scene.spec.seed, scene.spec.quality) == (64, 7, "fast")
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
    def load(job: chart._RenderJob, _device: Device) -> None:
        chart._scene_renderer(job)
        raise InputError("loaded")

    write_scene(scene_data)
    (tmp_path / "inner").mkdir()
    inner = tmp_path / "inner" / "scene.yaml"
    asset = (tmp_path / scene_data["objects"][0]["asset"]).resolve()
    YAML(typ="safe", pure=True).dump(scene_data | {"objects": [{"asset": str(asset)}]}, inner)
    monkeypatch.setattr(chart, "_run_job", load)
    out = "-o", tmp_path / "chart.png"
    assert run(command[0], inner, *command[1:], *out) == 2
    assert "must be inside the scene's folder" in capsys.readouterr().err
    assert run(command[0], inner, *command[1:], *out, "--allow-outside") == 2
    assert "loaded" in capsys.readouterr().err


def test_render_chooses_the_preset_within_a_tolerance(
    scene_path: Path, write_dataset: Calls, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = Calls(chart.Row("fast", 0.5, 0.01, 40.0, 0.1, 0.9, 0.9, 1.0, 0.0, 40.0))
    monkeypatch.setattr(chart, "choose_preset", chosen)
    assert run("render", scene_path, "--tolerance", "0.02", "--seed", 3) == 0
    assert chosen.args == (scene_path, 0.02)
    assert chosen.kwargs["overrides"] == {"seed": 3}
    scene, _ = write_dataset.args
    assert (scene.spec.quality, scene.spec.seed) == ("fast", 3)
    assert "preset: fast (RMSE 0.01, 0.50 s an image)" in capsys.readouterr().out


def test_the_progress_bar_shows_images_and_rate(
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


def test_an_error_before_the_first_image_shows_no_progress_bar(
    scene_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*args: Any, **kwargs: Any) -> DatasetSummary:
        raise InputError("out: is not a dataset")

    monkeypatch.setattr(dataset, "write_dataset", fail)
    assert run("render", scene_path) == 2
    assert capsys.readouterr().err == "mitsplat: out: is not a dataset\n"


def test_render_writes_the_image_of_a_mitsuba_scene(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "one.png"
    calls = Calls(picture)
    monkeypatch.setattr(xml_scene, "render_apart", calls)
    assert run("render", "one.xml", "-o", tmp_path) == 0
    assert calls.args == (Path("one.xml"), tmp_path)
    assert str(picture) in capsys.readouterr().out
    for option, *value in (["--seed", 3], ["--workers", 2], ["--overwrite"], ["--any-device"], ["--engine", "ray"]):
        assert run("render", "one.xml", option, *value) == 2
        assert f"{option} does not apply to the Mitsuba scene one.xml" in capsys.readouterr().err


def test_options_that_do_not_apply_to_a_usd_stage_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for option, *value in (["--seed", 3], ["--workers", 2], ["--only", 2], ["--tolerance", 0.1], ["--shard", "1/2"]):
        assert run("render", "one.usda", option, *value) == 2
        assert f"{option} does not apply to the USD stage one.usda" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--size", "12"], "--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got 12)"),
        (["--size", "-1x3"], "--size must be WIDTHxHEIGHT"),
        (["--size", "0x3"], "--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got 0x3)"),
        (["--seed", "-1"], "--seed must be >= 0 (got -1)"),
        (["--format", "yolo,zip"], "--format must be one or more of yolo, yolo-detect, "),
        (["-n", "13"], "(got 13)"),
        (["-n", "0"], "(got 0)"),
        (["--workers", "0"], "(got 0)"),
        (["--quality", "fast", "--tolerance", "0.1"], "--quality and --tolerance both select the preset"),
    ],
)
def test_invalid_options_of_render_are_refused_in_one_sentence(
    scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    assert run("render", scene_path, "-o", tmp_path / "out", *options) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert sentence in err
    assert "Traceback" not in err
    assert not list(tmp_path.glob("out/images/*/*"))


def test_a_missing_scene_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
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
def test_damaged_splats_are_refused_in_one_sentence(
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


def test_an_output_that_is_not_a_folder_is_refused(
    scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").write_text("in the way")
    assert run("render", scene_path, "-o", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert str(tmp_path / "out") in err
    assert "Traceback" not in err
