"""Crops of photos around the object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsplat.capture.capture import Photo
from mitsplat.fit.depth_priors import crop_map
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.fit.trainer import _training_view
from mitsplat.fit.windows import object_windows
from mitsplat.geometry.camera import Camera

BOXES = {"left": (0, 20, 30, 50), "middle": (70, 40, 110, 60), "large": (60, 10, 120, 74)}


@pytest.fixture
def photos(tmp_path: Path) -> list[Photo]:
    """Write photos of 200x100 px with boxes x0, y0, x1, y1 as masks, and one with an empty mask."""
    rng, made = np.random.default_rng(2), []
    camera = Camera.look_at((2, 0, 1), (0, 0, 0), width=200, height=100, fov_x=50)
    camera = replace(camera, distortion=(0.05, -0.01, 0.001, 0.0))
    for name, box in [*BOXES.items(), ("empty", (0, 0, 0, 0))]:
        file, mask = tmp_path / f"{name}.png", tmp_path / f"{name}_mask.png"
        Image.fromarray(rng.integers(0, 256, (100, 200, 3), dtype=np.uint8)).save(file)
        shown = np.zeros((100, 200), np.uint8)
        shown[box[1] : box[3], box[0] : box[2]] = 255
        Image.fromarray(shown).save(mask)
        made.append(Photo(name, file, camera, mask))
    return made


def test_windows_contain_the_object_and_have_the_same_size(photos: list[Photo]) -> None:
    windows = object_windows(photos)
    assert windows[-1] is None
    for window, (x0, y0, x1, y1) in zip(windows, BOXES.values(), strict=False):
        assert window is not None
        left, top, width, height = window
        assert (width, height) == (72, 77)  # the largest box and a tenth of its size on each side
        assert 0 <= left <= x0 and x1 <= left + width <= 200 and 0 <= top <= y0 and y1 <= top + height <= 100
    Image.fromarray(np.full((100, 200), 255, np.uint8)).save(photos[0].mask or "")
    assert object_windows(photos) == [None] * 4  # one object fills its photo, and all windows have the same size


def test_a_window_has_the_pixels_of_the_photo(photos: list[Photo]) -> None:
    photo, window = photos[1], (50, 20, 100, 60)
    whole, mask, _ = photo.read()
    part, cut, _ = photo.read(window=window)
    np.testing.assert_array_equal(part, whole[20:80, 50:150])
    assert mask is not None and cut is not None
    np.testing.assert_array_equal(cut, mask[20:80, 50:150])
    half, *_ = photo.read(0.5, window)
    np.testing.assert_allclose(half, part.reshape(30, 2, 50, 2, 3).mean(axis=(1, 3)), atol=1e-6)
    points = np.random.default_rng(3).uniform(-0.3, 0.3, (20, 3))
    pixels = photo.camera.project(points)[0]
    np.testing.assert_allclose(photo.camera.cropped(*window).project(points)[0], pixels - (50, 20), atol=1e-9)


def test_a_window_is_scaled_to_the_size_of_the_fit(photos: list[Photo]) -> None:
    depth = np.arange(20_000, dtype=np.float32).reshape(100, 200)
    view = _training_view(photos[1], FitSettings(max_size=80), depth, (50, 20, 100, 60))
    assert (view.camera.width, view.camera.height, view.half.camera.width) == (80, 48, 40)
    assert view.camera.fx == pytest.approx(0.8 * photos[1].camera.fx)
    assert view.inverse_depth is not None and view.inverse_depth.shape == (48, 80)
    small = depth[::2, ::2]  # half the resolution of the photo
    np.testing.assert_array_equal(crop_map(small, photos[1].camera, (50, 20, 100, 60))[::2, ::2], small[10:40, 25:75])
    whole = _training_view(photos[1], FitSettings(max_size=80))
    assert (whole.camera.width, whole.camera.height) == (80, 40)
