"""Sequential matching: photos in the order of the numbers in their names, as COLMAP matches them with padded names."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

zlib.compress(b"before pycolmap")
pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")

from mitsplat.capture.sfm_worker import extract, match, numbers_in  # noqa: E402

COUNT = 30


def test_names_are_sorted_by_their_numbers() -> None:
    names = ["b2.jpg", "b10.jpg", "a.jpg", "b1_12.jpg", "b1_2.jpg", "7.jpg", "b01.jpg"]
    assert sorted(names, key=numbers_in) == ["7.jpg", "a.jpg", "b01.jpg", "b1_2.jpg", "b1_12.jpg", "b2.jpg", "b10.jpg"]


def pairs_of(folder: Path, name: str) -> set[tuple[int, int]]:
    """Match photos of a camera that moves over a texture, and return the pairs that COLMAP tried, as numbers."""
    texture = cv2.resize(np.random.default_rng(0).integers(0, 255, (40, 120, 3), dtype=np.uint8), (960, 320))
    (folder / "images").mkdir(parents=True)
    names = [name.format(number) for number in range(1, COUNT + 1)]
    for number, one in enumerate(names):
        cv2.imwrite(str(folder / "images" / one), texture[60:220, 20 * number : 20 * number + 200])
    job = {"groups": [names], "features": 500, "first_octave": 0, "matching": "sequential", "camera_model": "PINHOLE"}
    extract(job, folder / "images", folder / "database.db", folder)
    match(job, folder / "database.db", folder)
    with pycolmap.Database.open(folder / "database.db") as opened:
        by_id = {image.image_id: names.index(image.name) for image in opened.read_all_images()}
        tried, _ = opened.read_two_view_geometries()
    pairs = (pycolmap.pair_id_to_image_pair(one) for one in tried)
    return {(min(ends), max(ends)) for ends in ((by_id[a], by_id[b]) for a, b in pairs)}


def test_photos_without_leading_zeros_are_matched_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """COLMAP sorts by letters: frame10 comes after frame1, and frame9 is not compared with frame10."""
    expected = pairs_of(tmp_path / "padded", "frame{:03d}.png")
    assert (8, 9) in expected
    assert pairs_of(tmp_path / "plain", "frame{}.png") == expected
