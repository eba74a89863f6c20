"""Run-length encoding, windows and overlap of masks."""

import warnings

import numpy as np
from pycocotools import mask as coco_mask

from mitsplat.images.masks import Silhouette, decode_rle, iou


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
