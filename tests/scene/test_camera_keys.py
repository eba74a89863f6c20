"""Fixed cameras, lenses that fold, arrays of OpenCV and rectified images in scene files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

import mitsplat as ms
from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.write import write_dataset
from mitsplat.formats.registry import Catalogue
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.spec.camera_spec import Intrinsics
from tests.conftest import BOTH, WriteScene, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes

POSE = ms.Camera.look_at((0.1, -0.5, 0.4), (0, 0, 0), width=64, height=48, fov_x=50).world_from_camera
FIXED = {"kind": "fixed", "eye": [0.1, -0.5, 0.4], "target": [0, 0, 0]}


def refusal(path: Path) -> str:
    """Return the message with which a scene file is refused."""
    with pytest.raises(ms.InputError) as caught:
        Catalogue.of(ms.load_scene(path))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "camera",
    [FIXED, {"kind": "fixed", "world_from_camera": POSE.tolist()}, {"kind": "fixed", "world_from_camera": POSE}],
)
def test_a_fixed_camera_has_one_pose_in_all_images(
    scene_data: dict[str, Any], write_scene: WriteScene, tmp_path: Path, camera: dict[str, Any]
) -> None:
    if isinstance(camera.get("world_from_camera"), np.ndarray):
        write_scene(scene_data)
        scene = ms.make_scene(ms.SceneSpec(**scene_data | {"camera": camera}), tmp_path)
    else:
        scene = ms.load_scene(write_scene(scene_data | {"camera": camera}))
    for index in range(scene.num_frames):
        np.testing.assert_allclose(plan_frame(scene, index).camera.world_from_camera, POSE, atol=1e-12)


def test_jitter_moves_and_turns_a_fixed_camera_in_every_image(
    scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    """600 draws have the stated deviations within 10 %, and depend only on the seed and the index."""
    scene_data["output"] |= {"layouts": 200, "views": 3}
    path = write_scene(scene_data | {"camera": FIXED | {"jitter": 0.002, "rotation_jitter": 0.5}})
    scene = ms.load_scene(path)
    poses = np.array([plan_frame(scene, index).camera.world_from_camera for index in range(600)])
    assert (poses[:, :3, 3] - POSE[:3, 3]).std(axis=0) == pytest.approx([0.002] * 3, rel=0.1)
    turns = Rotation.from_matrix(POSE[:3, :3].T @ poses[:, :3, :3]).as_rotvec(degrees=True)
    assert turns.std(axis=0) == pytest.approx([0.5] * 3, rel=0.1)
    again = plan_frame(ms.load_scene(path), 77).camera.world_from_camera
    np.testing.assert_array_equal(again, poses[77])


@pytest.mark.parametrize(
    ("up", "ahead", "upper"),
    [
        ([0, 0, 1], [0, 0, -1], [0, 1, 0]),
        ([0, 0, 1], [0, 0, 1], [0, 1, 0]),
        ([0, 1, 0], [0, 1, 0], [0, 0, 1]),
        ([1, 0, 0], [0, 0, -1], [1, 0, 0]),
        ([1e-8, 0, 0], [0, 0, -1], [1, 0, 0]),
    ],
)
def test_views_along_the_upper_direction_follow_the_stated_rule(
    up: Sequence[float],
    ahead: Sequence[float],
    upper: Sequence[float],
    scene_data: dict[str, Any],
    write_scene: WriteScene,
) -> None:
    camera = {"kind": "fixed", "eye": [0.1, 0.2, 0.8], "target": np.add([0.1, 0.2, 0.8], ahead).tolist(), "up": up}
    pose = plan_frame(ms.load_scene(write_scene(scene_data | {"camera": camera})), 0).camera.world_from_camera
    np.testing.assert_allclose(-pose[:3, 1], upper, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 2], ahead, atol=1e-12)


def test_rounded_rotations_are_corrected(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    camera = {"kind": "fixed", "world_from_camera": np.round(POSE, 3).tolist()}
    pose = plan_frame(ms.load_scene(write_scene(scene_data | {"camera": camera})), 0).camera.world_from_camera
    np.testing.assert_allclose(pose, POSE, atol=1e-3)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("camera", "sentence"),
    [
        ({}, "camera: must have either world_from_camera, or eye and target"),
        ({"eye": [0, 0, 1]}, "camera: must have either world_from_camera, or eye and target (got no target)"),
        (FIXED | {"world_from_camera": POSE.tolist()}, "camera.eye: must not be given together with world_from_camera"),
        (FIXED | {"target": FIXED["eye"]}, "camera.target: must differ from eye"),
        (FIXED | {"up": [0, 0, 0]}, "camera.up: must not be zero"),
        (FIXED | {"jitter": -1}, "camera.jitter: must be >= 0 (got -1)"),
        ({"world_from_camera": POSE.T.tolist()}, "camera.world_from_camera: must have the last row 0, 0, 0, 1"),
        ({"world_from_camera": (POSE * 1000).tolist()}, "camera.world_from_camera: must have the last row 0, 0, 0, 1"),
        ({"world_from_camera": [[1, 2], [3, 4]]}, "camera.world_from_camera[0]: must have 4 items (got 2)"),
        (
            {"world_from_camera": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]},
            "camera.world_from_camera: must",
        ),
    ],
)
def test_an_invalid_fixed_camera_is_refused(
    camera: dict[str, Any], sentence: str, scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    found = refusal(write_scene(scene_data | {"camera": {"kind": "fixed"} | camera}))
    assert re.search(r"scene\.yaml:\d+: " + re.escape(sentence), found), found


def dataset(folder: Path, camera: dict[str, Any], formats: list[str], **output: Any) -> tuple[ms.Scene, Path]:
    """Write a dataset of drawn frames, and return its scene and folder."""
    small_scene(folder, large_boxes(), BOTH)
    data = YAML(typ="safe", pure=True).load(folder / "scene.yaml")
    data["camera"] = camera
    data["output"] |= {"layouts": 2, "views": 2, "formats": formats} | output
    YAML(typ="safe", pure=True).dump(data, folder / "scene.yaml")
    scene = ms.load_scene(folder / "scene.yaml")
    return scene, write_dataset(scene, folder / "out", render=render_boxes, settle=scatter_boxes).path


NATIVE = ["yolo", "coco", "bop", "poses", "depth", "flow"]


@pytest.mark.parametrize(
    ("stated", "jitter"),
    [
        ("eye", 0.004),
        ("matrix", 0.0),
        *(pytest.param(*other, marks=pytest.mark.extended) for other in (("eye", 0.0), ("matrix", 0.004))),
    ],
)
def test_the_audit_accepts_a_fixed_camera_and_finds_a_moved_one(tmp_path: Path, stated: str, jitter: float) -> None:
    camera = FIXED if stated == "eye" else {"kind": "fixed", "world_from_camera": POSE.tolist()}
    scene, out = dataset(tmp_path, camera | {"jitter": jitter, "rotation_jitter": 250 * jitter}, NATIVE)
    assert audit_dataset(out).violations == ()
    matrix = np.add(POSE, np.outer([0, 0, 0.05, 0], [0, 0, 0, 1])).tolist()
    moved_pose = {"eye": (0.1, -0.5, 0.45)} if stated == "eye" else {"world_from_camera": tuple(map(tuple, matrix))}
    other = scene.spec.camera.model_copy(update=moved_pose)
    moved = replace(scene, spec=scene.spec.model_copy(update={"camera": other}))
    bad = write_dataset(moved, tmp_path / "bad", render=render_boxes, settle=scatter_boxes).path
    (bad / "dataset.json").write_bytes((out / "dataset.json").read_bytes())
    found = [text for _, text in audit_dataset(bad).violations]
    assert any("m from the scene's fixed camera" in text for text in found), found
    if stated == "eye":
        assert any("degrees from the scene's fixed camera" in text for text in found) == (jitter == 0)


@pytest.mark.parametrize(
    ("lens", "sentence"),
    [
        ({"fov_x": 90, "distortion": [-0.25, 0, 0, 0]}, "stops growing at 49.1 degrees"),
        ({"fov_x": 60, "distortion": [-112, 0, 0, 0]}, "k1 = -112 has no unit"),
        (
            {"fx": 300, "size": [640, 480], "distortion": [-0.4, 0, 0, 0]},
            "the image needs rays that the lens model does",
        ),
        ({"fx": 300, "size": [640, 480], "distortion": [-0.4, 0, 0, 0], "lens": "fisheye"}, "stops growing at"),
        ({"fov_x": 60, "distortion": [0] * 12 + [0.01, 0]}, "must have no tilt of the sensor"),
        ({"fov_x": 60, "distortion": [[0.1, 0], [0, 0]]}, "must be a list of coefficients (got an array of"),
    ],
)
@pytest.mark.parametrize("rectify", [False, True])
def test_a_lens_that_folds_in_the_image_is_refused_with_file_line_and_key(
    lens: dict[str, Any], sentence: str, rectify: bool, scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    scene_data["camera"] = FIXED | {"intrinsics": lens}
    scene_data["output"] |= {"rectify": rectify}
    found = refusal(write_scene(scene_data))
    assert re.search(r"scene\.yaml:\d+: camera\.intrinsics\.distortion", found) and sentence in found, found


@pytest.mark.parametrize("shape", [(5,), (1, 5), (5, 1)])
def test_arrays_of_opencv_are_coefficients(
    shape: tuple[int, ...], scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    values = np.array([-0.1, 0.02, 0.001, 0.002, 0.003])
    assert Intrinsics(fov_x=60, distortion=values.reshape(shape)).distortion == tuple(values)
    lens = {"fov_x": 60, "distortion": values.reshape(shape).tolist()}
    scene = ms.load_scene(write_scene(scene_data | {"camera": FIXED | {"intrinsics": lens}}))
    assert plan_frame(scene, 0).camera.distortion == tuple(values)
    rational = np.append(values, np.zeros(9)).reshape(1, 14)
    assert Intrinsics(fov_x=60, distortion=rational).distortion == (*values, 0, 0, 0)


LENSES = {
    "opencv": {"fx": 60, "fy": 61, "cx": 31, "cy": 25, "distortion": [-0.2, 0.05, 0.003, -0.002, -0.01]},
    "prism": {"fx": 60, "distortion": [-0.2, 0.05, 0.003, 0, 0, 0, 0, 0, 0.01, 0.002, -0.01, 0]},
    "fisheye": {"fx": 40, "fy": 41, "cx": 31, "cy": 25, "lens": "fisheye", "distortion": [0.02, -0.01, 0.003, 0.001]},
}


@pytest.mark.parametrize(
    "name", ["opencv", *(pytest.param(name, marks=pytest.mark.extended) for name in ("prism", "fisheye"))]
)
def test_rectified_images_are_written_as_bop_and_pass_the_audit(tmp_path: Path, name: str) -> None:
    _, out = dataset(tmp_path, FIXED | {"intrinsics": LENSES[name]}, [*NATIVE, "colmap"], rectify=True)
    assert audit_dataset(out).violations == ()
    assert "PINHOLE 64 48" in (out / "colmap/cameras.txt").read_text()
    text = (out / "dataset.json").read_text()
    (out / "dataset.json").write_text(text.replace('"rectify": true', '"rectify": false').replace('"bop",', ""))
    assert any("lens distortion is not the scene's" in text for _, text in audit_dataset(out).violations)


@pytest.mark.parametrize("name", LENSES)
def test_a_rectified_camera_is_that_of_cv2_undistort(
    name: str, scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    """Each pixel of the image that OpenCV undistorts with the same matrix has the direction of the rectified camera."""
    scene_data["camera"] = FIXED | {"intrinsics": LENSES[name]}
    seen = plan_frame(ms.load_scene(write_scene(scene_data)), 0).camera
    scene_data["output"] |= {"rectify": True}
    rectified = plan_frame(ms.load_scene(write_scene(scene_data)), 0).camera
    assert rectified.is_pinhole and not seen.is_pinhole
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    matrix, distortion = seen.intrinsics - half, np.array(seen.distortion)  # OpenCV's pixel centres are whole numbers
    maps = cv2.fisheye.initUndistortRectifyMap if name == "fisheye" else cv2.initUndistortRectifyMap
    x, y = maps(matrix, distortion, np.eye(3), matrix, (64, 48), cv2.CV_32FC1)
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    slopes = rectified.ray_slopes(np.stack([columns.ravel(), rows.ravel()], axis=1))
    at_origin = ms.Camera(**{**vars(seen), "world_from_camera": np.eye(4)})
    pixels, _ = at_origin.project(np.column_stack([slopes, np.ones(len(slopes))]))
    np.testing.assert_allclose(pixels, np.stack([x.ravel(), y.ravel()], axis=1) + 0.5, atol=1e-3)


@pytest.mark.parametrize(("format", "name"), [("bop", "opencv"), ("bop", "fisheye"), ("colmap", "prism")])
def test_formats_without_the_lens_model_name_the_key_for_rectified_images(
    format: str, name: str, scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    scene_data["camera"] = FIXED | {"intrinsics": LENSES[name]}
    scene_data["output"] |= {"formats": [format]}
    assert "set output.rectify: true" in refusal(write_scene(scene_data))
    scene_data["output"] |= {"rectify": True}
    Catalogue.of(ms.load_scene(write_scene(scene_data)))


def test_a_fisheye_without_coefficients_is_not_a_pinhole(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    lens = {"fx": 60, "lens": "fisheye", "distortion": [0, 0, 0, 0]}
    scene_data["camera"] = FIXED | {"intrinsics": lens}
    scene_data["output"] |= {"formats": ["bop"]}
    assert "bop must have a camera without lens distortion (got fisheye [0.0, 0.0, 0.0, 0.0])" in refusal(
        write_scene(scene_data)
    )


@pytest.mark.parametrize(
    ("matrix", "rule"),
    [
        (POSE.ravel(), "(got 16 numbers): write each row as a list"),
        (POSE[:3].ravel(), "(got 12 numbers): write each row as a list"),
        (POSE[:3], "(got 3 rows): add the row [0, 0, 0, 1]"),
        (POSE[:3, :3], "(got 3 rows of 3): append the centre of the camera"),
    ],
)
def test_other_forms_of_a_matrix_are_refused_with_the_way_to_write_it(
    matrix: np.ndarray, rule: str, scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    camera = {"kind": "fixed", "world_from_camera": matrix.tolist()}
    message = refusal(write_scene(scene_data | {"camera": camera}))
    assert "camera.world_from_camera: must be four rows of four numbers" in message and rule in message
