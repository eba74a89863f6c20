"""Implausible intrinsics and poses are refused or reported with the likely cause."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsplat as ms
from mitsplat.checks.exposure_check import check_exposure
from mitsplat.checks.path_checks import _check_view
from mitsplat.checks.scene_warnings import scene_warnings
from mitsplat.dataset.preflight import label_faults
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.scene.planning.lens_warnings import lens_warnings
from tests.conftest import WriteScene

FIXED = {"kind": "fixed", "eye": [0.1, -0.5, 0.4], "target": [0, 0, 0]}
POSE = look_at_pose((0.8, -0.6, 0.9), (0, 0.1, 0))


def spec_of(data: dict[str, Any], lens: dict[str, Any], width: int = 640, height: int = 480) -> ms.SceneSpec:
    output = {"width": width, "height": height}
    return ms.SceneSpec(**data | {"camera": FIXED | {"intrinsics": lens}, "output": output})


GOOD = {"fx": 600, "fy": 602, "cx": 322.1, "cy": 238.7, "distortion": [-0.12, 0.03, 0.001, -0.0005, 0.01]}


@pytest.mark.parametrize(
    ("lens", "key", "cause"),
    [
        (GOOD | {"fx": 8}, "fx", "(got 8, a field of view of 177.1 degrees): is it in millimetres?"),
        (GOOD | {"fy": 6}, "fy", "is it in millimetres? Multiply it by 480 px"),
        ({"fx": 35}, "fx", "is it in millimetres?"),
        ({"fx": 0.9}, "fx", "is it a fraction of the width, or in metres?"),
        ({"fx": 0.008}, "fx", "is it a fraction of the width, or in metres?"),
        (GOOD | {"fx": -600}, "fx", "must be > 0 (got -600): is it of OpenGL or of an image with y upwards?"),
        (GOOD | {"fy": -602}, "fy", "must be > 0 (got -602): is it of OpenGL"),
        (GOOD | {"fx": 0}, "fx", "must be > 0 (got 0)"),
    ],
)
def test_focal_lengths_that_are_not_in_pixels_are_refused(
    lens: dict[str, Any], key: str, cause: str, scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    scene_data["output"] |= {"width": 640, "height": 480}
    with pytest.raises(ms.InputError) as caught:
        ms.load_scene(write_scene(scene_data | {"camera": FIXED | {"intrinsics": lens}}))
    assert re.search(rf"scene\.yaml:\d+: camera\.intrinsics\.{key}: must be ", str(caught.value))
    assert cause in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("lens", "text", "cause"),
    [
        ({"fov_x": 0.86}, "fov_x is 0.86 degrees", "is it in radians? Then it is 49.3 degrees"),
        ({"fov_x": 172}, "the field of view is 172 degrees", "fisheye"),
        (GOOD | {"fx": 60000}, "fx = 60000 px is a field of view of 0.611", "larger image"),
        (GOOD | {"fy": 900}, "fx = 600 and fy = 900 differ by a factor of 1.5", "square pixels"),
        (
            GOOD | {"cx": 640, "cy": 480},
            "is far from the middle",
            "of an image of about 1280x960 px, 2 times as large?",
        ),
        (GOOD | {"cx": 160, "cy": 120}, "is far from the middle", "about 320x240 px, 0.5 times as large?"),
        (GOOD | {"cx": 960, "cy": 540}, "is outside of the image", "about 1920x1080 px"),
        (GOOD | {"cx": 240, "cy": 320}, "is far from the middle", "are width and height, or cx and cy, exchanged?"),
        (
            GOOD | {"cx": 0.5, "cy": 0.5},
            "is far from the middle",
            "fractions of the image? In pixels they are 320 and 240",
        ),
        (GOOD | {"cx": 2, "cy": -3}, "is outside of the image", "relative to the middle of the image"),
        (GOOD | {"cx": 3.2, "cy": 2.4}, "is far from the middle", "in millimetres"),
        ({"fov_x": 60, "distortion": [112, 0, 0, 0]}, "distortion moves the corners", "k1 = 112 has no unit"),
        ({"fov_x": 60, "distortion": [-0.1, 0.1, -0.12, 0, 0]}, "large tangential", "is the order k1, k2, p1, p2, k3?"),
        (GOOD | {"distortion": [-0.2, 0.05, -0.02, 0, 0]}, "large tangential", "is the order k1, k2, p1, p2, k3?"),
        (GOOD | {"lens": "fisheye", "distortion": [-0.3, 0.1, 0, 0]}, "than an orthographic fisheye", "lens: opencv?"),
        ({"fx": 500, "size": [480, 640]}, "size: 480x640 px has another aspect", "are width and height exchanged?"),
        (
            {"fx": 900, "cx": 640, "cy": 360, "size": [1280, 720]},
            "squeezed by 1.33",
            "size: [960, 720] and a cx that is smaller by 160",
        ),
        ({"fov_x": 60, "aperture": 2.8}, "aperture is a radius of 2.8 m", "f-number"),
        ({"fov_x": 60, "aperture": 0.002, "focus": 600}, "focus is 600 m", "millimetres"),
    ],
)
def test_implausible_intrinsics_are_reported_with_the_likely_cause(
    lens: dict[str, Any], text: str, cause: str, scene_data: dict[str, Any]
) -> None:
    found = list(lens_warnings(spec_of(scene_data, lens)))
    assert any(text in one.text and cause in one.remedy for one in found), found
    assert all(one.text.startswith("camera.intrinsics: ") and not one.ok for one in found)


def test_a_calibration_of_another_aspect_ratio_names_the_crop(scene_data: dict[str, Any]) -> None:
    lens = {"fx": 1200, "fy": 1200, "cx": 640, "cy": 480, "size": [1280, 960]}
    (found,) = lens_warnings(spec_of(scene_data, lens, 640, 360))
    assert "size: 1280x960 px has another aspect ratio than the images, 640x360 px" in found.text
    assert "size: [1280, 720] and a cy that is smaller by 120" in found.remedy
    assert not list(lens_warnings(spec_of(scene_data, lens, 640, 480)))


@pytest.mark.parametrize(
    "lens",
    [
        GOOD,
        {"fov_x": 4},
        {"fov_x": 140},
        {"fx": 300, "fy": 301, "cx": 330, "cy": 235, "lens": "fisheye", "distortion": [0.02, -0.01, 0.004, -0.001]},
        {"fx": 1200, "fy": 1204, "cx": 651, "cy": 470, "size": [1280, 960], "distortion": [-0.3, 0.1, 0.001, 0, -0.02]},
        {"fov_x": 60, "aperture": 0.004, "focus": 0.6},
    ],
)
def test_plausible_intrinsics_get_no_warning(lens: dict[str, Any], scene_data: dict[str, Any]) -> None:
    assert list(lens_warnings(spec_of(scene_data, lens))) == []


def test_check_reports_intrinsics(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    scene_data["camera"] = FIXED | {"intrinsics": {"fx": 70, "fy": 40}}
    scene = ms.load_scene(write_scene(scene_data))
    assert any(one.name == "lens" and "fx = 70 and fy = 40" in one.text for one in scene_warnings(scene))


FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
INVERSE = np.linalg.inv(POSE)
MILLIMETRES = np.array([1, 1, 1, 1000])


@pytest.mark.parametrize(
    ("pose", "cause"),
    [
        (POSE @ FLIP, "is its matrix in the axes of OpenGL (y up, z backwards), for Camera.from_opengl?"),
        (INVERSE, "is its matrix the inverse, camera_from_world?"),
        (
            np.where(np.eye(4)[3] == 1, INVERSE * [[1000], [1000], [1000], [1]], INVERSE),
            "in millimetres, and the inverse, camera_from_world?",
        ),
        (
            np.where(np.eye(4)[3] == 1, POSE * [[1000], [1000], [1000], [1]], POSE @ FLIP),
            "in millimetres, and in the axes",
        ),
        (look_at_pose((300, -400, 700), (300, 0, 0)), "is its position in millimetres?"),
        (look_at_pose((0.1, 0.2, -0.9), (0.1, 0.6, -1.8)), "the camera is below the objects, at z = -0.9 m: does z of"),
        (look_at_pose((0.9, 0, -0.05), (0, 0, 0)) @ FLIP, "is its matrix in the axes of OpenGL"),  # a low camera
    ],
)
def test_a_pose_that_sees_nothing_is_refused_with_the_likely_cause(
    pose: np.ndarray, cause: str, scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    camera = {"kind": "fixed", "world_from_camera": pose.tolist(), "intrinsics": {"fov_x": 30}}
    scene = ms.load_scene(write_scene(scene_data | {"camera": camera}))
    (fault,) = label_faults(scene, [0])
    assert "no view shows any place that objects can reach" in fault.text and " m from the camera" in fault.text
    assert cause in fault.remedy, fault


def test_a_camera_in_millimetres_that_faces_the_objects_is_refused(
    scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    camera = {"kind": "fixed", "eye": [300, -400, 700], "target": [0, 0, 0]}
    (fault,) = label_faults(ms.load_scene(write_scene(scene_data | {"camera": camera})), [0])
    assert "no object covers more than" in fault.text and "the nearest place of objects is 860 m" in fault.text
    assert fault.remedy.startswith("is its position in millimetres?")


def test_a_given_camera_that_sees_nothing_is_reported_once(
    scene_data: dict[str, Any], write_scene: WriteScene, tmp_path: Path
) -> None:
    scene = ms.load_scene(write_scene(scene_data))
    layout = ms.Layout.from_poses(scene, {"nut": [np.eye(4)]})
    lens = (64, 48, 120.0, 120.0, 32.0, 24.0)
    with ms.Renderer(scene) as renderer:
        with pytest.warns(UserWarning, match=r"nothing is in view; the nearest object is 1\.3.* m .*OpenGL") as caught:
            for _ in range(2):
                renderer.render(0, layout=layout, camera=ms.Camera(*lens, POSE @ FLIP))
        assert len(caught) == 1
        renderer.render(0, layout=layout, camera=ms.Camera(*lens, POSE))


def test_an_inverted_pose_that_sees_a_corner_of_the_region_is_reported(
    scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    """The camera with the right pose looks at the middle; the inverse sees part of the region, but no object."""
    tilt = np.radians(35)
    right = np.eye(4)
    right[:3, :3] = [[1, 0, 0], [0, -np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), -np.cos(tilt)]]
    right[:3, 3] = 0, 0.42, 0.6
    found = {}
    for name, pose in (("right", right), ("inverse", np.linalg.inv(right))):
        camera = {"kind": "fixed", "world_from_camera": pose.tolist()}
        scene = ms.load_scene(write_scene(scene_data | {"camera": camera}, f"{name}.yaml"))
        assert list(label_faults(scene, [0])) == []
        found[name] = _check_view(scene)
    assert (found["right"].ok, found["inverse"].ok) == (True, False)
    assert found["inverse"].remedy == "is its matrix the inverse, camera_from_world?"
    check_exposure(scene)  # without a warning of Python, which would be an error here
