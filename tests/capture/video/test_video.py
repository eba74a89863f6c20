"""Frame selection from drawn videos with known displacement and blur."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from mitsplat.capture.video import ChosenFrames, choose_frames, extraction, video_worker
from mitsplat.capture.video.frame_selection import STEP, FrameMeasure, choose
from mitsplat.capture.video.motion import MotionClock, MotionPosition
from mitsplat.errors import InputError

SIZE = (320, 240)
RATE = 30.0


@cache
def plane(seed: int = 0, size: tuple[int, int] = (360, 2400)) -> np.ndarray:
    """Draw a texture of several scales, with contrast that falls from left to right."""
    rng, whole = np.random.default_rng(seed), np.zeros(size)
    for scale in (2, 5, 12, 30):
        noise = rng.normal(size=(size[0] // scale + 1, size[1] // scale + 1))
        whole += cv2.resize(noise, size[::-1], interpolation=cv2.INTER_CUBIC)
    fade = np.linspace(1, 0.25, size[1])
    return np.clip(128 + 45 * whole * fade, 0, 255).astype(np.uint8)


def seen(texture: np.ndarray, x: float, y: float = 40.0) -> np.ndarray:
    """Return the part of a texture whose upper left corner lies at x, y [px], BGR."""
    move = np.float32([[1, 0, -x], [0, 1, -y]])
    return cv2.cvtColor(cv2.warpAffine(texture, move, SIZE), cv2.COLOR_GRAY2BGR)


def smeared(picture: np.ndarray, length: int = 13) -> np.ndarray:
    return cv2.filter2D(picture, -1, np.full((1, length), 1 / length))


def write(file: Path, pictures: Sequence[np.ndarray], code: str = "mp4v") -> Path:
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), RATE, (width, height))
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return file


def places() -> np.ndarray:
    """Return positions [px] of a camera that starts slowly, stops for a second, and continues at triple speed."""
    slow, fast = np.arange(120) * 2.0, np.arange(1, 91) * 6.0
    return np.concatenate([slow, np.full(30, slow[-1]), slow[-1] + fast])


BLURRED = {number for start in (20, 62, 101) for number in range(start, start + 5)} | {
    160,
    171,
    200,
}  # for 2 of them, all frames of a step


@pytest.fixture(scope="module")
def pan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("pan") / "pan.mp4", pictures(places()))


def pictures(way: np.ndarray) -> list[np.ndarray]:
    texture = plane()
    return [smeared(seen(texture, x)) if number in BLURRED else seen(texture, x) for number, x in enumerate(way)]


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the first three seconds of the video, for tests that do not depend on its length."""
    return write(tmp_path_factory.mktemp("start") / "start.mp4", pictures(places()[:90]))


@pytest.fixture(scope="module")
def few(start: Path, tmp_path_factory: pytest.TempPathFactory) -> ChosenFrames:
    """Choose at most eight frames of the first three seconds."""
    return choose_frames(start, tmp_path_factory.mktemp("few") / "frames", most=8, least=3)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Choose frames in this process, because the start of a child process takes longer than a short video."""

    def run_worker(video: Path, folder: Path, most: int, least: int, progress: object) -> dict[str, Any]:
        messages: list[dict[str, Any]] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(video_worker, "_send", lambda **message: messages.append(message))
            video_worker.main(video, folder, most, least)
        if "error" in messages[-1]:
            raise InputError(messages[-1]["error"])
        return dict(json.loads(json.dumps(messages[-1]["found"])))

    monkeypatch.setattr(extraction, "_run_worker", run_worker)


def numbers(chosen: ChosenFrames) -> list[int]:
    """Return the frame numbers in the video by the names of the chosen frames."""
    times = [int(n[:2]) * 60 + int(n[3:5]) + int(n[6:9]) / 1000 for n in chosen.names]
    return [round(time * RATE) for time in times]


def test_chosen_frames_are_sharp_and_evenly_spaced_in_displacement(pan: Path, tmp_path: Path) -> None:
    chosen = choose_frames(pan, tmp_path / "frames", most=150, least=3)
    x = places()
    length = (x[-1] - x[0]) / SIZE[0]
    assert chosen.moved == pytest.approx(length, rel=0.02)
    assert (chosen.read, chosen.seconds, chosen.cuts) == (len(x), pytest.approx((len(x) - 1) / RATE), ())
    taken = numbers(chosen)
    assert len(taken) == 1 + int(chosen.moved / STEP)
    assert not BLURRED & set(taken)
    steps = np.diff(x[taken]) / SIZE[0]
    # Each frame is in the middle half of its step. The fast part has two or three frames per step.
    assert steps.min() > 0.4 * STEP and steps.max() < 1.6 * STEP
    assert steps.mean() == pytest.approx(STEP, rel=0.05)
    assert sum(120 <= number < 149 for number in taken) <= 1  # while the camera stops
    texture = plane()
    for name, number in zip(chosen.names, taken, strict=True):
        with Image.open(chosen.folder / name) as picture:
            error = np.asarray(picture.convert("L")).astype(float) - seen(texture, x[number])[..., 0]
        assert np.sqrt(np.mean(error**2)) < 12  # video compression; the next frame differs by 20 or more


@pytest.mark.usefixtures("in_process")
def test_a_limit_of_frames_widens_their_spacing(pan: Path, tmp_path: Path) -> None:
    few = choose_frames(pan, tmp_path / "frames", most=8, least=3)
    assert 7 <= len(few.names) <= 8
    steps = np.diff(places()[numbers(few)])
    assert steps.max() < 3.5 * steps.min()
    assert not BLURRED & set(numbers(few))


@pytest.mark.usefixtures("in_process")
def test_the_same_video_gives_the_same_frames_and_reuses_them(start: Path, few: ChosenFrames, tmp_path: Path) -> None:
    one = choose_frames(start, tmp_path / "one", most=8, least=3)
    data = {name: (one.folder / name).read_bytes() for name in one.names}
    assert data == {name: (few.folder / name).read_bytes() for name in few.names}
    before = {path: path.stat().st_mtime_ns for path in one.folder.iterdir()}
    assert choose_frames(start, tmp_path / "one", most=8, least=3) == one
    assert before == {path: path.stat().st_mtime_ns for path in one.folder.iterdir()}
    (one.folder / one.names[3]).unlink()  # as after an interruption
    assert choose_frames(start, tmp_path / "one", most=8, least=3) == one
    assert (one.folder / one.names[3]).read_bytes() == data[one.names[3]]
    other = choose_frames(start, tmp_path / "one", most=6, least=3)
    assert {path.name for path in one.folder.glob("*.jpg")} == set(other.names) != set(one.names)


@pytest.mark.usefixtures("in_process")
def test_cuts_are_detected_and_each_shot_has_frames(tmp_path: Path) -> None:
    first, second = plane(1), plane(2)
    pictures = [seen(first, 2.0 * k) for k in range(60)] + [seen(second, 600 - 2.0 * k) for k in range(60)]
    chosen = choose_frames(write(tmp_path / "cut.avi", pictures, "MJPG"), tmp_path / "frames", most=150, least=3)
    (cut,) = chosen.cuts
    assert 60 <= round(cut * RATE) <= 66
    assert chosen.warnings[0].startswith(f"{tmp_path / 'cut.avi'}: jumps at {cut:.1f} s, by a cut or a movement")
    taken = numbers(chosen)
    shots = [number for number in taken if number < 60], [number for number in taken if number >= 60]
    assert len(shots[0]) >= 7 and len(shots[1]) >= 6


@pytest.mark.usefixtures("in_process")
def test_a_blurred_frame_is_not_a_cut(tmp_path: Path) -> None:
    texture = plane(3)
    pictures = [
        cv2.GaussianBlur(seen(texture, 2.0 * k), (0, 0), 25) if 50 <= k < 54 else seen(texture, 2.0 * k)
        for k in range(120)
    ]
    chosen = choose_frames(write(tmp_path / "blur.avi", pictures, "MJPG"), tmp_path / "frames", most=150, least=3)
    assert chosen.cuts == ()
    assert chosen.moved == pytest.approx(238 / 320, rel=0.02)
    assert not set(range(50, 54)) & set(numbers(chosen))


def test_noise_and_shake_give_no_displacement() -> None:
    texture, rng, clock = plane(4), np.random.default_rng(0), MotionClock()
    for _ in range(150):
        x, y = rng.normal(0, 0.6, 2)
        noisy = seen(texture, 300 + x, 40 + y)[..., 0] + rng.normal(0, 4, SIZE[::-1])
        moved = clock.add(np.clip(noisy, 0, 255).astype(np.uint8))
    assert moved.tracked and moved.segment == 0
    assert moved.path < 0.01


@pytest.mark.usefixtures("in_process")
def test_frames_without_texture_are_neither_a_shot_nor_chosen(tmp_path: Path) -> None:
    """The video fades in from black. Frames without content start no new shot and are not chosen."""
    texture = plane(5)
    pictures = [np.zeros((SIZE[1], SIZE[0], 3), np.uint8)] * 20 + [seen(texture, 2.0 * k) for k in range(60)]
    chosen = choose_frames(write(tmp_path / "fade.mp4", pictures), tmp_path / "frames", most=150, least=3)
    assert chosen.cuts == ()
    assert min(numbers(chosen)) >= 20


def test_sharpness_does_not_depend_on_texture() -> None:
    """Every other frame of a step is blurred, while texture contrast grows tenfold from its start to its end."""
    measures = [
        FrameMeasure(k, k / 30, MotionPosition(0, 0.005 * k, tracked=True), (0.2 if k % 2 else 1.0) * 10 ** (k / 100))
        for k in range(101)
    ]
    frames = choose(measures, 150).frames
    assert len(frames) == 11
    assert all(frame.index % 2 == 0 for frame in frames)
    steps = np.diff([frame.moved.path for frame in frames])
    assert steps.min() > 0.5 * STEP and steps.max() < 1.5 * STEP


def test_the_sharp_frame_at_the_border_of_a_step_is_chosen() -> None:
    measures = [
        FrameMeasure(k, k / 30, MotionPosition(0, 0.005 * k, tracked=True), 1.0 if k % 10 == 1 else 0.1)
        for k in range(31)
    ]
    assert [frame.index for frame in choose(measures, 150).frames][:3] == [1, 11, 21]


def test_motion_counts_once_in_two_shots_and_frames_without_motion_are_left_out() -> None:
    """The path continues over both shots; frames between them are the sharpest but not tracked."""
    measures = [
        FrameMeasure(
            k, k / 30, MotionPosition(int(k > 54), 0.01 * k, tracked=not 50 <= k < 55), 9.0 if k >= 50 else 1.0
        )
        for k in range(101)
    ]
    choice = choose(measures, 150)
    assert choice.moved == pytest.approx(0.49 + 0.45)
    assert choice.cuts == (55 / 30,)
    assert not {frame.index for frame in choice.frames} & set(range(50, 55))


def turned_by(file: Path, degrees: int) -> Path:
    """Copy an MP4 with the rotation matrix that phones write for a rolled camera (ISO 14496-12, tkhd)."""
    data = bytearray(file.read_bytes())
    start = data.index(b"tkhd") + 4
    assert data[start] == 0  # version 0: the matrix is 40 bytes after version and flags
    a, b, c, d = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}[degrees]
    one = 1 << 16
    struct.pack_into(">9i", data, start + 40, a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    turned = file.with_name(f"turned{degrees}.mp4")
    turned.write_bytes(data)
    return turned


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_the_rotation_stated_by_a_video_is_applied(
    start: Path, few: ChosenFrames, tmp_path: Path, degrees: int
) -> None:
    turned = choose_frames(turned_by(start, degrees), tmp_path / "turned", most=8, least=3)
    with Image.open(turned.folder / turned.names[0]) as picture:
        shown = np.asarray(picture).astype(float)
    frame = seen(plane(), places()[numbers(turned)[0]])
    assert numbers(turned)[0] not in BLURRED
    expected = np.rot90(frame, -degrees // 90)
    assert shown.shape == expected.shape
    assert np.sqrt(np.mean((shown - expected) ** 2)) < 12
    assert turned.moved == pytest.approx(few.moved * (SIZE[0] / SIZE[1] if degrees != 180 else 1), rel=0.02)


def still(file: Path) -> Path:
    return write(file, [seen(plane(), 100.0)] * 60)


def short(file: Path) -> Path:
    return write(file, [seen(plane(), 0.4 * k) for k in range(60)])


def plain(file: Path) -> Path:
    return write(file, [np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)] * 30)


def text(file: Path) -> Path:
    file.write_text("no video")
    return file


def headless(file: Path) -> Path:
    """Write half of an MP4, which lacks the table of frames at the file's end."""
    data = write(file, [seen(plane(), 2.0 * k) for k in range(60)]).read_bytes()
    file.write_bytes(data[: len(data) // 2])
    return file


def torn(file: Path) -> Path:
    data = write(file.with_suffix(".avi"), [seen(plane(), 2.0 * k) for k in range(60)], "MJPG").read_bytes()
    file.write_bytes(data[: len(data) // 2])
    return file


def jumpy(file: Path) -> Path:
    return write(file, [seen(plane(10 + k // 8), 0) for k in range(80)])


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            text,
            r"must be a complete video that FFmpeg reads, such as .mp4, .mov or .avi \(got a file of 8 bytes that",
        ),
        (headless, r"must be a complete video that FFmpeg reads, .* that it cannot open\)"),
        (
            torn,
            r"must hold the 60 frames that its header states \(got \d\d, \d\.\d of 2\.0 s\): it is incomplete",
        ),
        (still, r"its picture must move by 15% of its width or more \(got 0\.\d% in 2\.0 s\): move around"),
        (plain, r"its picture must move by 15% of its width or more \(got 0\.0% in 1\.0 s\).*must have texture"),
        (short, r"must show at least 3 views that differ by 5% of the picture's width \(got 2 in 2\.0 s\)"),
        (jumpy, r"must have fewer cuts than frames to take \(got 9 cuts, .* for 6 frames\)"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_unusable_videos_are_refused_in_one_sentence(
    make, sentence: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if make in (still, plain, short, jumpy):  # FFmpeg decodes the others in a process of their own
        request.getfixturevalue("in_process")
    file = make(tmp_path / "clip.mp4")
    with pytest.raises(InputError, match=rf"clip\.mp4: {sentence}") as refused:
        choose_frames(file, tmp_path / "frames", most=6, least=3)
    assert "\n" not in str(refused.value)


def test_a_number_of_frames_out_of_range_is_refused() -> None:
    with pytest.raises(InputError, match=r"at least 3 frames must be taken of a video \(got 2\)"):
        choose_frames(Path("clip.mp4"), Path("frames"), most=2, least=3)


def test_a_crash_of_the_decoder_is_reported_in_one_sentence(
    pan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in = tmp_path / "python"
    stand_in.write_text("#!/bin/sh\nkill -SEGV $$\n")
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    with pytest.raises(InputError, match=r"pan\.mp4: must be a video that FFmpeg can decode \(got signal 11"):
        choose_frames(pan, tmp_path / "frames", most=6, least=3)


def test_playlists_of_other_files_are_refused(pan: Path, tmp_path: Path) -> None:
    for name, lines in {
        "list.m3u8": ["#EXTM3U", "#EXTINF:8,", "http://127.0.0.1:9/clip.ts", "#EXT-X-ENDLIST"],
        "list.ffconcat": ["ffconcat version 1.0", f"file '{pan}'"],
    }.items():
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        with pytest.raises(InputError, match=f"{name}: must "):
            choose_frames(tmp_path / name, tmp_path / "frames", most=6, least=3)


def test_the_video_worker_prints_one_json_object_per_line_only(pan: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "mitsplat.capture.video.video_worker",
        str(pan),
        str(tmp_path / "frames"),
        "6",
        "3",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ)
    messages = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.stderr == ""
    assert {key for message in messages for key in message} == {"progress", "found"}
    steps = [message["progress"] for message in messages[:-1]]
    assert steps[0] == [1, len(places()), "watching the video"]
    assert steps[len(places()) - 1][:2] == [len(places())] * 2
