"""Run-length encoding of masks."""

import warnings

import numpy as np
from pycocotools import mask as coco_mask

from mitsplat.images.masks import decode_rle


def test_a_code_is_decoded_where_every_warning_is_an_error():
    mask = np.asfortranarray(np.eye(5, 7, dtype=np.uint8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(decode_rle(coco_mask.encode(mask)), mask)
