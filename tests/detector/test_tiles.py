"""Photographs cut into tiles: their pixels and labels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mitsplat.detector.labelled_sets.labelled_set import LabelledObject, LabelledSet, Sample
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.photo_tiles import cut_photographs
from mitsplat.errors import InputError
from mitsplat.labels.polygons import fill_polygon
from tests.detector.painted import HEIGHT, WIDTH, paint, write_coco, write_yolo


def test_tiles_show_the_photograph_and_its_labels(tmp_path: Path) -> None:
    photographs = read_set(write_coco(tmp_path / "photographs", 6, form="compressed", first=40), "all")
    cut = cut_photographs(photographs, 96, 64, tmp_path / "tiles")
    assert len(cut.samples) == 6 * 4 and cut.class_names == photographs.class_names
    for number in range(6):
        picture, shown = paint(40 + number)
        for sample, (top, left) in zip(
            cut.samples[4 * number : 4 * number + 4], ((0, 0), (0, 32), (21, 0), (21, 32)), strict=True
        ):
            assert (sample.width, sample.height) == (64, 43)
            window = np.s_[top : top + 43, left : left + 64]
            stored = np.asarray(cv2.imread(str(sample.path)), dtype=int)
            assert np.abs(stored - picture[window]).mean() < 3  # JPEG of noise
            expected = [(name, mask[window]) for name, mask in shown if mask[window].sum() >= max(0.15 * mask.sum(), 1)]
            assert [cut.class_names[one.class_index] for one in sample.instances] == [name for name, _ in expected]
            for instance, (_, mask) in zip(sample.instances, expected, strict=True):
                np.testing.assert_array_equal(fill_polygon(instance.outline_points(), 64, 43), mask)
                rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
                assert instance.box == (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)


def test_a_tile_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    """cv2.imwrite raises no error on a full disk."""
    photographs = read_set(write_coco(tmp_path / "photographs", 1), "all")
    (tmp_path / "tiles").mkdir()
    (tmp_path / "tiles/00000_21_0.jpg").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left on device"):
        cut_photographs(photographs, 96, 64, tmp_path / "tiles")


def test_boxes_are_cut_with_the_picture(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), np.zeros((100, 300, 3), dtype=np.uint8))
    boxes = [(10.0, 10.0, 40.0, 30.0), (80.0, 20.0, 130.0, 40.0), (195.0, 0.0, 205.0, 50.0)]
    sample = Sample(
        path, "photo.png", 300, 100, tuple(LabelledObject(0, box, crowd=not k) for k, box in enumerate(boxes)), ""
    )
    photographs = LabelledSet(tmp_path, "coco", "all", ("part",), (sample,))
    tiles = cut_photographs(photographs, 1920, 640, tmp_path / "tiles").samples
    assert [tile.path.name for tile in tiles][:4] == [f"00000_0_{left}.jpg" for left in (0, 67, 133, 200)]
    assert [one.box for one in tiles[0].instances] == [(10, 10, 40, 30), (80, 20, 100, 33)]
    assert [one.crowd for one in tiles[0].instances] == [True, False]
    assert [one.box for one in tiles[3].instances] == [(0, 0, 5, 33)]


def test_tiles_of_a_few_pixels_are_refused(tmp_path: Path) -> None:
    photographs = read_set(write_yolo(tmp_path / "photographs", {"train": 1}), "all")
    with pytest.raises(InputError, match=r"sides of at least 10 px \(got 6 x 4\): use a --real-size nearer"):
        cut_photographs(photographs, 960, 64, tmp_path / "tiles")


@pytest.mark.parametrize("longer", [97, 128, 200, 480])
def test_an_object_of_a_third_of_a_tile_is_complete_in_one_tile(tmp_path: Path, longer: int) -> None:
    photographs = read_set(write_yolo(tmp_path / "photographs", {"train": 1}), "all")
    tiles = cut_photographs(photographs, longer, 96, tmp_path / "tiles").samples
    corners = np.array([[int(part) for part in tile.path.stem.split("_")[1:]] for tile in tiles])
    for axis, side in ((0, HEIGHT), (1, WIDTH)):
        starts, tile = np.unique(corners[:, axis]), (tiles[0].height, tiles[0].width)[axis]
        assert starts[0] == 0 and starts[-1] + tile == side
        assert np.diff(starts).max() <= tile - np.floor(tile / 3)
