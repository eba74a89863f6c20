"""Relative exposures of photos, compared with known values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.exposure import _observations, even_exposure, relative_gains
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb

COUNT, POINTS = 9, 120


def drawn(folder: Path, gains: np.ndarray) -> Capture:
    """Draw photos of coloured points. A third of the photos in sequence sees each point, a tenth of these in a random
    colour.
    """
    rng = np.random.default_rng(4)
    points, colours = rng.uniform(-1, 1, (POINTS, 3)), rng.uniform(0.05, 0.4, (POINTS, 3))
    photos = []
    for number in range(COUNT):
        camera = Camera.look_at((4, 0.3 * number, 1), (0, 0, 0), width=300, height=240, fov_x=40)
        seen = np.flatnonzero((np.arange(POINTS) - 13 * number) % POINTS < 50).astype(np.int32)
        linear = np.full((240, 300, 3), 0.2)
        for index in seen:
            x, y = np.floor(camera.project(points[[index]])[0][0]).astype(int)
            shown = rng.uniform(0.05, 0.9, 3) if rng.random() < 0.1 else colours[index] * gains[number]
            linear[y - 1 : y + 2, x - 1 : x + 2] = shown
        file = folder / f"{number}.png"
        Image.fromarray(np.rint(255 * np.clip(encode_srgb(linear), 0, 1)).astype(np.uint8)).save(file)
        photos.append(Photo(file.name, file, camera, seen=seen))
    return Capture(tuple(photos), points, np.zeros((POINTS, 3), np.uint8))


def test_gains_equalise_exposures_despite_gloss(tmp_path: Path) -> None:
    gains = np.exp(np.random.default_rng(1).normal(0, 0.15, (COUNT, 3)))
    found = relative_gains((capture := drawn(tmp_path, gains)).photos, capture.points)
    left = found * gains
    assert np.log(left).std(axis=0).max() < 0.02 < 0.06 < np.log(gains).std(axis=0).min()
    np.testing.assert_allclose(np.log(found).mean(axis=0), 0, atol=1e-9)
    evened = even_exposure(capture)
    saved = evened.save(tmp_path / "capture")
    again = Capture.load(tmp_path / "capture")
    for photo, before, gain in zip(again.photos, capture.photos, found, strict=True):
        assert photo.gain == pytest.approx(tuple(gain))
        wanted = encode_srgb(decode_srgb(before.read().rgb) * gain).clip(0, 1)
        np.testing.assert_allclose(photo.read().rgb, wanted, atol=1e-5)
    assert [photo.gain for photo in saved.photos] == [photo.gain for photo in again.photos]


def test_photos_of_equal_exposure_get_no_gains(tmp_path: Path) -> None:
    capture = drawn(tmp_path, np.ones((COUNT, 3)))
    assert even_exposure(capture) is capture
    capture.save(tmp_path / "capture")
    assert "gain" not in (tmp_path / "capture/capture.json").read_text()
    blind = replace(capture, photos=tuple(replace(photo, seen=photo.seen[:0]) for photo in capture.photos))
    assert even_exposure(blind) is blind


def test_exposures_that_differ_alike_in_all_channels_are_corrected(tmp_path: Path) -> None:
    """The gains are those of exposure times without a change of white balance."""
    gains = np.exp(np.linspace(-0.3, 0.3, COUNT))[:, None] * np.ones(3)
    evened = even_exposure(drawn(tmp_path, gains))
    found = np.array([photo.gain for photo in evened.photos])
    np.testing.assert_allclose(np.log(found * gains), 0, atol=0.03)


@pytest.mark.parametrize("gain", [4.0, 0.02])
def test_clipped_and_dark_colours_are_not_observed(tmp_path: Path, gain: float) -> None:
    """Bytes of 250 or more and of 5 or less are left out; those from 13 to 242 are used."""
    gains = np.ones((COUNT, 3))
    gains[4] = gain
    capture = drawn(tmp_path, gains)
    photo_of, point_of, shown = _observations(capture.photos, capture.points)
    observed = set(point_of[photo_of == 4].tolist())
    photo = capture.photos[4]
    inside, x, y = photo.camera.visible_pixels(capture.points[photo.seen])
    colours = np.asarray(Image.open(photo.file))[y, x]
    points = photo.seen[inside]
    wrong = ((colours >= 250) | (colours <= 5)).any(axis=1)
    right = ((colours >= 13) & (colours <= 242)).all(axis=1)
    assert wrong.sum() >= 3 and right.sum() >= 3
    assert not observed & set(points[wrong].tolist())
    assert observed >= set(points[right].tolist())
    place = {point: row for row, point in enumerate(points.tolist())}
    rows = [place[point] for point in point_of[photo_of == 4].tolist()]
    np.testing.assert_allclose(np.exp(shown[photo_of == 4]), decode_srgb(colours[rows] / 255), rtol=1e-3)


def test_photos_of_few_points_are_not_corrected(tmp_path: Path) -> None:
    """Of two bright photos, one observes 19 points and one 20 in reliable colours."""
    gains = np.ones((COUNT, 3))
    gains[[2, 6]] = 1.5
    capture = drawn(tmp_path, gains)
    photos = list(capture.photos)
    for number, count in ((2, 19), (6, 20)):
        photo = photos[number]
        inside, x, y = photo.camera.visible_pixels(capture.points[photo.seen])
        colours = photo.read().rgb[y, x]
        reliable = ((colours > 0.04) & (colours < 0.96)).all(axis=1)
        photos[number] = replace(photo, seen=photo.seen[inside][reliable][:count])
    found = np.log(relative_gains(photos, capture.points)).mean(axis=1)
    others = np.delete(found, [2, 6]).mean()
    assert found[6] - others == pytest.approx(-np.log(1.5), abs=0.05)
    assert abs(found[2] - others) < 0.1
