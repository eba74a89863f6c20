"""Sequential matching: photos in the order of the numbers in their names, as COLMAP matches them with padded names.

COLMAP runs in a child process, because the import of pycolmap breaks zlib.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytestmark = pytest.mark.skipif(find_spec("pycolmap") is None, reason="needs pycolmap")

COUNT = 30

SORT = """
import json, sys
from mitsplat.capture.sfm_worker import numbers_in
print(json.dumps(sorted(json.loads(sys.argv[1]), key=numbers_in)))
"""

MATCH = """
import json, sys
from pathlib import Path
from mitsplat.capture.sfm_worker import extract, match, pycolmap
names, folder = json.loads(sys.argv[1]), Path(sys.argv[2])
job = {"groups": [names], "features": 500, "first_octave": 0, "matching": "sequential", "camera_model": "PINHOLE"}
extract(job, folder / "images", folder / "database.db", folder)
match(job, folder / "database.db", folder)
with pycolmap.Database.open(folder / "database.db") as opened:
    by_id = {image.image_id: names.index(image.name) for image in opened.read_all_images()}
    tried, _ = opened.read_two_view_geometries()
print(json.dumps([sorted(by_id[end] for end in pycolmap.pair_id_to_image_pair(one)) for one in tried]))
"""


def run(code: str, *arguments: str) -> Any:
    """Run code in a child process, and return the JSON value of its last line."""
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_names_are_sorted_by_their_numbers() -> None:
    names = ["b2.jpg", "b10.jpg", "a.jpg", "b1_12.jpg", "b1_2.jpg", "7.jpg", "b01.jpg"]
    expected = ["7.jpg", "a.jpg", "b01.jpg", "b1_2.jpg", "b1_12.jpg", "b2.jpg", "b10.jpg"]
    assert run(SORT, json.dumps(names)) == expected


def pairs_of(folder: Path, name: str) -> set[tuple[int, int]]:
    """Match photos of a camera that moves over a texture, and return the pairs that COLMAP stored, as numbers."""
    texture = cv2.resize(np.random.default_rng(0).integers(0, 255, (40, 120, 3), dtype=np.uint8), (960, 320))
    (folder / "images").mkdir(parents=True)
    names = [name.format(number) for number in range(1, COUNT + 1)]
    for number, one in enumerate(names):
        cv2.imwrite(str(folder / "images" / one), texture[60:220, 20 * number : 20 * number + 200])
    return {(a, b) for a, b in run(MATCH, json.dumps(names), str(folder))}


@pytest.mark.parametrize("name", ["frame{:03d}.png", "frame{}.png", "img {}.png"])
def test_photos_are_matched_in_the_order_of_their_numbers(tmp_path: Path, name: str) -> None:
    """COLMAP sorts by letters: frame10 comes after frame1, and frame9 is not compared with frame10.

    Its sequential matching compares photos whose places differ by a power of two. Neighbours share nine tenths of
    their picture and always match; COLMAP stores distant pairs only if some of their matches agree.
    """
    pairs = pairs_of(tmp_path, name)
    assert pairs >= {(number, number + 1) for number in range(COUNT - 1)}
    assert {later - earlier for earlier, later in pairs} <= {1, 2, 4, 8, 16}


RESUME = """
import json, sys
from pathlib import Path
from mitsplat.capture.sfm_worker import assign_ids, places_of, pycolmap, rename_images
names, folder = json.loads(sys.argv[1]), Path(sys.argv[2])
database = folder / "database.db"
job = {"groups": [names], "camera_model": "PINHOLE"}
with pycolmap.Database.open(database) as opened:
    before = {image.name: len(opened.read_keypoints(image.image_id)) for image in opened.read_all_images()}
rename_images(database, places_of(names))  # as an interrupted matching leaves them
assign_ids(job, folder / "images", database)
with pycolmap.Database.open(database) as opened:
    after = {image.name: len(opened.read_keypoints(image.image_id)) for image in opened.read_all_images()}
print(json.dumps([list(after) == names, after == before and min(after.values()) > 0]))
"""


def test_features_are_kept_after_an_interrupted_matching(tmp_path: Path) -> None:
    pairs_of(tmp_path, "img {}.png")
    names = sorted(f"img {number}.png" for number in range(1, COUNT + 1))
    assert run(RESUME, json.dumps(names), str(tmp_path)) == [True, True]
