"""Commands that read a scene, except ``render``, and commands without input."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence

from mitsplat.frames import frame, layer_sheet
from mitsplat.frames import mitsuba_xml as xml_scene
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.physics import settle
from mitsplat.scene.layout import Layout
from tests.cli.typed import Calls, run
from tests.conftest import WriteScene


def test_preview_writes_the_image_of_the_frame(
    scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    image = np.full((4, 6, 3), (10, 20, 30), dtype=np.uint8)
    calls = Calls(SimpleNamespace(image=image))
    monkeypatch.setattr(frame, "render_frame", calls)
    monkeypatch.setattr(layer_sheet, "layer_sheet", lambda rendered: rendered.image)
    options = ("--frame", 5, "-o", tmp_path / "a.png", "--size", "6x4")
    assert run("preview", scene_path, *options) == 0
    scene, index = calls.args
    assert (scene.spec.output.width, index) == (6, 5)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), image)


def test_preview_states_why_nothing_is_in_view(
    scene_data: dict[str, Any],
    write_scene: WriteScene,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The matrix is that of a camera in the axes of OpenGL, which looks along -z."""
    matrix = look_at_pose((0.8, -0.6, 0.9), (0, 0.1, 0)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    scene_data["camera"] = {"kind": "fixed", "world_from_camera": matrix.tolist(), "intrinsics": {"fov_x": 30}}
    monkeypatch.setattr(frame, "render_frame", Calls(SimpleNamespace(image=np.zeros((4, 6, 3), dtype=np.uint8))))
    monkeypatch.setattr(layer_sheet, "layer_sheet", lambda rendered: rendered.image)
    assert run("preview", write_scene(scene_data), "-o", tmp_path / "a.png") == 0
    assert "look  camera: no view shows any place" in (printed := capsys.readouterr().out)
    assert "in the axes of OpenGL" in printed


@pytest.mark.parametrize("name", ["a.gif", "no/such/folder/a.png"])
def test_preview_refuses_an_invalid_output_before_rendering(
    scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    monkeypatch.setattr(frame, "render_frame", Calls(error=AssertionError("rendered")))
    assert run("preview", scene_path, "-o", tmp_path / name) == 2


def test_export_writes_the_xml_of_the_frame(scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = Calls()
    monkeypatch.setattr(xml_scene, "export_xml", calls)
    assert run("export", scene_path, "--frame", 2, "-o", tmp_path / "a.xml") == 0
    assert calls.args[1:] == (2, tmp_path / "a.xml")


def test_export_names_the_background_that_no_xml_holds(
    scene_data: dict[str, Any],
    write_scene: WriteScene,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(xml_scene, "export_xml", Calls())
    assert run("export", write_scene(scene_data), "-o", tmp_path / "a.xml") == 0
    assert "not exported" not in capsys.readouterr().out
    Image.new("RGB", (8, 8)).save(tmp_path / "wall.png")
    scene = write_scene(scene_data | {"background": {"images": "wall.png"}})
    assert run("export", scene, "-o", tmp_path / "a.xml") == 0
    assert "not exported: the background image\n" in capsys.readouterr().out


def test_settle_prints_certificates_and_writes_the_animation(
    scene_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The GIF moves, ends on the layout at rest, and shows the drop in real time with a frame every 0.04 s."""
    monkeypatch.setattr(settle, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setenv("COLUMNS", "80")  # headings and numbers are not truncated at this width
    gif = tmp_path / "drop.gif"
    assert run("settle", scene_path, "-n", 2, "--preview", "-o", gif, "--size", "64x36") == 0
    out = capsys.readouterr().out
    layouts = [Layout.from_json(json.loads(path.read_bytes())) for path in sorted((tmp_path / "cache").rglob("*.json"))]
    assert [layout.index for layout in layouts] == [0, 1]
    assert "rest [s]" in out and "[rad/s]" in out and out.count("[mm]") == 4
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
    assert np.abs(shown[0][0] - shown[-1][0]).max() > 10
    # Equal images are stored once, so the number of images follows only from the total duration.
    assert sum(duration for _, duration in shown) == (pictures - 1) * 40 + 1500


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["-o", "drop.png"], "--out must end in .gif (got drop.png)"),
        (["-o", "gone/drop.gif"], "--out must be in an existing folder (got gone/drop.gif)"),
        (["-n", "4"], "--layouts must be 1 to 3, the scene's output.layouts (got 4)"),
        (["--workers", "0"], "workers must be at least 1 (got 0)"),
    ],
)
def test_invalid_options_of_settle_are_refused_in_one_sentence(
    scene_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    assert run("settle", scene_path, *options) == 2
    assert sentence in capsys.readouterr().err


def test_schema_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("schema") == 0
    assert json.loads(capsys.readouterr().out)["properties"]["camera"]


def test_doctor_prints_remedies_and_sets_its_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("doctor") == 0
    assert "LLVM" in capsys.readouterr().out
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/no/such/libLLVM.so")
    assert run("doctor") == 1
    lines = capsys.readouterr().out.splitlines()
    failing = next(number for number, line in enumerate(lines) if line.startswith("FAIL  LLVM: /no/such/libLLVM.so"))
    assert "set DRJIT_LIBLLVM_PATH" in lines[failing + 1]
