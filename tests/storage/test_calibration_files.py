"""Files of cameras of other programs, which are refused with the way to use them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mitsplat.capture.nerf_transforms import parse_transforms
from mitsplat.errors import InputError
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.storage.calibration_files import calibration_kind, refuse_calibration

KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
"""
ROS = """image_width: 640
image_height: 480
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
"""
FILES = {
    "camchain.yaml": (KALIBR, "a camera chain of Kalibr"),
    "ost.yaml": (ROS, "a camera_info of ROS"),
    "scene_camera.json": ('{"0": {"cam_K": [500, 0, 320, 0, 500, 240, 0, 0, 1]}}', "a camera file of BOP"),
    "a.xml": ('<?xml version="1.0"?>\n<document version="2.0.0"><chunk label="1">', "cameras of Metashape"),
    "a.csv": ("#name,x,y,alt,heading,pitch,roll,f,px,py\n", "a table of cameras of RealityScan"),
    "a.xmp": ('<x:xmpmeta xmlns:x="adobe:ns:meta/">', "XMP data of a photo"),
    "cameras.json": ('[{"id": 0, "position": [0, 0, 0], "rotation": [[1]]}]', "the cameras.json of 3DGS"),
    "sfm_data.json": ('{"sfm_data_version": "0.3", "views": []}', "cameras of OpenMVG"),
    "cameras.sfm": ('{"version": ["1", "2", "5"], "views": []}', "cameras of Meshroom"),
    "bundle.out": ("# Bundle file v0.3\n0 0\n", "cameras of Bundler"),
    "a.nvm": ("NVM_V3\n\n0\n", "cameras of VisualSFM"),
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_other_programs_are_named(tmp_path: Path, name: str) -> None:
    text, kind = FILES[name]
    (tmp_path / name).write_text(text)
    for read in (load_scene, parse_transforms):
        with pytest.raises(InputError) as error:
            read(tmp_path / name)
        assert str(error.value).startswith(f"{tmp_path / name}: ")
        assert f"(got {kind}): " in str(error.value)
    with pytest.raises(InputError, match=rf"must be that \(got a folder with {name}, {kind}\): "):
        refuse_calibration(tmp_path, "must be that")


@pytest.mark.parametrize("suffix", ["yaml", "xml"])
def test_calibrations_of_opencv_are_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.eye(3))
    storage.release()
    with pytest.raises(InputError, match=r"\(got a calibration of OpenCV\): enter its values .*\(cx and cy plus 0\.5"):
        load_scene(path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("scene.yaml", "name: a\ncamera: {kind: fixed}\n"),
        ("transforms.json", '{"camera_angle_x": 1, "frames": []}'),
        ("scene.xml", '<scene version="3.0.0"></scene>'),
        ("dataset.json", '{"version": 1, "frames": []}'),
    ],
)
def test_own_files_are_not_named(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert calibration_kind(tmp_path / name) is None
    refuse_calibration(tmp_path, "must be that")


def test_the_folder_of_a_colmap_model_is_proposed(tmp_path: Path) -> None:
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/cameras.bin").write_bytes(bytes(8))
    with pytest.raises(InputError, match=r"\(got a folder without cameras\.bin\): did you mean .*/sparse/0\?"):
        refuse_calibration(tmp_path, "must be that")
    refuse_calibration(tmp_path / "sparse/0", "must be that")
