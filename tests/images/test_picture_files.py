"""Pictures in files of any name."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from mitsplat.images.picture_files import read_picture


@pytest.mark.parametrize("name", [b"a.png", b"bad\xff.png"])
def test_pixels_equal_those_of_the_file(tmp_path, name):
    pixels = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    assert np.array_equal(read_picture(path), pixels)


@pytest.mark.parametrize("data", [None, b"", b"no picture"])
@pytest.mark.parametrize("name", ["a.png", "bad\udcff.png", "worse\ud800.png"])
def test_files_that_are_not_pictures_give_none(tmp_path, name, data):
    if data is not None and "\ud800" not in name:
        (tmp_path / name).write_bytes(data)
    assert read_picture(tmp_path / name) is None
