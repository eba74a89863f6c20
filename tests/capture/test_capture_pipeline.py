"""Pipeline from photographs to a capture: a rendered scene with known ground truth, and unusable folders."""

from __future__ import annotations

import json
import shutil
import signal
import sqlite3
import subprocess
import sys
import zlib
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageFilter

from benchmarks.assets.photographing import photograph
from mitsplat.capture import structure_from_motion as sfm
from mitsplat.capture.alignment.metric_frame import find_metric_frame
from mitsplat.capture.alignment.target_evidence import fit_similarity
from mitsplat.capture.capture import Capture
from mitsplat.capture.photos import Prepared
from mitsplat.capture.pipeline import capture_pipeline as take
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_result import CaptureResult
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.capture.structure_from_motion import SparseModel
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.geometry.camera import Camera
from tests import rendered
from tests.cli.typed import run


def test_cameras_of_rendered_photos_are_recovered(
    photos: tuple[Path, dict[str, Camera]], captured: tuple[Path, Path, CaptureResult]
) -> None:
    _, truth = photos
    _, out, result = captured
    capture = Capture.load(out)
    assert (capture.units, capture.up, capture.table) == ("metre", "z", True)
    assert set(capture.rejected) == {"torn.png"}
    assert capture.rejected["torn.png"].startswith("it cannot be read")
    assert result.given == 17  # without the copy
    assert result.copies == ["photo03 (1).png"]
    assert "1 of the files are copies of other photos and are left out: photo03 (1).png" in result.warnings
    assert result.shortcoming is None
    assert result.reprojection_error < 1
    assert {photo.name for photo in capture.photos} == set(truth)
    found = np.array([photo.camera.centre for photo in capture.photos])
    true = np.array([truth[photo.name].centre for photo in capture.photos])
    matrix, residuals = fit_similarity(found, true)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    # Photos of 480 px with a self-calibrated lens give the scale within a few tenths of a per cent.
    assert abs(scale - 1) < 5e-3
    assert np.degrees(np.arccos(matrix[2, 2] / scale)) < 0.2
    # No camera may be off by 1 % of its distance.
    assert np.linalg.norm(residuals, axis=1).max() < 0.01 * 0.26
    assert abs(matrix[2, 3]) < 5e-4
    for photo in capture.photos:
        pixels, _ = photo.camera.project(capture.points[photo.seen])
        assert ((pixels > -5) & (pixels < np.array(rendered.SIZE) + 5)).all()


def test_a_camera_moved_in_the_model_explains_few_of_its_matches(captured: tuple[Path, Path, CaptureResult]) -> None:
    """One camera of the model is moved. Only this camera may explain few of its matches."""
    code = """
import sys, json
from pathlib import Path
from mitsplat.capture.sfm_worker import agreement, largest_first, pycolmap
import numpy as np
folder = Path(sys.argv[1])
models = {int(path.name): pycolmap.Reconstruction(path) for path in (folder / "models").glob("[0-9]*")}
model = largest_first(models)[0]
before = agreement(model, folder / "database.db")
image = model.find_image_with_name("photo05.png")
turn = np.eye(3, 4)
turn[0, 3] = 0.2 * np.linalg.norm(image.cam_from_world().translation)
image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turn) * image.cam_from_world())
print(json.dumps([before, agreement(model, folder / "database.db")]))
"""
    folder = captured[1] / "sfm"
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True)
    before, after = json.loads(done.stdout.splitlines()[-1])
    assert min(before.values()) > 0.7
    assert after["photo05.png"] < 0.5
    assert min(share for name, share in after.items() if name != "photo05.png") > 0.5


def test_an_interrupted_second_capture_leaves_no_readable_capture(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copies of other photographs, or in another size, are never read with cameras of the earlier ones."""
    given, finished, _ = captured
    out = Path(shutil.copytree(finished, tmp_path / "capture"))

    def interrupt(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(take, "prepare_photos", interrupt)
    with pytest.raises(KeyboardInterrupt):
        capture_photos(given, out, CaptureSettings(board=rendered.BOARD, max_size=240))
    with pytest.raises(InputError, match=r"without capture\.json"):
        Capture.load(out)


def test_pycolmap_is_not_imported_into_this_process(captured: tuple[Path, Path, CaptureResult], tmp_path: Path) -> None:
    assert "pycolmap" not in sys.modules
    assert zlib.decompress(zlib.compress(b"a" * 10000)) == b"a" * 10000
    Image.fromarray(np.zeros((500, 500, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    with Image.open(captured[1] / "capture.png") as sheet:
        assert sheet.width == 1280


def test_a_finished_capture_is_reused(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, finished, result = captured
    out = tmp_path / "capture"
    shutil.copytree(finished, out)

    def refuse(*args: object) -> None:
        raise AssertionError("COLMAP was run again")

    monkeypatch.setattr(sfm, "_run", refuse)
    again = capture_photos(given, out, CaptureSettings(board=rendered.BOARD))
    np.testing.assert_array_equal(again.capture.points, result.capture.points)
    assert (again.given, again.source) == (result.given, result.source)
    with pytest.raises(AssertionError, match="COLMAP was run again"):
        capture_photos(given, out, CaptureSettings(board=rendered.BOARD, max_size=400))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_photos_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], count: int) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(count):
        Image.new("RGB", (40, 30)).save(folder / f"{number}.png")
    assert run("capture", folder, "-o", tmp_path / "out") == 2
    sentence = f"mitsplat: {folder}: must hold at least 3 photographs (got {count})\n"
    assert capsys.readouterr().err.endswith(sentence)
    assert not (tmp_path / "out").exists()


def test_photos_without_texture_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photos").mkdir()
    for number in range(3):
        Image.new("RGB", (120, 90), (90, 100, 110 + number)).save(tmp_path / f"photos/{number}.png")
    assert run("capture", tmp_path / "photos", "-o", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert "no two of the 3 photos share enough points to find cameras" in err
    assert "Traceback" not in err


def test_a_crash_of_colmap_is_reported_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photos").mkdir()
    for number in range(3):
        Image.new("RGB", (40, 30), (90, 100, 110 + number)).save(tmp_path / f"photos/{number}.png")
    crash = tmp_path / "crash"
    crash.write_text("#!/bin/sh\nkill -SEGV $$\n")
    crash.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(crash))
    with pytest.raises(
        MissingResourceError, match=r"COLMAP ended with signal 11 while starting; its messages are in .*log"
    ):
        capture_photos(tmp_path / "photos", tmp_path / "out")


def model_of(capture: Capture, count: int | None = None) -> SparseModel:
    """Build the sparse model that structure from motion would find for the first photos of a capture."""
    photos = capture.photos[:count]
    cameras, seen = ({photo.file.name: getattr(photo, key) for photo in photos} for key in ("camera", "seen"))
    return SparseModel(cameras, capture.points, capture.colours, seen)


def test_photos_of_two_things_end_with_status_4(
    captured: tuple[Path, Path, CaptureResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given, _, result = captured
    elsewhere = frozenset(photo.file.name for photo in result.capture.photos[8:14])
    model = replace(model_of(result.capture, 8), elsewhere=elsewhere)
    monkeypatch.setattr(take, "find_cameras", lambda *args: model)
    assert run("capture", given, "-o", tmp_path / "out", "--square", 0.035, "--kind", "environment") == 4
    out, err = capsys.readouterr()
    assert (
        "rejected: photo08.png: it matches only a smaller group of photos, for example of another object or side\n"
        in out
    )
    assert "rejected: photo15.png: it shares too few points with the other photos\n" in out
    assert "only 8 of 17 photos (47%) could be used, 75% are required" in err
    assert len(Capture.load(tmp_path / "out").photos) == 8


def test_cameras_with_few_matches_are_named_unless_a_board_confirms_them(
    captured: tuple[Path, Path, CaptureResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given, _, result = captured
    model = model_of(result.capture)
    images = {photo.file.name: photo.file for photo in result.capture.photos}
    seen, *_ = sorted(find_metric_frame(model, images, board=rendered.BOARD).confirmed - {"photo03.png"})
    model = replace(model, agreement=dict.fromkeys(model.cameras, 0.98) | {"photo03.png": 0.4, seen: 0.6})
    monkeypatch.setattr(take, "find_cameras", lambda *args: model)
    assert run("capture", given, "-o", tmp_path / "sure", "--square", 0.035, "--kind", "environment") == 0
    output = capsys.readouterr().out
    assert "rejected: photo03.png: its camera is wrong: it agrees with only 40% of its matches\n" in output
    assert output.count("warning: ") == output.count("are copies of other photos") == 1
    monkeypatch.setattr("mitsplat.capture.alignment.target_evidence._fit_board", lambda *args: None)
    for _ in range(2):  # first computed, then reused
        assert run("capture", given, "-o", tmp_path / "out", "--kind", "environment") == 0
        output = capsys.readouterr().out
        assert (
            "warning: cameras agree with few of their matches and may be wrong; remove these photos or add others: "
            f"{seen} (60%)\n" in output
        )


@pytest.mark.parametrize("undistorted", [False, pytest.param(True, marks=pytest.mark.extended)])
def test_a_camera_that_the_board_contradicts_is_left_out(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undistorted: bool
) -> None:
    """The board pose comes from the other cameras. The doubt about the photo is recorded, undistorted or not."""
    given, _, result = captured
    model = model_of(result.capture)
    images = {photo.file.name: photo.file for photo in result.capture.photos}
    seen, doubted, *_ = sorted(find_metric_frame(model, images, board=rendered.BOARD).confirmed)
    pose = model.cameras[seen].world_from_camera.copy()
    pose[:3, 3] += (0.02, 0, 0)
    cameras = {**model.cameras, seen: replace(model.cameras[seen], world_from_camera=pose)}
    monkeypatch.setattr(take, "find_cameras", lambda *args: replace(model, cameras=cameras, agreement={doubted: 0.6}))
    settings = CaptureSettings(board=rendered.BOARD, kind="environment", undistorted=undistorted)
    found = capture_photos(given, tmp_path / "out", settings)
    assert found.capture.rejected[seen].startswith("its camera is wrong: it sees the board ")
    assert found.capture.table
    assert found.doubtful == {}
    assert len(found.capture.photos) == len(result.capture.photos) - 1
    monkeypatch.setattr("mitsplat.capture.alignment.target_evidence._fit_board", lambda *args: None)
    again = capture_photos(given, tmp_path / "again", settings)
    assert again.doubtful == {doubted: 0.6}


def test_a_run_without_undistort_starts_from_the_photos_again(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run without --undistort, in the folder of a run with it, reads the photographs again."""
    given, _, result = captured
    model = model_of(result.capture, 4)
    cameras = {name: replace(camera, distortion=(-0.2, 0.0, 0.0, 0.0)) for name, camera in model.cameras.items()}
    monkeypatch.setattr(take, "find_cameras", lambda *args: replace(model, cameras=cameras))
    for undistorted in (True, False):
        settings = CaptureSettings(board=rendered.BOARD, kind="environment", undistorted=undistorted)
        photo, *_ = capture_photos(given, tmp_path / "out", settings).capture.photos
        assert (photo.file.read_bytes() == (given / photo.name).read_bytes()) is not undistorted


def test_an_output_folder_that_holds_the_inputs_is_refused(photos: tuple[Path, object], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must not lie in the folder of the photographs"):
        capture_photos(photos[0], photos[0] / "out")
    shutil.copytree(photos[0], tmp_path / "out/images")
    with pytest.raises(InputError, match="images, which is overwritten"):
        capture_photos(tmp_path / "out/images", tmp_path / "out")
    shutil.copytree(photos[0], tmp_path / "out/masks/mine")
    with pytest.raises(InputError, match="masks, which is overwritten"):
        capture_photos(photos[0], tmp_path / "out", CaptureSettings(masks=tmp_path / "out/masks/mine"))
    assert len(list((tmp_path / "out").rglob("*.png"))) == 2 * len(list(photos[0].glob("*.png")))


@pytest.mark.slow
def test_mixed_and_damaged_photos_give_accurate_cameras(
    photos: tuple[Path, dict[str, Camera]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One photo is rotated, one is smaller, one is blurred and one is truncated.

    Results are reproducible for the same photos. The tolerances follow from measured camera errors:

    ===================================================  ==================
    Worst of eight cameras                               Error [mm]
    ===================================================  ==================
    Eight draws of the noise in photos of this size      0.9 to 2.1
    Photos of this test                                  2.9
    Mean                                                 1.3 +- 0.6
    A hundredth of the camera distance                   2.6
    ===================================================  ==================

    All cameras together must be within that hundredth, and each one within twice as much.
    """
    given, out = tmp_path / "given", tmp_path / "out"
    given.mkdir()
    for number in range(8):
        shutil.copy(photos[0] / f"photo{number:02}.png", given)
    with Image.open(given / "photo02.png") as image:
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6  # shown rotated by 90 degrees clockwise
        image.transpose(Image.Transpose.ROTATE_90).save(given / "photo02.png", exif=exif)
    with Image.open(given / "photo06.png") as image:
        image.resize((360, 270), Image.Resampling.BOX).save(given / "photo06.png")
    with Image.open(given / "photo00.png") as image:
        image.filter(ImageFilter.GaussianBlur(8)).save(given / "shaken.png")
        image.save(given / "short.jpg", quality=95)
    (given / "short.jpg").write_bytes((given / "short.jpg").read_bytes()[:9000])
    assert run("capture", given, "-o", out, "--square", 0.035, "--kind", "environment") == 0
    output, err = capsys.readouterr()
    assert "Traceback" not in err
    assert "rejected: shaken.png: it is blurred (sharpness " in output
    assert "rejected: short.jpg: it cannot be read (" in output
    capture = Capture.load(out)
    assert set(capture.rejected) == {"shaken.png", "short.jpg"}
    cameras = {photo.name: photo.camera for photo in capture.photos}
    assert (cameras["photo02.png"].width, cameras["photo02.png"].height) == rendered.SIZE
    assert (cameras["photo06.png"].width, cameras["photo06.png"].height) == (360, 270)
    found, true = (np.array([of[name].centre for name in cameras]) for of in (cameras, photos[1]))
    off = np.linalg.norm(fit_similarity(found, true)[1], axis=1) / 0.26
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert off.max() < 0.02


@pytest.mark.extended
def test_one_core_and_an_interruption_give_the_same_bytes(photos: tuple[Path, object], tmp_path: Path) -> None:
    """The capture runs on all cores, or on one core in a process that is killed while it matches and then resumed."""
    given = tmp_path / "given"
    given.mkdir()
    for number in range(5):
        shutil.copy(photos[0] / f"photo{number:02}.png", given)
    settings = CaptureSettings(board=rendered.BOARD, kind="environment")
    capture_photos(given, tmp_path / "whole", settings)
    code = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from tests.capture.test_capture_pipeline import CaptureSettings, capture_photos, rendered
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
def progress(done, total, what):
    if what == "matching":
        os.kill(os.getpid(), signal.SIGKILL)
given, out = map(Path, sys.argv[2:])
capture_photos(given, out, CaptureSettings(board=rendered.BOARD, kind="environment"), progress=progress)
"""
    out = tmp_path / "killed"
    ended = subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parents[2]), str(given), str(out)],
        capture_output=True,
        text=True,
    )
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert (out / "sfm/database.db").exists() and not (out / "capture.json").exists()
    capture_photos(given, out, settings)
    for name in ("capture.json", "points.npz", "capture.png", "inputs.json"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_matches_are_reused_after_the_capture_folder_was_moved(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path
) -> None:
    """A moved capture is computed again as an environment. Its photos are equal, so matches are reused."""
    given, finished, result = captured
    out = Path(shutil.copytree(finished, tmp_path / "moved"))
    with closing(sqlite3.connect(out / "sfm/database.db")) as database:
        database.execute("PRAGMA application_id = 7")
    again = capture_photos(given, out, CaptureSettings(board=rendered.BOARD, kind="environment"))
    with closing(sqlite3.connect(out / "sfm/database.db")) as database:
        assert database.execute("PRAGMA application_id").fetchone() == (7,)
    assert again.reprojection_error == result.reprojection_error
    for one, other in zip(again.capture.photos, result.capture.photos, strict=True):
        np.testing.assert_array_equal(one.camera.world_from_camera[:, :3], other.camera.world_from_camera[:, :3])


def test_colmap_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    """A COLMAP process that continues would write into the database of the next run."""
    (tmp_path / "job.json").write_text('{"task": "reconstruct"}')
    code = f"""
import time
from mitsplat.capture import sfm_worker as sfm_child
sfm_child.run = lambda job, folder: print("working", flush=True) or time.sleep(3600)
sfm_child.end_with_parent()
sfm_child.main(sfm_child.Path({str(tmp_path / "job.json")!r}))
"""
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout is not None and child.stdin is not None
    assert child.stdout.readline() == b"working\n"
    assert child.poll() is None
    child.stdin.close()
    assert child.wait(timeout=300) == 1
    child.stdout.close()


@pytest.mark.extended
def test_photos_of_another_scene_are_rejected(
    photos: tuple[Path, dict[str, Camera]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second object stands on another table, without a board."""
    given, out = tmp_path / "given", tmp_path / "out"
    scene = rendered.box_scene(6)
    del scene["board"]
    for name in photograph(scene, rendered.cameras(16)[8:12], given, samples=8):
        (given / name).rename(given / name.replace("photo", "other"))
    for number in range(6):
        shutil.copy(photos[0] / f"photo{number:02}.png", given)
    assert run("capture", given, "-o", out, "--square", 0.035, "--kind", "environment") == 4
    output, err = capsys.readouterr()
    assert "only 6 of 10 photos (60%) could be used, 75% are required" in err
    assert "Traceback" not in err
    capture = Capture.load(out)
    assert {photo.name for photo in capture.photos} == {f"photo{number:02}.png" for number in range(6)}
    assert set(capture.rejected) == {f"other{number:02}.png" for number in range(4)}
    assert "rejected: other00.png: it " in output


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--squares", "7"], "--squares must be COLUMNSxROWS, such as 7x5 (got 7)"),
        (["--tag", "0"], "the edge of tags must be 0.001 to 10 m (got 0.0)"),
        (["--tag", "inf"], "the edge of tags must be 0.001 to 10 m (got inf)"),
        (["--scale-from", "a.jpg", "b.jpg", "nan"], "the distance of a.jpg and b.jpg must be 1e-6 to 1e6 m (got nan)"),
        (["--scale-from", "a.jpg", "b.jpg", "0"], "the distance of a.jpg and b.jpg must be 1e-6 to 1e6 m (got 0)"),
        (["--metric"], "--metric requires --poses"),
        (["--max-size", "10"], "the size of photos must be at least 64 px (got 10)"),
        (["--masks", "a", "--mask-model", "b"], "--masks and --mask-model both define the masks: give only one"),
    ],
)
def test_invalid_options_are_refused_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    assert run("capture", tmp_path, "-o", tmp_path / "out", *options) == 2
    assert sentence in capsys.readouterr().err


def test_the_board_command_writes_a_pdf_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("board", "-o", tmp_path / "b.pdf", "--paper", "letter", "--squares", "6x4", "--square", 0.04) == 0
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
    assert run("board", "-o", tmp_path / "b.png") == 2
    assert "--out must end in .pdf" in capsys.readouterr().err


def test_a_video_is_captured_from_its_chosen_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test runs up to structure from motion, which receives photographs of one camera."""
    texture = np.kron(np.random.default_rng(0).integers(0, 255, (20, 100), dtype=np.uint8), np.ones((12, 12), np.uint8))
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    for left in range(0, 240, 4):
        writer.write(cv2.cvtColor(texture[:, left : left + 320], cv2.COLOR_GRAY2BGR))
    writer.release()
    given: list[Prepared] = []

    def find_cameras(photos: list[Prepared], *_: object) -> SparseModel:
        given.extend(photos)
        raise InputError("no cameras")

    monkeypatch.setattr(take, "find_cameras", find_cameras)
    with pytest.raises(InputError, match="no cameras"):
        capture_photos(tmp_path / "a.avi", tmp_path / "out", CaptureSettings(frames=9))
    assert 8 <= len(given) <= 9
    assert len({photo.lens for photo in given}) == 1
    assert [photo.name for photo in given] == sorted(path.name for path in (tmp_path / "out/frames").glob("*.jpg"))
    for photo in given:
        assert photo.file.read_bytes() == (tmp_path / "out/frames" / photo.name).read_bytes()
    inside = tmp_path / "out/frames/a.avi"
    shutil.copyfile(tmp_path / "a.avi", inside)
    with pytest.raises(InputError, match=r"a\.avi: must not lie in .*frames, which is overwritten"):
        capture_photos(inside, tmp_path / "out")


def test_the_number_of_video_frames_does_not_change_a_capture_of_photos(
    captured: tuple[Path, Path, CaptureResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    given, out, result = captured
    monkeypatch.setattr(take, "find_cameras", None)
    again = capture_photos(given, out, CaptureSettings(board=rendered.BOARD, frames=40))
    assert again.video is None
    assert [photo.name for photo in again.capture.photos] == [photo.name for photo in result.capture.photos]


def test_too_few_different_photos_are_refused_with_the_reason(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path
) -> None:
    (tmp_path / "given").mkdir()
    for number in range(4):
        shutil.copyfile(captured[0] / "photo00.png", tmp_path / f"given/{number}.png")
    reason = r"got 1; 1\.png: it is a copy of another photo; 2\.png: it is a copy of another photo; 3\.png: "
    with pytest.raises(InputError, match=rf"needs at least 3 usable photographs \({reason}"):
        capture_photos(tmp_path / "given", tmp_path / "out")


def test_empty_files_are_unreadable_and_no_copies_of_each_other(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path
) -> None:
    """An interrupted transfer leaves several of them; they count as photos that could not be used."""
    (tmp_path / "given").mkdir()
    shutil.copyfile(captured[0] / "photo00.png", tmp_path / "given/0.png")
    for number in (1, 2):
        (tmp_path / f"given/{number}.png").touch()
    with pytest.raises(InputError, match=r"got 1; 1\.png: it cannot be read \(.*\); 2\.png: it cannot be read \("):
        capture_photos(tmp_path / "given", tmp_path / "out")


def test_the_copy_that_a_setting_names_is_kept() -> None:
    hashes = {"a.png": "1", "a (1).png": "1", "b.png": "2", "b (1).png": "2", "c.png": "3", "c (1).png": "3"}
    settings = CaptureSettings(picks=("a (1).png:9,8",), scale_from=("b.png", "c (1).png:5,5", 0.1))
    assert take._find_copies(hashes, settings.named_photos) == ["a.png", "b (1).png", "c.png"]
