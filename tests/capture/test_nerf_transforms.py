"""``transforms.json`` files that contradict themselves, or whose keys mitsplat does not use."""

from __future__ import annotations

import copy
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsplat.capture import structure_from_motion as sfm
from mitsplat.capture.known_poses import _lens_remarks
from mitsplat.capture.nerf_transforms import check_metric, parse_transforms, read_transforms, transforms_remarks
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera

ANGLE = 2 * math.atan(320 / 500)
"""Field of view of 640 px at a focal length of 500 px [rad]."""


def transforms(**keys: Any) -> dict[str, Any]:
    """Return a file of two frames of 640x480 px; keys ``frame`` are those of the first frame."""
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **keys.pop("frame", {})}
    other = {"file_path": "b.png", "transform_matrix": np.eye(4).tolist()}
    return {"fl_x": 500.0, "w": 640, "h": 480, **keys, "frames": [frame, other]}


def write(folder: Path, content: Any) -> Path:
    (folder / "transforms.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return folder / "transforms.json"


@pytest.mark.parametrize(
    ("keys", "remark"),
    [
        ({"camera_angle_x": ANGLE}, None),
        ({"camera_angle_x": 1.01 * ANGLE}, None),
        # A known exporter doubles the argument of the arc tangent in place of its value.
        ({"camera_angle_x": 2 * math.atan(640 / 500)}, "is a focal length of 250 px in images of 640 px, which contra"),
        ({"camera_angle_x": math.degrees(ANGLE)}, "is no angle in radians in images of 640 px, which contradicts fl_x"),
        (
            {"camera_angle_x": 0.5, "frame": {"fl_x": 600.0}},
            "frames[1]: camera_angle_x = 0.5 is a focal length of 1253",
        ),
        ({"frame": {"fl_x": 600.0, "camera_angle_x": 0.5}}, "which contradicts fl_x = 600; fl_x is used"),
        ({"K1": 0.1}, "the keys K1 are not used"),
        ({"distortion": [0.1, 0, 0, 0], "intrinsic_matrix": []}, "the keys distortion, intrinsic_matrix are not used"),
        ({"frame": {"k_1": 0.1}}, "the keys k_1 of its frames are not used"),
        ({"aabb_scale": 16, "scale": 0.3, "offset": [0, 0, 0], "ply_file_path": "a.ply", "applied_scale": 2}, None),
        ({"frame": {"mask_path": "m.png"}}, "its masks (mask_path) are not used: give their folder with --masks"),
    ],
)
def test_statements_that_are_not_used_are_named(tmp_path: Path, keys: dict[str, Any], remark: str | None) -> None:
    content = parse_transforms(write(tmp_path, transforms(**keys)))
    remarks = list(transforms_remarks(content))
    assert len(remarks) == (remark is not None)
    assert remark is None or remark in remarks[0]


def test_a_focal_length_of_another_size_than_the_photo_is_refused(tmp_path: Path) -> None:
    """The field of view holds for any size; without w and h, the focal length of the full photos was taken."""
    content = transforms(camera_angle_x=ANGLE, fl_x=1000.0)
    del content["w"], content["h"]
    path = write(tmp_path, content)
    with pytest.raises(InputError, match=r"frames\[0\]: camera_angle_x .* contradicts fl_x = 1000: state w and h"):
        read_transforms(path, parse_transforms(path), {"a.png": (640, 480)})


def test_an_image_with_two_lenses_is_refused(tmp_path: Path) -> None:
    content = transforms()
    content["frames"][1] = copy.deepcopy(content["frames"][0]) | {"fl_x": 900.0}
    path = write(tmp_path, content)
    with pytest.raises(InputError, match=r"frames\[1\]: an image must have one lens \(got two of a\.png\)"):
        read_transforms(path, parse_transforms(path), {})


def test_a_fourth_coefficient_without_a_fisheye_lens_is_refused(tmp_path: Path) -> None:
    """OpenCV's fourth radial coefficient belongs to another model than the first three."""
    path = write(tmp_path, transforms(k1=0.1, k4=0.01, camera_model="OPENCV"))
    with pytest.raises(InputError, match=r"frames\[0\]: k4 belongs to camera_model OPENCV_FISHEYE \(got OPENCV\)"):
        read_transforms(path, parse_transforms(path), {})
    path = write(tmp_path, transforms(k1=0.1, k4=0.01, camera_model="OPENCV_FISHEYE"))
    model, _ = read_transforms(path, parse_transforms(path), {})
    assert model.cameras["a.png"].distortion == (0.1, 0.0, 0.0, 0.01)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"fl_x": 1, "fl_x": 2, "frames": []}', r"keys must be unique \(got 'fl_x' twice\)"),
        ("{", r"not JSON \(Expecting property name"),
        ("[]", r"content: must be a mapping of keys to values \(got \[\]\)"),
        ('{"fl_x": NaN, "frames": []}', r"fl_x: Input should be "),
        ("[" * 100_000, "not JSON"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=rf"transforms\.json: {sentence}"):
        parse_transforms(write(tmp_path, text))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks_are_accepted(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "transforms.json").write_bytes(json.dumps(transforms()).encode(encoding))
    assert parse_transforms(tmp_path / "transforms.json").fl_x == 500


def test_scaled_poses_are_not_in_metres(tmp_path: Path) -> None:
    check_metric(write(tmp_path, transforms(applied_scale=1.0)))
    check_metric(write(tmp_path, transforms()))
    with pytest.raises(
        InputError, match=r"poses in metres must have no applied_scale \(got 0\.3\): divide the positions"
    ):
        check_metric(write(tmp_path, transforms(applied_scale=0.3)))


@pytest.mark.parametrize(
    ("intrinsics", "remark"),
    [
        ((500, 500, 320, 240), None),
        ((500, 520, 330, 230), None),
        ((500, 1000, 320, 240), r"a\.png: fx = 500 and fy = 1000 differ by a factor of 2: "),
        (
            (500, 500, 160, 120),
            r"a\.png: the principal point cx, cy = 160, 120 is far from the middle of the image of ",
        ),
    ],
)
def test_implausible_lenses_are_named(intrinsics: tuple[float, ...], remark: str | None) -> None:
    camera = Camera(640, 480, *intrinsics, world_from_camera=np.eye(4))
    empty = np.zeros((0, 3))
    model = sfm.SparseModel({"a.png": camera, "b.png": camera}, empty, empty.astype(np.uint8), {})
    remarks = list(_lens_remarks(model, ["a.png", "b.png"]))
    assert len(remarks) == (remark is not None)
    assert remark is None or re.match(remark, remarks[0])
