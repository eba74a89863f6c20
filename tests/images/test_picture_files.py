"""Image files with arbitrary names."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.scale.attack.images import bomb
from mitsplat.images.picture_files import MAX_FILE_BYTES, read_picture, read_picture_inside


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


@pytest.mark.parametrize("edge", [20_000, 40_000])
def test_a_picture_of_too_many_pixels_gives_none(tmp_path, edge):
    (tmp_path / "a.png").write_bytes(bomb(edge))
    assert read_picture(tmp_path / "a.png") is None


def test_a_large_file_gives_none(tmp_path):
    (tmp_path / "a.png").write_bytes(bomb(8))
    assert read_picture(tmp_path / "a.png") is not None
    os.truncate(tmp_path / "a.png", MAX_FILE_BYTES + 1)
    assert read_picture(tmp_path / "a.png") is None


def test_a_named_pipe_gives_none(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png") is None


def test_a_picture_outside_of_a_folder_gives_none(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "a.png").write_bytes(bomb(8))
    (tmp_path / "in/b.png").write_bytes(bomb(8))
    (tmp_path / "in/a.png").symlink_to(tmp_path / "a.png")
    assert read_picture_inside(tmp_path / "in", "b.png") is not None
    assert read_picture_inside(tmp_path / "in", "a.png") is None
    assert read_picture_inside(tmp_path / "in", "../a.png") is None
