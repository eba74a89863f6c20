"""Pictures beside the photographs that a ``transforms.json`` does not name, as in NeRF's synthetic data."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from mitsplat.capture.known_poses import unnamed_photos
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_settings import CaptureSettings


def write_split(folder: Path, named: int, *, pictures: int = 4) -> CaptureSettings:
    """Write photographs, each with a depth and a normal map, and poses of the first ``named`` names."""
    (folder / "test").mkdir(parents=True)
    for number in range(pictures):
        noise = np.random.default_rng(number).integers(40, 220, (9, 12, 3)).astype(np.uint8)
        for kind in ("", "_depth_0001", "_normal_0001"):
            Image.fromarray(noise).resize((96, 72)).save(folder / f"test/r_{number}{kind}.png")
    frames = []
    for number in range(named):
        pose = np.eye(4)
        pose[:3, 3] = 0.1 * number, 0, 1
        frames.append({"file_path": f"./test/r_{number}", "transform_matrix": pose.tolist()})
    poses = folder / "transforms_test.json"
    poses.write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return CaptureSettings(kind="environment", poses=poses)


def test_depth_and_normal_maps_beside_photos_are_left_out_and_named(tmp_path: Path) -> None:
    settings = write_split(tmp_path / "lego", 4)
    for _ in range(2):  # computed, and read from the folder
        result = capture_photos(tmp_path / "lego", tmp_path / "out", settings)
        assert {photo.name for photo in result.capture.photos} == {f"test/r_{number}.png" for number in range(4)}
        assert (result.given, result.registered, result.shortcoming) == (4, 1.0, None)
        assert not result.capture.rejected
        assert result.warnings[0] == (
            "the poses do not name 8 pictures in the folder, which are left out: test/r_0_depth_0001.png, "
            "test/r_0_normal_0001.png, test/r_1_depth_0001.png and 5 more"
        )


def test_poses_of_few_pictures_with_the_right_names_are_refused(tmp_path: Path) -> None:
    """The names of most frames are those of no picture: the poses may belong to other pictures."""
    settings = write_split(tmp_path / "lego", 12)
    result = capture_photos(tmp_path / "lego", tmp_path / "out", settings)
    assert result.given == 12
    assert result.shortcoming is not None


def test_a_colmap_model_leaves_out_no_picture(tmp_path: Path) -> None:
    assert unnamed_photos(tmp_path, ["a.png", "b.png"], tmp_path) == []
