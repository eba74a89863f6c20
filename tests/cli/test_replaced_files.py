"""Overwrite protection: commands keep files that they did not write, and refuse to replace them before any work."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from mitsplat.asset import Asset
from mitsplat.capture.lighting import refuse_to_replace
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.capture.video import choose_frames
from mitsplat.errors import InputError, MissingResourceError, exit_status
from mitsplat.fit.fit_folder import FitFolder
from mitsplat.storage.files import write_file, write_text
from tests.cli.typed import run
from tests.conftest import WriteScene, box_asset, contents


@pytest.mark.parametrize("command", ["bake", "import"])
def test_an_existing_asset_is_replaced_only_with_overwrite(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    asset = box_asset("gear", (0.02, 0.03, 0.01))
    asset.save(tmp_path / "gear")
    given = tmp_path / ("other.ply" if command == "import" else "other.stl")
    (asset.splats.save if command == "import" else asset.mesh.export)(given)
    before = contents(tmp_path)
    assert run(command, given, "-o", tmp_path / "gear") == 2
    there = tmp_path / "gear" / "asset.yaml"
    sentence = f"mitsplat: {there}: already exists: choose another folder, or use --overwrite to replace it\n"
    assert capsys.readouterr().err == sentence
    own = tmp_path / "gear" / ("splats.ply" if command == "import" else "mesh.ply")
    assert run(command, own, "-o", tmp_path / "gear", "--overwrite") == 2
    assert "which would be replaced" in capsys.readouterr().err
    assert run(command, given, "-o", given / "below") == 2
    assert f"got {given / 'below'} below the file {given}" in capsys.readouterr().err
    assert run(command, given, "-o", "/") == 2
    assert contents(tmp_path) == before


def test_a_failed_save_keeps_the_earlier_asset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box_asset("gear", (0.02, 0.03, 0.01)).save(tmp_path)
    before = contents(tmp_path)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))

    monkeypatch.setattr("trimesh.Trimesh.export", full)
    with pytest.raises(MissingResourceError, match="File too large: raise the limit of file sizes"):
        box_asset("plate", (0.1, 0.1, 0.01)).save(tmp_path)
    assert contents(tmp_path) == before
    monkeypatch.undo()
    box_asset("plate", (0.1, 0.1, 0.01)).save(tmp_path)
    assert Asset.load(tmp_path).name == "plate" and contents(tmp_path).keys() == before.keys()


def test_a_failed_write_leaves_no_partial_file_and_names_the_file(tmp_path: Path) -> None:
    write_text(tmp_path / "page.html", "earlier")

    def fill(part: Path) -> None:
        part.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OSError, match="No space left on device") as told:
        write_file(tmp_path / "page.html", fill)
    assert told.value.filename == str(tmp_path / "page.html") and exit_status(told.value) == 3
    assert contents(tmp_path) == {"page.html": b"earlier"}


def test_lights_replaces_only_its_own_files(tmp_path: Path) -> None:
    out = tmp_path / "room.yaml"
    refuse_to_replace(out, [tmp_path / "sky.exr"])
    for given in ("room_panorama.exr", "room.png"):
        with pytest.raises(InputError, match=f"{given} is an input and would be replaced"):
            refuse_to_replace(out, [tmp_path / given])
    (tmp_path / "room.png").write_text("mine")
    with pytest.raises(InputError, match=r"room\.png: already exists and was not written by `mitsplat lights`"):
        refuse_to_replace(out, [])
    out.write_text("name: room\n")
    with pytest.raises(InputError, match=r"room\.yaml: already exists"):
        refuse_to_replace(out, [])
    out.write_text("# Captured light: 3 W/m^2\nlights:\n")
    refuse_to_replace(out, [])


def test_a_board_sheet_is_replaced_only_with_overwrite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = tmp_path / "board.pdf"
    sheet.write_text("an invoice")
    assert run("board", "-o", sheet) == 2 and sheet.read_text() == "an invoice"
    message = f"mitsplat: --out must be a new file (got {sheet}); --overwrite replaces an existing one\n"
    assert capsys.readouterr().err == message
    assert run("board", "-o", sheet, "--overwrite") == 0 and sheet.read_bytes().startswith(b"%PDF")


def test_an_edited_export_is_kept(
    tmp_path: Path,
    scene_data: dict[str, Any],
    write_scene: WriteScene,
    capsys: pytest.CaptureFixture[str],
    physics: None,
) -> None:
    scene = write_scene(scene_data)
    assert run("export", scene, "-o", scene) == 2 and "--out must end in .xml" in capsys.readouterr().err
    out = tmp_path / "scene.xml"
    out.write_text("edited")
    assert run("export", scene, "-o", out) == 2 and "--overwrite replaces an existing one" in capsys.readouterr().err
    assert out.read_text() == "edited"
    assert run("export", scene, "-o", out, "--overwrite") == 0 and "<scene" in out.read_text()
    assert run("export", scene, "-o", tmp_path, "--overwrite") == 2


def test_a_capture_removes_only_files_of_captures(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(3):
        (photos / f"{number}.jpg").write_bytes(b"torn")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/1.png").write_text("mine")
    (tmp_path / "model.json").write_text("{}")

    def refused(out: str, match: str, **settings: Any) -> None:
        before = contents(tmp_path)
        with pytest.raises(InputError, match=match):
            capture_photos(photos, tmp_path / out, CaptureSettings(**settings))
        assert contents(tmp_path) == before

    for made in ("images", "masks", "sfm"):
        (tmp_path / made / made).mkdir(parents=True)
        (tmp_path / made / made / "1.png").write_text("mine")
        refused(made, f"{made}/{made}: already exists and is not part of a capture")
        (tmp_path / f"link {made}").mkdir()
        (tmp_path / f"link {made}" / made).symlink_to(tmp_path / "mine")
        refused(f"link {made}", "already exists and is not part of a capture")
    refused("out", "the masks must not be the photographs", masks=photos)
    refused("out", "gone: no such folder of masks", masks=tmp_path / "gone")
    (tmp_path / "new/sfm").mkdir(parents=True)
    (tmp_path / "new/sfm/model.json").write_text("{}")
    refused("new", "must not lie in .*sfm, which is overwritten", poses=tmp_path / "new/sfm/model.json")


def test_a_damaged_video_keeps_the_earlier_frames(tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    (tmp_path / "torn.mp4").write_bytes(b"torn")
    (frames / "000001.jpg").write_text("a frame")
    with pytest.raises(InputError, match="already exists and contains no frames of a video"):
        choose_frames(tmp_path / "torn.mp4", frames, most=8, least=3)
    (frames / "video.json").write_text("{}")
    with pytest.raises(InputError, match="video"):
        choose_frames(tmp_path / "torn.mp4", frames, most=8, least=3)
    assert (frames / "000001.jpg").read_text() == "a frame"
    assert {path.name for path in tmp_path.iterdir()} == {"frames", "torn.mp4"}


@pytest.mark.parametrize("there", ["splats.ply", "held_out/photo.png"])
def test_a_fit_refuses_a_folder_with_other_files(tmp_path: Path, there: str) -> None:
    write_text(tmp_path / there, "precious")
    with pytest.raises(InputError, match="exists already and does not belong to a fit; --overwrite replaces it"):
        FitFolder(tmp_path, "inputs").refuse_others()
    write_text(tmp_path / "fit.json", "{}")
    FitFolder(tmp_path, "inputs").refuse_others()


def test_an_interrupt_wrapped_in_another_exception_has_status_130() -> None:
    error = RuntimeError("dr.while_loop(): encountered an exception")
    assert exit_status(error) is None
    error.__cause__ = KeyboardInterrupt()
    assert exit_status(error) == 130
