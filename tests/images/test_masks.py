"""Run-length encoding, windows, overlap, boundaries and parts of masks."""

import warnings

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask
from scipy.ndimage import binary_erosion
from scipy.spatial.distance import cdist

from mitsplat.images.masks import (
    Silhouette,
    border_of,
    boundary_f1,
    decode_rle,
    disc,
    fill_hull,
    iou,
    largest_part,
    without_fragments,
)


def test_a_code_is_decoded_where_every_warning_is_an_error():
    mask = np.asfortranarray(np.eye(5, 7, dtype=np.uint8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(decode_rle(coco_mask.encode(mask)), mask)


def test_a_window_shows_a_silhouette_at_its_place():
    mask = np.random.default_rng(0).random((7, 9)) > 0.6
    silhouette = Silhouette.cropped(mask, 20, -4)
    expected = np.zeros((12, 15), dtype=bool)
    expected[3:10, 2:11] = mask
    assert np.array_equal(silhouette.within((18, -7, 33, 5)), expected)


def test_iou_of_shifted_squares_and_of_empty_masks():
    one, other = np.zeros((2, 10, 10), dtype=bool)
    assert iou(one, other) == 1
    one[2:6, 2:6] = other[4:8, 4:8] = True
    assert iou(one, other) == 4 / 28


def test_a_silhouette_without_pixels_in_the_image_has_no_part_there():
    """The bounds of this L overlap the image, but its pixels do not."""
    mask = np.zeros((20, 20), dtype=bool)
    mask[:, :3] = mask[:3] = True
    silhouette = Silhouette.cropped(mask, -5, -5)
    assert silhouette.clipped(10, 12) is None
    assert not silhouette.image_mask(10, 12).any()


def blobs(seed):
    """Return two smooth random masks that overlap and touch the border."""
    noise = np.random.default_rng(seed).random((40, 60))
    one = cv2.GaussianBlur(noise, (0, 0), 3) > 0.5
    return one, np.roll(cv2.GaussianBlur(one.astype(float), (0, 0), 2) > 0.4, (3, 1), (0, 1))


@pytest.mark.parametrize("seed", range(3))
def test_boundary_f1_is_that_of_pixels_within_two_pixels(seed):
    masks = blobs(seed)
    one, other = (np.argwhere(mask & ~binary_erosion(mask, border_value=1)) for mask in masks)
    near = cdist(one, other) <= 2
    precision, recall = near.any(axis=1).mean(), near.any(axis=0).mean()
    assert 0.3 < precision < 0.95
    assert boundary_f1(*masks) == pytest.approx(2 * precision * recall / (precision + recall))
    assert boundary_f1(masks[0].T, masks[1].T) == boundary_f1(*masks)


def test_boundary_f1_of_masks_without_boundary():
    empty, full, part = np.zeros((9, 9), bool), np.ones((9, 9), bool), np.eye(9, dtype=bool)
    assert boundary_f1(empty, empty) == boundary_f1(full, full) == 1
    assert boundary_f1(empty, part) == boundary_f1(part, full) == 0
    assert boundary_f1(np.roll(part, 5, axis=1) & (np.tri(9).T > 0), part) == 0


@pytest.mark.parametrize("radius", [1, 2, 5, 12])
def test_a_disc_has_the_pixels_within_its_radius(radius):
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    np.testing.assert_array_equal(disc(radius), np.hypot(x, y) <= radius)


def test_a_hull_covers_the_pixels_of_its_corners():
    picture = np.zeros((9, 12), dtype=np.uint8)
    fill_hull(picture, np.array([[2.5, 3.5], [7.1, 3.9], [7.9, 6.5], [2.1, 6.0], [4.0, 5.0]]))
    expected = np.zeros_like(picture)
    expected[3:7, 2:8] = 1
    np.testing.assert_array_equal(picture, expected)


def test_the_border_has_all_sides_and_corners_twice():
    values, counts = np.unique(border_of(np.arange(20).reshape(4, 5)), return_counts=True)
    assert dict(zip(values.tolist(), counts.tolist(), strict=True)) == {
        **dict.fromkeys([1, 2, 3, 5, 9, 10, 14, 16, 17, 18], 1),
        **dict.fromkeys([0, 4, 15, 19], 2),
    }


def test_the_largest_part_includes_diagonal_neighbours():
    mask = np.zeros((8, 8), dtype=bool)
    mask[0, :3] = True
    mask[range(3, 8), range(3, 8)] = True
    np.testing.assert_array_equal(np.flatnonzero(largest_part(mask)), [27, 36, 45, 54, 63])
    assert not largest_part(np.zeros((4, 4), dtype=bool)).any()


@pytest.mark.parametrize(("least", "removed"), [(3, 0), (4, 1)])
def test_a_mask_that_is_one_fragment_is_removed(least, removed):
    mask = np.zeros((5, 5), dtype=bool)
    mask[2, 1:4] = True
    kept, count = without_fragments(mask, least)
    assert (int(kept.sum()), count) == (3 * (1 - removed), removed)
