"""Annotations of COCO files in pixels: parts of objects, run lengths, and boxes without masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsplat.detector.labelled_sets.coco_annotations import is_fraction, read_annotation
from mitsplat.detector.labelled_sets.labelled_set import LabelledObject
from mitsplat.errors import InputError
from mitsplat.images.masks import decode_rle

WIDTH, HEIGHT = 70, 40


def read(**annotation: Any) -> LabelledObject:
    return read_annotation({"id": 7, **annotation}, 0, (WIDTH, HEIGHT), Path("a.json"))


def test_all_polygons_of_an_object_are_its_mask() -> None:
    """Polygons at the edges of pixels fill these pixels."""
    parts = [[10, 10, 20, 10, 20, 20, 10, 20], [40, 10, 60, 10, 60, 15, 40, 15]]
    found = read(bbox=[10, 10, 50, 10], segmentation=parts)
    expected = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    expected[10:20, 10:20] = expected[10:15, 40:60] = 1
    assert found.rle is not None and found.box == (10, 10, 60, 20)
    np.testing.assert_array_equal(decode_rle(found.rle), expected)


def test_run_lengths_go_down_the_columns() -> None:
    """The first run is background."""
    counts = [3 * HEIGHT + 5, 4, HEIGHT - 4, 4, HEIGHT * (WIDTH - 4) - 9]
    found = read(bbox=[3, 5, 2, 4], segmentation={"size": [HEIGHT, WIDTH], "counts": counts}, iscrowd=1)
    expected = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    expected[5:9, 3:5] = 1
    assert found.rle is not None and found.crowd
    np.testing.assert_array_equal(decode_rle(found.rle), expected)


@pytest.mark.parametrize(
    ("counts", "reason"),
    [
        ([400, -300, 200, HEIGHT * WIDTH - 300], r"run lengths must be of 40 x 70 px, 2800 \(got 2800\)"),
        ([HEIGHT * WIDTH], "segmentation must cover a pixel"),
    ],
)
def test_run_lengths_without_a_mask_are_refused(counts: list[int], reason: str) -> None:
    with pytest.raises(InputError, match=f"annotation 7: {reason}"):
        read(bbox=[3, 5, 2, 4], segmentation={"size": [HEIGHT, WIDTH], "counts": counts})


@pytest.mark.parametrize(
    ("bbox", "area"),
    [([0, 0, 30, 20], 600), ([10, 5, 40, 35], 1400), ([10, 5, 40, 35], 700)],
    ids=["at the origin", "of the box", "of an object"],
)
def test_boxes_alone_may_state_their_area_or_that_of_their_object(bbox: list[int], area: int) -> None:
    x, y, width, height = bbox
    assert read(bbox=bbox, area=area).box == (x, y, x + width, y + height)


def test_a_box_of_the_whole_image_in_fractions_is_a_fraction() -> None:
    assert is_fraction([0, 0, 1, 1]) and not is_fraction([0, 0, 2, 1])
