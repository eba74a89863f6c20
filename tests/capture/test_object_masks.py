"""Object masks of photos: detection, and correction by the masks of other photos."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.geometric_masks import agreed_masks, geometric_masks, object_masks, object_points
from mitsplat.capture.isolation import ChosenObject
from mitsplat.capture.pipeline.capture_pipeline import _reject_occluded
from mitsplat.capture.pipeline.capture_result import CaptureResult
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import iou
from tests import rendered


def overlap(mask: np.ndarray, true: Camera) -> float:
    """Compute the IoU of a mask with the box rendered by its true camera."""
    corners = rendered.BOX * (np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0, 1]), axis=-1).reshape(-1, 3))
    hull = cv2.convexHull(true.project(corners)[0].astype(np.float32))
    outline = np.zeros(rendered.SIZE[::-1], dtype=np.uint8)
    cv2.fillConvexPoly(outline, np.rint((hull - 0.5) * 16).astype(np.int32), 1, shift=4)
    return float(np.sum(mask & (outline > 0)) / np.sum(mask | (outline > 0)))


def test_masks_of_a_rendered_object_agree_with_the_truth(
    photos: tuple[Path, dict[str, Camera]], captured: tuple[Path, Path, CaptureResult]
) -> None:
    overlaps = []
    for photo in captured[2].capture.photos:
        alpha = photo.read().mask
        assert alpha is not None
        overlaps.append(overlap(alpha > 0.5, photos[1][photo.name]))
    assert np.median(overlaps) > 0.97
    assert min(overlaps) > 0.95


def test_masks_are_corrected_by_those_of_other_photos(
    photos: tuple[Path, dict[str, Camera]], captured: tuple[Path, Path, CaptureResult], tmp_path: Path
) -> None:
    """A mask that extends over the table and a rejected photo without a mask both get a correct mask."""
    capture = captured[2].capture
    spilt = np.zeros(rendered.SIZE[::-1], dtype=np.uint8)
    spilt[60:330, 90:400] = 255
    Image.fromarray(spilt).save(tmp_path / "spilt.png")
    assert overlap(spilt > 0, photos[1][capture.photos[4].name]) < 0.5
    wrong = [replace(photo, mask=tmp_path / "spilt.png") if k == 4 else photo for k, photo in enumerate(capture.photos)]
    del wrong[9]
    make = agreed_masks(replace(capture, photos=tuple(wrong)), object_points(capture))
    for number in (4, 9):
        photo = capture.photos[number]
        assert overlap(make(replace(photo, mask=None)), photos[1][photo.name]) > 0.95


def test_photos_with_an_occluded_object_are_omitted() -> None:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(400, 3))
    ball *= 0.04 / np.linalg.norm(ball, axis=1, keepdims=True)
    photos = tuple(
        Photo(f"{turn:03}.jpg", Path("none.jpg"), Camera.look_at(eye, (0, 0, 0), width=320, height=240, fov_x=40))
        for turn in range(0, 360, 45)
        for eye in [(0.4 * np.cos(np.radians(turn)), 0.4 * np.sin(np.radians(turn)), 0.1)]
    )
    capture = Capture(photos, np.zeros((0, 3)), np.zeros((0, 3)), rejected={"blurred.jpg": "it is blurred"})
    found, hidden = _reject_occluded(capture, ChosenObject(ball, ball, (ball + np.array([0.12, 0, 0]),)))
    assert [photo.name for photo in found.photos] == [f"{turn:03}.jpg" for turn in range(45, 360, 45)]
    assert not hidden and found.rejected.keys() == {"blurred.jpg", "000.jpg"}
    assert re.fullmatch(
        r"another object is in front of the object and may occlude \d+% of it", found.rejected["000.jpg"]
    )
    aside = 0.75 * ball + np.array([0.12, 0.05, 0.03])
    found, hidden = _reject_occluded(capture, ChosenObject(ball, ball, (aside,)))
    assert len(found.photos) == 8 and hidden.keys() == {"000.jpg", "045.jpg"}
    pixels, _ = photos[0].camera.project(aside)
    x, y = pixels[np.linalg.norm(pixels - (160, 120), axis=1) < 40].astype(int).T  # in front of the object
    assert len(x) > 20 and hidden["000.jpg"][y, x].all() and hidden["000.jpg"].mean() < 0.2


def test_masks_are_transparent_where_the_object_may_be_hidden(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path
) -> None:
    capture = captured[2].capture
    whole = capture.photos[1].read_mask()[0]
    assert whole is not None and capture.photos[1].read_mask()[1] is None
    veil = np.zeros(whole.shape, dtype=bool)
    column = int(np.median(np.nonzero(whole)[1]))
    veil[:, column - 5 : column + 15] = True  # across the middle, so that both sides remain
    points = object_points(capture)
    name = capture.photos[1].name
    capture = replace(capture, photos=capture.photos[:4])
    found = object_masks(capture, points, points[points[:, 2] > 0], tmp_path, hidden={name: veil})
    saved = Capture.load(found.save(tmp_path / "saved") and tmp_path / "saved")
    assert len(saved.photos) == len(capture.photos)
    assert [photo.name for photo in saved.photos if photo.read_mask()[1] is not None] == [name]
    photo = next(photo for photo in saved.photos if photo.name == name)
    mask, hidden = photo.read_mask()[0], photo.read_mask()[1]
    assert mask is not None and hidden is not None
    np.testing.assert_array_equal(hidden, veil)
    assert not mask[veil].any()
    assert iou((mask >= 0.5) & ~veil, (whole >= 0.5) & ~veil) > 0.95
    half = photo.read_mask(0.5, (column - 40, 0, 80, 80))[1]
    assert half is not None and half.shape == (40, 40) and half[:, 20:25].all() and not half[:, :16].any()


def test_a_capture_without_an_object_is_refused(captured: tuple[Path, Path, CaptureResult]) -> None:
    capture = captured[2].capture
    with pytest.raises(InputError, match="no object was found above the table"):
        object_points(replace(capture, points=capture.points * (1, 1, 0)))
    behind = geometric_masks(np.array([[0.0, 0, 50], [0.1, 0, 50], [0, 0.1, 50]]))
    assert not behind(capture.photos[1]).any()


def test_a_point_beside_the_camera_changes_no_mask(captured: tuple[Path, Path, CaptureResult]) -> None:
    """Its projection exceeds the range of integer pixels."""
    capture = captured[2].capture
    photo, points = capture.photos[1], object_points(capture)
    right, _, forward, centre = photo.camera.world_from_camera[:3].T
    beside = centre + right + 1e-12 * forward
    assert np.nanmax(np.abs(photo.camera.project(beside)[0])) > 2**31
    mask = geometric_masks(points)(photo)
    assert mask.any()
    np.testing.assert_array_equal(geometric_masks(np.concatenate([points, beside[None]]))(photo), mask)
