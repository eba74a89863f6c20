"""What is wrong with photographs, measured on photographs of which that is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mitsplat.camera import Camera
from mitsplat.reconstruct.causes import blurred_photos, missing_views, views_from
from mitsplat.reconstruct.evaluation import Thresholds
from tests.reconstruct.test_reconstruct import GOOD


def ring(height, turns):
    """Unit directions at a height above the horizon [degrees]."""
    turns = np.radians(turns)
    flat = np.stack([np.cos(turns), np.sin(turns), np.full(len(turns), np.tan(np.radians(height)))], axis=1)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


ALL_AROUND = np.arange(5, 360, 15)


def test_views_from_all_heights_and_sides_leave_nothing_to_say():
    assert missing_views(np.concatenate([ring(h, ALL_AROUND) for h in (10, 30)] + [ring(60, [0])])) == []


def test_a_height_that_nobody_photographed_from_is_named():
    assert missing_views(np.concatenate([ring(30, ALL_AROUND), ring(70, ALL_AROUND)])) == ["0 to 20 degrees above it"]
    assert missing_views(np.concatenate([ring(10, ALL_AROUND), ring(30, ALL_AROUND)])) == ["45 to 90 degrees above it"]


@pytest.mark.parametrize(("first", "last", "words"), [(100, 200, "120 to 180"), (300, 420, "300 to 60")])
def test_a_side_that_nobody_photographed_is_named_across_the_north_too(first, last, words):
    there = [turn for turn in ALL_AROUND if not first <= turn < last and not first <= turn + 360 < last]
    low = ring(10, there)
    found = missing_views(np.concatenate([low, ring(30, ALL_AROUND), ring(60, [0])]))
    if last - first < 110:  # two whole sectors are a step that people leave
        assert found == []
    else:
        assert found == [f"0 to 20 degrees above it, {words} degrees around it"]


def test_directions_are_those_from_what_the_cameras_look_at():
    offsets = 0.5 * np.concatenate([ring(20, ALL_AROUND), ring(50, ALL_AROUND)])
    middle = np.array([0.3, -0.2, 0.1])
    cameras = [Camera.look_at(middle + o, middle, width=8, height=8, fov_x=40) for o in offsets]
    np.testing.assert_allclose(views_from(cameras), offsets, atol=1e-9)


def test_blurred_photos_are_named_the_worst_first_and_no_smooth_side_of_the_object():
    rng = np.random.default_rng(0)
    pictures = []
    for number in range(10):
        noise = cv2.GaussianBlur(rng.uniform(size=(120, 160, 3)).astype(np.float32), (0, 0), 1.0)
        if number == 2:
            noise = 0.5 + 0.02 * (noise - 0.5)  # of little contrast, but sharp
        if number in (4, 7):
            noise = cv2.GaussianBlur(noise, (0, 0), 2.0 if number == 4 else 4.0)
        mask = np.zeros((120, 160), dtype=np.float32)
        mask[20:100, 30:130] = 1
        pictures.append((Camera.look_at((1, 0, 0), (0, 0, 0), width=160, height=120, fov_x=40), noise, mask))
    assert blurred_photos([f"{n}.jpg" for n in range(10)], pictures) == ["7.jpg", "4.jpg"]
    blank = [(camera, np.full_like(rgb, 0.5), mask) for camera, rgb, mask in pictures]
    assert blurred_photos([f"{n}.jpg" for n in range(10)], blank) == []


def test_a_miss_names_what_was_measured_before_what_helps():
    found = replace(GOOD, psnr=20.0, causes={"psnr": "2 of 9 photos are blurred (a.jpg, b.jpg)", "mesh_iou": "unused"})
    (sentence,) = found.misses(Thresholds())
    assert "is wanted): 2 of 9 photos are blurred (a.jpg, b.jpg); use even light" in sentence
