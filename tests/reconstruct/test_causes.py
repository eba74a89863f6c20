"""Diagnosis of capture faults on photographs with known faults."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mitsplat.capture.capture import Capture, Photo
from mitsplat.geometry.camera import Camera
from mitsplat.reconstruct.causes import blurred_photos, find_causes, missing_views, views_from
from tests.reconstruct.test_reconstruct import GOOD


def ring(height, turns):
    """Return unit directions at an elevation above the horizon [degrees]."""
    turns = np.radians(turns)
    flat = np.stack([np.cos(turns), np.sin(turns), np.full(len(turns), np.tan(np.radians(height)))], axis=1)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


ALL_AROUND = np.arange(5, 360, 15)


def test_views_from_all_heights_and_sides_give_no_advice():
    for above in (ring(60, [0]), np.array([[0.0, 0, 1]])):
        assert missing_views(np.concatenate([*(ring(h, ALL_AROUND) for h in (10, 30)), above])) == []


def test_a_missing_height_of_views_is_named():
    assert missing_views(np.concatenate([ring(30, ALL_AROUND), ring(70, ALL_AROUND)])) == [
        "0 to 20 degrees above the object"
    ]
    assert missing_views(np.concatenate([ring(10, ALL_AROUND), ring(30, ALL_AROUND)])) == [
        "45 to 90 degrees above the object"
    ]


@pytest.mark.parametrize(("first", "last", "words"), [(100, 200, "120 to 180"), (300, 420, "300 to 60")])
def test_a_missing_side_of_views_is_named(first, last, words):
    there = [turn for turn in ALL_AROUND if not first <= turn < last and not first <= turn + 360 < last]
    low = ring(10, there)
    found = missing_views(np.concatenate([low, ring(30, ALL_AROUND), ring(60, [0])]))
    if last - first < 110:  # a gap of two whole sectors is a common step between photos
        assert found == []
    else:
        assert found == [f"0 to 20 degrees above the object, {words} degrees around the object"]


def test_view_directions_start_at_the_focus_of_the_cameras():
    offsets = 0.5 * np.concatenate([ring(20, ALL_AROUND), ring(50, ALL_AROUND)])
    middle = np.array([0.3, -0.2, 0.1])
    cameras = [Camera.look_at(middle + o, middle, width=8, height=8, fov_x=40) for o in offsets]
    np.testing.assert_allclose(views_from(cameras), offsets, atol=1e-9)


def test_blurred_photos_are_named_and_smooth_objects_are_not():
    rng = np.random.default_rng(0)
    pictures = []
    for number in range(10):
        noise = cv2.GaussianBlur(rng.uniform(size=(120, 160, 3)).astype(np.float32), (0, 0), 1.0)
        if number == 2:
            noise = 0.5 + 0.02 * (noise - 0.5)  # low contrast, but sharp
        if number in (4, 7):
            noise = cv2.GaussianBlur(noise, (0, 0), 2.0 if number == 4 else 4.0)
        mask = np.zeros((120, 160), dtype=np.float32)
        mask[20:100, 30:130] = 1
        pictures.append((Camera.look_at((1, 0, 0), (0, 0, 0), width=160, height=120, fov_x=40), noise, mask))
    assert blurred_photos([f"{n}.jpg" for n in range(10)], pictures) == ["7.jpg", "4.jpg"]
    blank = [(camera, np.full_like(rgb, 0.5), mask) for camera, rgb, mask in pictures]
    assert blurred_photos([f"{n}.jpg" for n in range(10)], blank) == []


def test_a_missed_threshold_names_measured_causes_before_advice():
    found = replace(GOOD, psnr=20.0, causes={"psnr": "2 of 9 photos are blurred (a.jpg, b.jpg)", "mesh_iou": "unused"})
    (sentence,) = found.misses()
    assert "is required): 2 of 9 photos are blurred (a.jpg, b.jpg); use even light" in sentence


def dotted(points, masked):
    """Return a capture of points on a table that all photos observe, and images whose masks cover some of them."""
    photos, pictures = [], []
    for number, offset in enumerate(np.concatenate([ring(h, ALL_AROUND) for h in (10, 30, 60)])):
        camera = Camera.look_at(offset, (0, 0, 0.05), width=160, height=120, fov_x=50)
        photos.append(Photo(f"{number:02}.png", None, camera, seen=np.arange(len(points), dtype=np.int32)))
        mask = np.zeros((120, 160), np.float32)
        x, y = camera.project(points[masked])[0].astype(int).T
        mask[y, x] = 1
        pictures.append((camera, np.random.default_rng(number).uniform(size=(120, 160, 3)).astype(np.float32), mask))
    return Capture(tuple(photos), points, np.zeros(points.shape, np.uint8), up="z", table=True), pictures


def test_masks_that_include_the_support_are_reported_with_advice():
    rng = np.random.default_rng(2)
    body, cloth = (
        rng.uniform((-0.1, -0.1, 0.01), (0.1, 0.1, 0.1), (300, 3)),
        rng.uniform(-0.15, 0.15, (200, 3)) * (1, 1, 0),
    )
    points = np.concatenate([body, cloth])
    assert find_causes(*dotted(points, np.arange(500) < 300)) == {}
    found = find_causes(*dotted(points, np.arange(500) < 500))
    told = "40% of the points inside the masks lie in the support surface"
    assert all(found[name].startswith(told) for name in ("splat_iou", "mesh_iou", "surface", "lost"))
    (miss,) = replace(GOOD, lost=0.2, causes=found).misses()
    assert "photograph the object on another surface, or pick it; check for parts of the object" in miss


def test_an_object_without_texture_is_reported():
    rng = np.random.default_rng(2)
    body, cloth = (
        rng.uniform((-0.1, -0.1, 0.01), (0.1, 0.1, 0.1), (30, 3)),
        rng.uniform(-0.15, 0.15, (200, 3)) * (1, 1, 0),
    )
    found = find_causes(*dotted(np.concatenate([body, cloth]), np.arange(230) < 30))
    assert set(found) == {"psnr", "mesh_iou", "offset", "surface", "watertight"}
    assert found["psnr"].startswith("photos share only 30 points on the object")


def test_a_capture_on_a_table_without_points_has_no_causes():
    """Poses of another program may come without points."""
    assert find_causes(*dotted(np.zeros((0, 3)), np.zeros(0, dtype=bool))) == {}
