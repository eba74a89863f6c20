"""Relative exposures of photos, compared with known values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.exposure import even_exposure, relative_gains
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
