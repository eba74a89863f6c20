"""Cameras and masks from other programs: COLMAP models, NeRF transforms, folders of masks."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from mitsplat.capture import known_poses as poses
from mitsplat.capture import structure_from_motion as sfm
from mitsplat.capture.boards import Board
from mitsplat.capture.capture import Capture
from mitsplat.capture.known_poses import read_poses
from mitsplat.capture.nerf_transforms import parse_transforms, read_transforms
from mitsplat.capture.photos import Prepared, mask_files, prepare_photos, read_mask, with_orientation
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_result import CaptureResult
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from tests import rendered


def write_colmap_text(folder: Path, capture: Capture) -> None:
    """Write the capture as COLMAP text files, with points."""
    from scipy.spatial.transform import Rotation

    folder.mkdir()
    cameras, images, tracks = [], [], [[] for _ in capture.points]
    for number, photo in enumerate(capture.photos, start=1):
        camera, pose = photo.camera, photo.camera.camera_from_world
        k1, k2, p1, p2 = camera.distortion or (0.0,) * 4
        cameras.append(
            f"{number} OPENCV {camera.width} {camera.height} {camera.fx!r} {camera.fy!r} {camera.cx!r} {camera.cy!r} "
            f"{k1!r} {k2!r} {p1!r} {p2!r}"
        )
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        images.append(" ".join(map(str, (number, w, x, y, z, *pose[:3, 3].tolist(), number, photo.name))))
        pixels, _ = camera.project(capture.points[photo.seen])
        images.append(" ".join(f"{u} {v} {k + 1}" for (u, v), k in zip(pixels.tolist(), photo.seen, strict=True)))
        for place, k in enumerate(photo.seen):
            tracks[k].append(f"{number} {place}")
    points = [
        " ".join(map(str, (k + 1, *point.tolist(), *colour.tolist(), 0.1, *track)))
        for k, (point, colour, track) in enumerate(zip(capture.points, capture.colours, tracks, strict=True))
    ]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")


def test_cameras_of_a_colmap_model_are_read(captured: tuple[Path, Path, CaptureResult], tmp_path: Path) -> None:
    given, _, result = captured
    write_colmap_text(tmp_path / "model", result.capture)
    settings = CaptureSettings(kind="environment", poses=tmp_path / "model", metric=True, max_size=240)
    capture = capture_photos(given, tmp_path / "out", settings).capture
    assert (capture.units, capture.up) == ("metre", "z")
    np.testing.assert_allclose(capture.points, result.capture.points, atol=1e-12)
    for one, other in zip(capture.photos, result.capture.photos, strict=True):
        np.testing.assert_allclose(one.camera.world_from_camera, other.camera.world_from_camera, atol=1e-9)
        assert one.camera.fx == pytest.approx(other.camera.fx / 2)
        np.testing.assert_array_equal(one.seen, other.seen)
    (tmp_path / "model/images.txt").write_text("1 0.5 broken\n")
    with pytest.raises(InputError, match="model: not a readable COLMAP model"):
        capture_photos(given, tmp_path / "broken", settings)


def test_transforms_json_is_read_and_points_are_triangulated(
    photos: tuple[Path, dict[str, Camera]], tmp_path: Path
) -> None:
    folder, truth = (
        tmp_path / "four",
        {name: photos[1][name] for name in ("photo00.png", "photo01.png", "photo02.png", "photo03.png")},
    )
    folder.mkdir()
    for name in truth:
        shutil.copy(photos[0] / name, folder)
    frames = [
        {
            "file_path": f"./images/{Path(name).stem}",
            "transform_matrix": (c.world_from_camera * (1, -1, -1, 1)).tolist(),
        }
        for name, c in truth.items()
    ]
    camera = next(iter(truth.values()))
    content = {"camera_angle_x": 2 * np.arctan(camera.width / 2 / camera.fx), "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    prepared, _ = prepare_photos(folder, tmp_path / "copies", max_size=480)
    model, _ = read_poses(tmp_path / "transforms.json", prepared, tmp_path / "work", base=folder)
    for name, true in truth.items():
        np.testing.assert_allclose(model.cameras[name].world_from_camera, true.world_from_camera, atol=1e-12)
        assert model.cameras[name].fx == pytest.approx(true.fx)
    assert len(model.points) > 30
    assert np.median(np.abs(model.points[:, 2])) < 2e-3  # most are on the board, z = 0
    content["frames"][1]["transform_matrix"][0][0] = 7
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"transforms\.json: frames\[1\]: world_from_camera must be a rotation"):
        read_poses(tmp_path / "transforms.json", prepared, tmp_path / "work", base=folder)
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    with pytest.raises(InputError, match=r"transforms\.json: frames: "):
        read_poses(tmp_path / "transforms.json", prepared, tmp_path / "work", base=folder)


def test_points_are_triangulated_by_fisheye_cameras(photos: tuple[Path, dict[str, Camera]], tmp_path: Path) -> None:
    """The photos are resampled to a fisheye lens. A second run has other intrinsics in the same folder."""
    folder, frames, k = tmp_path / "given", [], np.array([1.0, 0.2, 0.05, 0.0])
    folder.mkdir()
    for name in (f"photo{number:02}.png" for number in range(4)):
        camera = photos[1][name]
        matrix = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
        grid = np.stack(np.meshgrid(*map(np.arange, (camera.width, camera.height))), axis=-1).astype(np.float64)
        source = cv2.fisheye.undistortPoints(grid.reshape(1, -1, 2), matrix, k, None, matrix)
        places = source.reshape(camera.height, camera.width, 2).astype(np.float32)
        with Image.open(photos[0] / name) as image:
            turned = cv2.remap(np.asarray(image.convert("RGB")), places, None, cv2.INTER_LINEAR)
        Image.fromarray(turned).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": (camera.world_from_camera * (1, -1, -1, 1)).tolist()})
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    prepared, _ = prepare_photos(folder, tmp_path / "copies", max_size=480)
    shares: list[int] = []
    for coefficients in (dict(zip(("k1", "k2", "k3", "k4"), k.tolist(), strict=True)), {}):
        model_key = {"camera_model": "OPENCV_FISHEYE"} if coefficients else {}
        (tmp_path / "transforms.json").write_text(
            json.dumps(intrinsics | coefficients | model_key | {"frames": frames})
        )
        model, _ = read_poses(tmp_path / "transforms.json", prepared, tmp_path / "work", base=folder)
        shares.append(int((np.abs(model.points[:, 2]) < 2e-3).sum()))
    assert shares[0] > 100
    assert shares[1] < 0.9 * shares[0]  # 116 and 146 points are on the board, z = 0


def test_given_masks_replace_computed_masks(
    captured: tuple[Path, Path, CaptureResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, _, result = captured
    write_colmap_text(tmp_path / "model", result.capture)
    (tmp_path / "masks").mkdir()
    for photo in result.capture.photos:
        mask = Image.new("L", rendered.SIZE)
        mask.paste(255, (100, 80, 300, 250))
        kind = int(photo.name[5:7]) % 3
        # The suffix may be in upper case, and the alpha channel may be constant.
        shown = mask.convert("RGB").convert("RGBA") if kind == 1 else mask
        shown.save(tmp_path / "masks" / f"{Path(photo.name).stem}{'.PNG' if kind == 2 else '.png'}")
    Image.new("L", rendered.SIZE).save(tmp_path / "masks/photo03.png")
    settings = CaptureSettings(poses=tmp_path / "model", metric=True, masks=tmp_path / "masks")
    capture = capture_photos(given, tmp_path / "out", settings).capture
    assert capture.rejected["photo03.png"] == "its mask covers only 0.0% of it"
    assert len(capture.photos) == 15
    alpha = capture.photos[0].read().mask
    assert alpha is not None
    assert alpha.sum() == alpha[80:250, 100:300].sum() == 170 * 200
    with monkeypatch.context() as elsewhere:
        elsewhere.chdir(tmp_path / "masks")
        # Copies are not written again.
        elsewhere.setattr("mitsplat.capture.pipeline.capture_pipeline.prepare_photos", None)
        there = replace(settings, poses=Path("../model"), masks=Path())
        assert len(capture_photos(given, Path("../out"), there).capture.photos) == 15
    (tmp_path / "masks/photo05.PNG").unlink()
    with pytest.raises(InputError, match=r"every photo must have a mask \(missing: photo05\.png\)"):
        capture_photos(given, tmp_path / "out", settings)
    Image.new("L", (300, 300), 255).save(tmp_path / "masks/photo05.png")
    with pytest.raises(
        InputError, match=r"photo05\.png: must have the aspect ratio of its photo, 480x360 px \(got 300x300\)"
    ):
        capture_photos(given, tmp_path / "out", settings)


def test_lenses_of_other_models_are_refused() -> None:
    with pytest.raises(InputError, match="lens model FOV is not supported: use one of SIMPLE_PINHOLE, "):
        sfm.opencv_camera("FOV", 4, 3, [1] * 5, np.eye(4)[:3])
    with pytest.raises(
        InputError, match="a camera of lens model OPENCV_FISHEYE cannot be used: a fisheye lens must show"
    ):
        sfm.opencv_camera("OPENCV_FISHEYE", 4000, 3000, [300, 300, 2000, 1500, 0, 0, 0, 0], np.eye(4)[:3])


def test_fisheye_cameras_are_read_from_colmap_and_transforms_json(tmp_path: Path) -> None:
    """The angle to the axis follows OpenCV's polynomial for a COLMAP model and for a transforms.json."""
    values = 300.0, 301.0, 160.0, 120.0, 0.02, -0.01, 0.003, 0.001
    angle = 0.4
    shown = angle * (1 + 0.02 * angle**2 - 0.01 * angle**4 + 0.003 * angle**6 + 0.001 * angle**8)
    pixel = [[160 + 300 * shown, 120]]
    given = tmp_path / "model"
    given.mkdir()
    (given / "cameras.txt").write_text(f"1 OPENCV_FISHEYE 320 240 {' '.join(map(str, values))}\n")
    (given / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 1 b.png\n\n")
    (given / "points3D.txt").write_text("")
    colmap = sfm.read_colmap_model(given, tmp_path / "work").cameras["a.png"]
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")
    frame = {"file_path": "a.png", "transform_matrix": np.diag([1.0, -1.0, -1.0, 1.0]).tolist()}
    lens = dict(zip(names, values, strict=True)) | {"w": 320, "h": 240, "camera_model": "OPENCV_FISHEYE"}
    (tmp_path / "transforms.json").write_text(json.dumps(lens | {"frames": [frame]}))
    path = tmp_path / "transforms.json"
    nerf = read_transforms(path, parse_transforms(path), {})[0].cameras["a.png"]
    for camera in (colmap, nerf):
        assert camera.lens == "fisheye"
        np.testing.assert_allclose(camera.project([[np.tan(angle), 0, 1]])[0], pixel, atol=1e-9)


@pytest.mark.parametrize(
    ("camera", "distortion"),
    [
        ("SIMPLE_RADIAL_FISHEYE 320 240 300 160 120 0.02", (0.02, 0.0, 0.0, 0.0)),
        ("RADIAL_FISHEYE 320 240 300 160 120 0.02 -0.01", (0.02, -0.01, 0.0, 0.0)),
    ],
)
def test_fisheye_lenses_of_fewer_parameters_are_read(
    tmp_path: Path, camera: str, distortion: tuple[float, ...]
) -> None:
    """They are OPENCV_FISHEYE with one focal length and k3 = k4 = 0."""
    given = tmp_path / "model"
    given.mkdir()
    (given / "cameras.txt").write_text(f"1 {camera}\n")
    (given / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 1 b.png\n\n")
    (given / "points3D.txt").write_text("")
    lens = sfm.read_colmap_model(given, tmp_path / "work").cameras["a.png"]
    angle = 0.4
    shown = angle * (1 + distortion[0] * angle**2 + distortion[1] * angle**4)
    assert (lens.lens, lens.fx, lens.fy, lens.distortion) == ("fisheye", 300, 300, distortion)
    np.testing.assert_allclose(lens.project([[0, np.tan(angle), 1]])[0], [[160, 120 + 300 * shown]], atol=1e-9)


def test_cameras_that_no_point_confirms_are_reported(tmp_path: Path) -> None:
    """Three photos of unrelated noise have no common points."""
    (tmp_path / "photos").mkdir()
    frames = []
    for number in range(3):
        noise = np.random.default_rng(number).integers(40, 220, (9, 12, 3)).astype(np.uint8)
        Image.fromarray(noise).resize((96, 72)).save(tmp_path / f"photos/{number}.png")
        pose = np.eye(4)
        pose[:3, 3] = 0.1 * number, 0, 1
        frames.append({"file_path": f"photos/{number}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    settings = CaptureSettings(kind="environment", poses=tmp_path / "transforms.json")
    result = capture_photos(tmp_path / "photos", tmp_path / "out", settings)
    assert not len(result.capture.points)
    (warning,) = result.warnings
    assert warning.startswith("no point is seen alike by two photos with the cameras given, which may be wrong")


def test_lenses_of_instant_ngp_are_read(tmp_path: Path) -> None:
    """It states a fisheye lens by ``is_fisheye``, and may state both fields of view instead of focal lengths."""
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    path = tmp_path / "transforms.json"

    def read(lens: dict[str, Any]) -> Camera:
        path.write_text(json.dumps(lens | {"w": 640, "h": 480, "frames": [frame]}))
        return read_transforms(path, parse_transforms(path), {})[0].cameras["a.png"]

    fisheye = read({"fl_x": 300, "k1": 0.02, "k2": 0.003, "is_fisheye": True})
    assert (fisheye.lens, fisheye.distortion) == ("fisheye", (0.02, 0.003, 0.0, 0.0))
    pinhole = read({"camera_angle_x": 2 * np.arctan(320 / 600), "camera_angle_y": 2 * np.arctan(240 / 500)})
    assert (pinhole.fx, pinhole.fy) == pytest.approx((600, 500))
    frame["camera_angle_x"] = 2 * np.arctan(320 / 700)
    assert read({"fl_x": 600, "fl_y": 610}).fx == pytest.approx(700)  # the frame's own lens
    assert read({"fl_x": 600, "fl_y": 610}).fy == pytest.approx(700)


@pytest.mark.parametrize(
    ("lens", "sentence"),
    [
        ({"camera_angle_x": 50.0}, "camera_angle_x must be 0 to pi radians (got 50: is it in degrees?)"),
        ({"fl_x": 900, "cx": 640, "cy": 480}, "fl_x, cx, cy = 900, 640, 480 must be in pixels of a photo of 640 x 480"),
        ({"fl_x": 8, "cx": 320, "cy": 240, "w": 640, "h": 480}, "fl_x, cx, cy = 8, 320, 240 must be in pixels"),
        ({"fl_x": 900, "cx": 0.5, "cy": 0.5, "w": 640, "h": 480}, "fl_x, cx, cy = 900, 0.5, 0.5 must be in pixels"),
        ({"fl_x": 900, "cx": 640, "cy": 480, "w": 1280, "h": 960}, ""),
        ({"fl_x": 450, "cx": 300, "cy": 250}, ""),
        ({"fl_x": 450, "k5": 0.1}, "has distortion in k5, k6 or distortion_params, which are not read"),
        ({"fl_x": 450, "distortion_params": [0.1, 0, 0, 0, 0, 0]}, "has distortion in k5, k6 or distortion_params"),
        ({"fl_x": 450, "k5": 0, "distortion_params": [0, 0]}, ""),
        ({"camera_angle_x": 0.8, "camera_angle_y": 40}, "camera_angle_y must be 0 to pi radians (got 40"),
    ],
)
def test_intrinsics_of_another_image_size_or_unit_are_refused(
    tmp_path: Path, lens: dict[str, Any], sentence: str
) -> None:
    """Photos of 640 x 480 px may have cameras that hold for 1280 x 960 px, if the file states it."""
    frame = {"file_path": "a.png", "transform_matrix": np.diag([1.0, -1.0, -1.0, 1.0]).tolist()}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(lens | {"frames": [frame]}))
    with pytest.raises(InputError, match=re.escape(sentence)) if sentence else nullcontext():
        read_transforms(path, parse_transforms(path), {"a.png": (640, 480)})


def small_model(folder: Path) -> tuple[Path, list[Prepared]]:
    """Write a COLMAP model of two photos and a point, and return its folder and the photos."""
    model = folder / "model"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 32 24 40 40 16 12\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.png\n5 6 1\n2 1 0 0 0 0.1 0 1 1 b.png\n5 6 1\n")
    (model / "points3D.txt").write_text("1 0 0 1 9 9 9 0.1 1 0 2 0\n")
    return model, [Prepared(f"{name}.png", folder / f"{name}.png", (32, 24), 1, ()) for name in "ab"]


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        ("images", "0.1 0 1 1", "1e300 0 1 1", "camera b.png must lie within 1e+09 of the origin (got 1e+300)"),
        ("points3D", "1 0 0 1", "1 0 -1e308 1", "a point must lie within 1e+09 of the origin (got 1e+308)"),
        ("points3D", "1 0 0 1", "1 nan 0 1", "not a readable COLMAP model"),
    ],
)
def test_models_with_positions_that_are_not_finite_are_refused(
    tmp_path: Path, file: str, old: str, new: str, sentence: str
) -> None:
    model, photos = small_model(tmp_path)
    path = model / f"{file}.txt"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError) as raised:
        read_poses(model, photos, tmp_path / "work", base=tmp_path)
    assert sentence in str(raised.value) and str(model) in str(raised.value)


@pytest.mark.parametrize("data", [struct.pack("<Q", 1 << 62), struct.pack("<Q3d3BdQ", 1, 0, 0, 1, 9, 9, 9, 0, 1 << 62)])
def test_counts_beyond_the_size_of_a_model_take_no_memory(
    tmp_path: Path, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, photos = small_model(tmp_path)
    pycolmap = pytest.importorskip("pycolmap")
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()
    (model / "points3D.bin").write_bytes(data)
    monkeypatch.setattr(sfm, "_READ_MEMORY", 200 << 20)
    with pytest.raises(InputError, match="model: not a readable COLMAP model"):
        read_poses(model, photos, tmp_path / "work", base=tmp_path)


def test_reading_a_model_beyond_the_time_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, photos = small_model(tmp_path)
    monkeypatch.setattr(sfm, "_READ_SECONDS", 0.0)
    with pytest.raises(InputError, match="COLMAP did not end within 0 s"):
        read_poses(model, photos, tmp_path / "work", base=tmp_path)


def test_a_named_pipe_in_a_model_is_refused(tmp_path: Path) -> None:
    model, photos = small_model(tmp_path)
    (model / "points3D.txt").unlink()
    os.mkfifo(model / "points3D.txt")
    with pytest.raises(InputError, match=r"points3D\.txt: must be a file"):
        read_poses(model, photos, tmp_path / "work", base=tmp_path)


def test_photos_of_one_camera_of_a_rig_get_its_cameras(tmp_path: Path) -> None:
    """Both cameras of the model have photos of the same names; unusable photos count as matched."""
    model, _ = small_model(tmp_path)
    images = "".join(
        f"{number} 1 0 0 0 {0.1 * number} 0 1 1 {side}/{name}.png\n5 6 1\n"
        for number, (side, name) in enumerate(((side, name) for side in ("left", "right") for name in "abc"), start=1)
    )
    (model / "images.txt").write_text(images)
    (model / "points3D.txt").write_text("1 0 0 1 9 9 9 0.1 1 0 2 0 3 0 4 0 5 0 6 0\n")
    photos = [Prepared(f"{name}.png", tmp_path / f"{name}.png", (32, 24), 1, ()) for name in "ab"]
    found, _ = read_poses(model, photos, tmp_path / "work", base=tmp_path / "right", unusable=["c.png"])
    assert {name: round(-float(c.centre[0]), 3) for name, c in found.cameras.items()} == {"a.png": 0.4, "b.png": 0.5}
    with pytest.raises(InputError, match=r"the photo a\.png must match one of the names \(got left/a\.png and right/"):
        read_poses(model, photos, tmp_path / "work", base=tmp_path / "elsewhere")


def test_paths_of_a_transforms_json_are_relative_to_it(tmp_path: Path) -> None:
    folder = tmp_path / "rig/right"
    folder.mkdir(parents=True)
    frames = [{"file_path": f".\\{name}.png", "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    frames[1]["transform_matrix"] = np.diag([-1.0, -1, 1, 1]).tolist()
    content = {"fl_x": 40, "w": 32, "h": 24, "frames": frames}
    path = folder / "transforms.json"
    path.write_text(json.dumps(content))
    parsed = parse_transforms(path)
    names = {frame.file_path: poses._below(path.parent, frame.file_path) for frame in parsed.frames}
    given = [f"{side}/{name}.png" for side in ("left", "right") for name in "ab"]
    assert poses.match_names(path, names, tmp_path / "rig", given) == {
        ".\\a.png": "right/a.png",
        ".\\b.png": "right/b.png",
    }
    frames[1]["file_path"] = ".\\a.png"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"frames\[1\]: an image must have one pose \(got two of \.\\a\.png\)"):
        read_transforms(path, parse_transforms(path), {})


@pytest.mark.parametrize("centre", [{}, {"cx": 42.0, "cy": 30.0}])
def test_intrinsics_without_a_size_are_those_of_the_photo_before_it_is_reduced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, centre: dict[str, float]
) -> None:
    frames = []
    (tmp_path / "photos").mkdir()
    for number, name in enumerate(("a.png", "b.png", "c.png")):
        noise = np.random.default_rng(number).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "photos" / name)
        frames.append({"file_path": name, "transform_matrix": np.eye(4).tolist()})
    source = tmp_path / "photos/transforms.json"
    source.write_text(json.dumps({"fl_x": 100.0, **centre, "frames": frames}))
    photos, _ = prepare_photos(tmp_path / "photos", tmp_path / "copies", max_size=40, upright=False)
    monkeypatch.setattr(poses, "find_points", lambda photos, cameras, *_: cameras)
    cameras, _ = read_poses(source, photos, tmp_path / "work", base=tmp_path / "photos")
    for camera in cameras.values():
        assert (camera.size, camera.fx, camera.cx) == ((40, 30), 50.0, 0.5 * centre.get("cx", 40.0))


def turned_photos(folder: Path, orientation: int, size: tuple[int, int]) -> tuple[np.ndarray, list[Prepared]]:
    """Return the upright pixels of a photo, and three photos that are stored for an EXIF orientation."""
    coarse = np.random.default_rng(0).integers(0, 256, (size[1] // 4, size[0] // 4, 3), dtype=np.uint8)
    upright = coarse.repeat(4, axis=0).repeat(4, axis=1)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    undo = {6: 8, 8: 6}.get(orientation, orientation)  # all other orientations are their own inverse
    stored = ImageOps.exif_transpose(with_orientation(Image.fromarray(upright), undo))
    (folder / "photos").mkdir()
    for name in "abc":
        stored.save(folder / "photos" / f"{name}.png", exif=exif)
    prepared, rejected = prepare_photos(folder / "photos", folder / "copies", max_size=1000, upright=False)
    assert not rejected
    return upright, prepared


def model_of(picture: np.ndarray, *, points: bool = True) -> sfm.SparseModel:
    """Return a model of three cameras that see coloured points on a picture (H, W, 3), one metre in front of them."""
    height, width = picture.shape[:2]
    pixels = np.random.default_rng(1).uniform((2, 2), (width - 2, height - 2), (60 if points else 0, 2))
    places = np.column_stack([(pixels - (width / 2, height / 2)) / 50, np.ones(len(pixels))])
    columns, rows = pixels.astype(int).T
    camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4))
    names = [f"{name}.png" for name in "abc"]
    seen = dict.fromkeys(names, np.arange(len(pixels), dtype=np.int32))
    return sfm.SparseModel(dict.fromkeys(names, camera), places, picture[rows, columns], seen)


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize("of", ["stored", "upright"])
@pytest.mark.parametrize("size", [(80, 60), (64, 64)])
def test_the_model_decides_whether_its_cameras_hold_for_upright_photos(
    tmp_path: Path, orientation: int, of: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The size of the model's images decides; where it cannot, the colours of the model's points."""
    upright, prepared = turned_photos(tmp_path, orientation, size)
    with Image.open(prepared[0].file) as copy:
        stored = np.asarray(copy)
    wanted = upright if of == "upright" else stored
    monkeypatch.setattr(poses, "read_colmap_model", lambda *_: model_of(wanted))
    found, photos = read_poses(tmp_path, prepared, tmp_path / "work", base=tmp_path / "photos")
    assert len(found.cameras) == 3
    for photo in photos:
        assert photo.file.name in found.cameras
        camera = found.cameras[photo.file.name]
        assert (camera.width, camera.height) == photo.size == wanted.shape[1::-1]
        with Image.open(photo.file) as copy:
            np.testing.assert_array_equal(np.asarray(copy), wanted)
            assert copy.getexif().get(ExifTags.Base.Orientation, 1) == 1


def test_a_second_capture_with_other_settings_turns_photos_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upright, prepared = turned_photos(tmp_path, 6, (80, 60))
    monkeypatch.setattr(poses, "read_colmap_model", lambda *_: model_of(upright))
    (tmp_path / "model").mkdir()
    for square in (0.02, 0.03):
        settings = CaptureSettings("environment", poses=tmp_path / "model", metric=True, board=Board(square=square))
        capture = capture_photos(tmp_path / "photos", tmp_path / "out", settings).capture
        assert len(capture.photos) == len(prepared)
        for photo in capture.photos:
            with Image.open(photo.file) as picture:
                np.testing.assert_array_equal(np.asarray(picture), upright)


def test_masks_of_photos_that_the_model_turns_are_upright(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    upright, prepared = turned_photos(tmp_path, 6, (80, 60))
    monkeypatch.setattr(poses, "read_colmap_model", lambda *_: model_of(upright))
    mask = np.zeros(upright.shape[:2], dtype=np.uint8)
    mask[10:30, 20:50] = 255
    for name in ("model", "masks"):
        (tmp_path / name).mkdir()
    for photo in prepared:
        Image.fromarray(mask).save(tmp_path / "masks" / photo.name)
    settings = CaptureSettings(poses=tmp_path / "model", metric=True, masks=tmp_path / "masks")
    for photo in capture_photos(tmp_path / "photos", tmp_path / "out", settings).capture.photos:
        np.testing.assert_array_equal(photo.read_mask()[0], mask / np.float32(255))


@pytest.mark.parametrize("points", [True, False])
def test_an_undecided_half_turn_is_refused_with_a_remedy(
    tmp_path: Path, points: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The points have other colours than the photos, or there are no points."""
    upright, prepared = turned_photos(tmp_path, 3, (80, 60))
    other = np.random.default_rng(9).integers(0, 256, upright.shape, dtype=np.uint8)
    monkeypatch.setattr(poses, "read_colmap_model", lambda *_: model_of(other, points=points))
    with pytest.raises(InputError) as raised:
        read_poses(tmp_path, prepared, tmp_path / "work", base=tmp_path / "photos")
    assert "camera of a.png refers to the photo before or after the rotation in its EXIF data" in str(raised.value)
    assert "(orientation 3): rotate the pixels or remove the entry" in str(raised.value)


def write_text_model(folder: Path, images: dict[int, tuple[str, float]], points: str = "", seen: str = "") -> Path:
    """Write a COLMAP model as text: the name and the x coordinate of each image by its id."""
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    lines = [f"{number} 1 0 0 0 {x} 0 1 1 {name}\n{seen}\n" for number, (name, x) in images.items()]
    (folder / "images.txt").write_text("# images\n" + "".join(lines))
    (folder / "points3D.txt").write_text(points)
    return folder


def test_names_with_spaces_in_a_text_model_are_read_completely(tmp_path: Path) -> None:
    model = write_text_model(tmp_path / "model", {1: ("front left 1.jpg", 0.0), 2: ("front left ü 2.jpg", 0.5)})
    assert list(sfm.read_colmap_model(model, tmp_path / "work").cameras) == ["front left 1.jpg", "front left ü 2.jpg"]


def test_one_name_with_two_poses_is_refused(tmp_path: Path) -> None:
    images = {1: ("a.jpg", 0.0), 2: ("b.jpg", 0.5), 3: ("a.jpg", 0.0)}
    twice = write_text_model(tmp_path / "twice", images)
    assert list(sfm.read_colmap_model(twice, tmp_path / "work").cameras) == ["a.jpg", "b.jpg"]
    differing = write_text_model(tmp_path / "differing", images | {3: ("a.jpg", 0.1)})
    with pytest.raises(InputError, match=r"two images with different poses have the name a\.jpg"):
        sfm.read_colmap_model(differing, tmp_path / "work")


def test_references_to_removed_points_are_left_out(tmp_path: Path) -> None:
    images = {1: ("a.jpg", 0.0), 2: ("b.jpg", 0.5)}
    points = "7 0 0 1 10 20 30 0.1 1 0 2 0\n"
    model = write_text_model(tmp_path / "model", images, points, seen="32 24 7 40 20 8")
    read = sfm.read_colmap_model(model, tmp_path / "work")
    assert read.points.tolist() == [[0, 0, 1]] and read.seen["a.jpg"].tolist() == [0]


def test_a_mask_with_separate_accents_in_its_name_belongs_to_its_photo(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    Image.new("L", (8, 6), 255).save(tmp_path / "masks" / "u\u0308.png")
    photo = Prepared("\u00fc.jpg", tmp_path / "copy.jpg", (8, 6), 1, ())
    assert read_mask(mask_files(tmp_path / "masks"), photo) is not None


def test_photos_of_12_bits_in_files_of_16_bits_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    noise = np.random.default_rng(0).integers(1300, 4096, (48, 64)).astype(np.uint16)
    Image.fromarray(noise).save(tmp_path / "photos/dark.png")
    Image.fromarray(noise * 16).save(tmp_path / "photos/right.png")
    good, rejected = prepare_photos(tmp_path / "photos", tmp_path / "out", max_size=100)
    assert [photo.name for photo in good] == ["right.png"]
    assert "its brightest pixel has 15 of 255" in rejected["dark.png"]
