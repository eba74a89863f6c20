"""Errors of the command line: one sentence, an exit status, and a machine-readable log."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mitsplat.cli.console import command_log
from mitsplat.errors import InputError, MissingResourceError, PartialResultError
from tests.cli.typed import Calls, run
from tests.conftest import box_asset


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "bake plant.splat -o a",
            "plant.splat: must be a mesh (.glb, .step, .obj, .stl, .ply) (got a splat file; import it first: `mits",
        ),
        (
            "bake nut.iges -o a",
            "nut.iges: must be a mesh (.glb, .step, .obj, .stl, .ply) (got a CAD file",
        ),
        ("bake folder -o a", "folder: must be a mesh (.glb, .step, .obj, .stl, .ply) (got a folder)"),
        ("bake part.stl -o part.stl", "--out must be a folder (got the file part.stl)"),
        (
            "check plant.splat",
            "plant.splat: must be a scene file (.yaml) (got a splat file; import it first: `mitsplat import",
        ),
        (
            "render plant.splat",
            "plant.splat: must be a scene file (.yaml) (got a splat file; import it first: `mitsplat import",
        ),
        (
            "render part.stl",
            "part.stl: must be a scene file (.yaml) (got a mesh; bake it first: `mitsplat bake part.stl -o part`)",
        ),
        ("render nut", "nut: must be a scene file (.yaml) (got the folder of an asset: enter it in a scene"),
        ("preview scene.xml", "scene.xml: must be a scene file (.yaml) (got a Mitsuba scene: `mitsplat render`"),
        ("audit folder", "folder: must be a dataset of mitsplat (got a folder without dataset.json)"),
        ("audit gone", "gone: no such folder"),
        ("audit nut", "nut: must be a dataset of mitsplat (got the folder of an asset: enter it in a scene"),
        ("fit gone -o fitted", "gone: no such folder"),
        ("fit nut -o fitted", "nut: must be the folder of a capture (got the folder of an asset: enter it in a scene"),
        ("render gone.yaml --address auto", "--address does not apply to this machine: add --engine ray"),
    ],
)
def test_a_file_of_the_wrong_kind_is_refused_with_its_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    box_asset("nut").save("nut")
    box_asset("nut").splats.save("plant.splat")
    box_asset("nut").mesh.export("part.stl")
    Path("folder").mkdir()
    Path("scene.xml").write_text('<scene version="3.9.0"/>')
    Path("nut.iges").touch()
    assert run(*words.split()) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"mitsplat: {sentence}") and told.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (InputError("a.ply: broken"), "mitsplat: a.ply: broken\n"),
        (PermissionError(13, "Permission denied", "/out"), "mitsplat: /out: Permission denied\n"),
        (OSError("disk on fire"), "mitsplat: disk on fire\n"),
    ],
)
def test_input_and_file_errors_are_one_sentence_with_status_2(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str], error: Exception, sentence: str
) -> None:
    write_dataset.error = error
    assert run("render", scene_path) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status"), [(MissingResourceError("no GPU"), 3), (PartialResultError("too dark"), 4)]
)
def test_other_errors_have_their_own_status(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str], error: Exception, status: int
) -> None:
    write_dataset.error = error
    assert run("render", scene_path) == status
    assert f"mitsplat: {error}\n" in capsys.readouterr().err


def test_an_unexpected_exception_is_one_sentence_with_a_log(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset.error = ZeroDivisionError()
    assert run("render", scene_path) == 70
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith("mitsplat: internal error of mitsplat, not caused by the input: ZeroDivisionError (the log")


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
def test_the_json_log_has_the_error(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str], error: BaseException, status: int
) -> None:
    write_dataset.error = error
    assert run("render", scene_path, "--json") == status
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines() if line.startswith("{")]
    assert [event["event"] for event in events] == ["started", "failed"]
    assert (events[-1]["status"], events[-1]["error"]) == (status, type(error).__name__)


def test_the_json_log_has_errors_of_scene_files(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("render", "gone.yaml", "--json") == 2
    event = json.loads(capsys.readouterr().err.splitlines()[-1])
    assert (event["command"], event["status"], event["message"]) == ("render", 2, "gone.yaml: no such file")


def test_an_interrupt_ends_with_status_130_and_the_way_to_continue(
    scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset.error = KeyboardInterrupt()
    assert run("render", scene_path) == 130
    sentence = "interrupted: run the command again, without --overwrite, to continue"
    assert capsys.readouterr().err == f"mitsplat: {sentence}\n"
    assert run("render", scene_path, "--json") == 130
    assert json.loads(capsys.readouterr().err.splitlines()[-1])["message"] == sentence


@pytest.mark.parametrize("command", ["evaluate", "compare"])
def test_an_interrupted_command_that_starts_anew_names_no_way_to_continue(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(KeyboardInterrupt), command_log(False, command):
        raise KeyboardInterrupt
    assert capsys.readouterr().err == "mitsplat: interrupted\n"
