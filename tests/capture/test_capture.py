"""Captures on disk: saving, loading and transforming."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsplat.capture.capture import Capture, Photo
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Build ten noise photos of 40x30 px, every other one with a mask."""
    rng = np.random.default_rng(3)
    folder = tmp_path / "given"
    folder.mkdir()
    photos = []
    for number in rng.permutation(10):
        file = folder / f"view {number}.png"
        Image.fromarray(rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)).save(file)
        mask = None
        if number % 2:
            mask = folder / f"mask{number}.png"
            Image.fromarray(np.uint8(255) * rng.integers(0, 2, (30, 40), dtype=np.uint8)).save(mask)
        camera = Camera.look_at(
            rng.normal(0, 1, 3) + np.float64([0, 0, 3]), (0, 0, 0), width=40, height=30, fov_x=50.123456789
        )
        camera = replace(camera, cx=20.25, fy=1 / 3 * 100, distortion=(0.1, -1e-9, 0.0, 1 / 7), near=0.02)
        if number == 2:
            camera = replace(camera, distortion=(0.01, -0.002, 1e-4, 0.0), lens="fisheye")
        photos.append(Photo(file.name, file, camera, mask, np.flatnonzero(rng.random(50) < 0.3).astype(np.int32)))
    return Capture(
        photos=tuple(photos),
        points=rng.normal(size=(50, 3)),
        colours=rng.integers(0, 256, (50, 3), dtype=np.uint8),
        units="metre",
        up="z",
        rejected={"blurred: 1.jpg": "it is blurred"},
        scale_error=1e-3 / 3,
        table=True,
    )


def test_a_capture_prints_on_one_line(capture: Capture) -> None:
    assert repr(capture) == f"Capture({len(capture.photos)} photos, 1 rejected, 50 points, metres)"


def test_a_saved_capture_is_loaded_unchanged(capture: Capture, tmp_path: Path) -> None:
    capture.save(tmp_path / "a")
    loaded = Capture.load(tmp_path / "a")
    assert loaded.photos[0].file == tmp_path / "a/images/view 0.png"
    loaded.save(tmp_path / "a")  # saved in place: no file is lost
    loaded = Capture.load(tmp_path / "a")
    np.testing.assert_array_equal(loaded.points, capture.points)
    np.testing.assert_array_equal(loaded.colours, capture.colours)
    for name in ("units", "up", "rejected", "scale_error", "table"):
        assert getattr(loaded, name) == getattr(capture, name)
    assert [photo.name for photo in loaded.photos] == [f"view {number}.png" for number in range(10)]
    for one, other in zip(loaded.photos, capture.photos, strict=True):
        a, b = asdict(one.camera), asdict(other.camera)
        np.testing.assert_array_equal(a.pop("world_from_camera"), b.pop("world_from_camera"))
        assert a == b
        np.testing.assert_array_equal(one.seen, other.seen)
        assert (one.mask is None) == (other.mask is None)
        for mine, theirs in zip(one.read(), other.read(), strict=True):
            np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("place", range(1, 16))
def test_an_interrupted_save_leaves_the_earlier_or_the_new_capture(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    """Images of one capture are never read with cameras of the other: 10 photos, 5 masks, points, capture.json."""
    out = tmp_path / "out"
    capture.save(out)
    other = capture.transformed(np.diag([2.0, 2.0, 2.0, 1.0]))
    move, left = Path.replace, iter(range(place))

    def stop(*args: Any) -> Any:
        if next(left, None) is None:
            raise KeyboardInterrupt
        return move(*args)

    monkeypatch.setattr(Path, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        replace(other, photos=tuple(replace(photo, file=capture.photos[0].file) for photo in other.photos)).save(out)
    with pytest.raises(InputError, match=r"without capture\.json"):
        Capture.load(out)


def test_every_eighth_photo_is_held_out(capture: Capture) -> None:
    assert [photo.name for photo in capture.held_out] == ["view 0.png", "view 8.png"]
    assert len(capture.training) == 8
    assert not set(capture.training) & set(capture.held_out)


def test_reduced_pictures_are_averages(capture: Capture) -> None:
    photo = capture.photos[1]
    whole, mask, _ = photo.read()
    half, alpha, _ = photo.read(0.5)
    assert whole.dtype == half.dtype == np.float32
    assert half.shape == (15, 20, 3)
    np.testing.assert_allclose(half, whole.reshape(15, 2, 20, 2, 3).mean(axis=(1, 3)), atol=1e-6)
    assert mask is not None
    assert alpha is not None
    np.testing.assert_allclose(alpha, mask.reshape(15, 2, 20, 2).mean(axis=(1, 3)), atol=1e-6)
    with pytest.raises(ValueError, match=r"scale must be in \(0, 1\] \(got 0\)"):
        photo.read(0)


def test_a_transformed_capture_keeps_the_pixels_of_its_points(capture: Capture) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = 2.5 * capture.photos[0].camera.world_from_camera[:3, :3]
    matrix[:3, 3] = (1, -2, 3)
    moved = capture.transformed(matrix)
    for before, after in zip(capture.photos, moved.photos, strict=True):
        pixels, depth = before.camera.project(capture.points)
        pixels_after, depth_after = after.camera.project(moved.points)
        np.testing.assert_allclose(depth_after, 2.5 * depth, atol=1e-9)
        np.testing.assert_allclose(pixels_after, pixels, rtol=1e-6, atol=1e-6)
        assert after.camera.near == pytest.approx(2.5 * before.camera.near)
    with pytest.raises(ValueError, match="scale uniformly"):
        capture.transformed(np.diag([1, 1, 2, 1]))


def edit(folder: Path, **changes: object) -> None:
    path = folder / "capture.json"
    data = json.loads(path.read_text())
    for keys, value in changes.items():
        *way, last = (int(key) if key.isdecimal() else key for key in keys.split("__"))
        place = data
        for key in way:
            place = place[key]
        place[last] = value
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"units": "foot"}, "units: must be 'metre' or 'unknown' (got \"foot\")"),
        ({"photos__3__camera__fx": -1.0}, "view 3.png: focal lengths must be finite and > 0"),
        ({"photos__3__camera__width": "wide"}, "photos[3].camera.width: must be a whole number"),
        ({"photos__3__camera__world_from_camera__0": [9.0, 0.0, 0.0, 0.0]}, "view 3.png: world_from_camera must be"),
        ({"photos__3__file": "../given/view 3.png"}, "(got ../given/view 3.png)"),
        ({"photos__3__mask": "masks/gone.png"}, "no such file (got masks/gone.png)"),
        ({"photos__3__name": "view 4.png"}, "names of photos must be unique (got view 4.png twice)"),
    ],
)
def test_a_damaged_capture_is_refused_in_one_sentence(
    capture: Capture, tmp_path: Path, changes: dict[str, object], sentence: str
) -> None:
    capture.save(tmp_path / "a")
    edit(tmp_path / "a", **changes)
    with pytest.raises(InputError) as raised:
        Capture.load(tmp_path / "a")
    assert sentence in str(raised.value)
    assert str(tmp_path / "a") in str(raised.value)


def test_missing_and_damaged_files_are_named(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must be the folder of a capture \(got a folder without capture\.json\)"):
        Capture.load(tmp_path)
    capture.save(tmp_path / "a")
    points = tmp_path / "a/points.npz"
    whole = points.read_bytes()
    points.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"points\.npz: not a capture's points"):
        Capture.load(tmp_path / "a")
    points.write_bytes(whole)
    loaded = Capture.load(tmp_path / "a")
    Image.new("RGB", (40, 31)).save(loaded.photos[0].file)
    with pytest.raises(InputError, match=r"view 0\.png: must have the size of its camera, 40x30 px \(got 40x31\)"):
        loaded.photos[0].read()
    loaded.photos[0].file.write_bytes(b"rubbish")
    with pytest.raises(InputError, match="not a readable image"):
        loaded.photos[0].read()


@pytest.mark.parametrize(
    "counts", [[-1, *[0] * 8, 1], [2**62, *[0] * 8, 2**62], [0.5] * 10], ids=["negative", "too many", "fractions"]
)
def test_counts_of_points_that_do_not_fit_the_file_are_refused(
    capture: Capture, tmp_path: Path, counts: list[float]
) -> None:
    capture.save(tmp_path / "a")
    points = tmp_path / "a/points.npz"
    with np.load(points) as stored:
        arrays = dict(stored)
    np.savez(points, **(arrays | {"seen": arrays["seen"][:0], "seen_counts": np.array(counts)}))
    with pytest.raises(InputError, match=r"points\.npz: must count points in whole numbers of 0 to 0"):
        Capture.load(tmp_path / "a")
