"""Datasets of frames rendered from Python: valid ones pass the audit, unsupported ones are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mitsplat.audit import audit_dataset
from mitsplat.dataset.folds import write_folds
from mitsplat.dataset.python_frames import write_frames
from mitsplat.errors import InputError
from mitsplat.frames.sequence import render_frames
from mitsplat.geometry.camera import Camera
from mitsplat.scene.layout import Layout
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.camera_spec import Motion
from mitsplat.scene.spec.scene_spec import FORMATS
from mitsplat.scene.spec.shape_spec import Conveyor
from mitsplat.scene.splits import split_of
from tests.conftest import BOTH, small_scene
from tests.drawn import large_boxes
from tests.manifests import records_of


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return a small scene in every format except flow, COLMAP and depth-sensor.

    Given frames have layouts and cameras of their own.
    """
    formats = [name for name in FORMATS if name not in ("flow", "colmap", "depth-sensor")]
    return small_scene(tmp_path_factory.mktemp("scene"), large_boxes(), BOTH, layouts=1, views=4, formats=formats)


def film(scene: Scene, count: int = 3, width: int = 64) -> list:
    """Render frames of a moving nut, with a camera above it that is not one of the scene's."""
    layouts = []
    for step in range(count):
        pose = np.eye(4)
        pose[:3, 3] = 0.05 + 0.01 * step, 0, 0.02
        layouts.append(Layout.from_poses(scene, {"nut": [pose], "bolt": [np.diag([1, -1, -1, 1])]}))
    above = Camera.look_at((0, -0.05, 0.5), (0, 0, 0), width=width, height=48, fov_x=40)
    return list(render_frames(scene, layouts=layouts, cameras=above, quality="fast", progress=False))


@pytest.fixture(scope="module")
def frames(scene: Scene) -> list:
    return film(scene)


def test_given_frames_have_no_violations_in_every_format(scene: Scene, frames: list, tmp_path: Path) -> None:
    summary = write_frames(scene, tmp_path / "out", iter(frames))
    assert summary.frames == 3
    assert summary.instances == {"bolt": 3, "nut": 3}
    assert summary.images == {"train": 2, "val": 1}
    assert list(audit_dataset(tmp_path / "out").violations) == []
    records = records_of(tmp_path / "out")
    assert [record["layout"] for record in records] == [0, 1, 2]
    poses = [label["world_from_object"] for label in records[2]["labels"]["instances"] if label["class"] == "nut"]
    assert poses[0][0][3] == pytest.approx(0.07)


def test_frames_of_equal_poses_are_of_one_split(scene: Scene, frames: list, tmp_path: Path) -> None:
    """Two cameras that see the same objects in the same places must not be in training and validation."""
    aside = Camera.look_at((0.02, -0.05, 0.5), (0, 0, 0), width=64, height=48, fov_x=40)
    layouts = [frame.layout for frame in frames]
    beside = list(render_frames(scene, layouts=layouts, cameras=aside, quality="fast", progress=False))
    rig = [frame for pair in zip(frames, beside, strict=True) for frame in pair]
    summary = write_frames(scene, tmp_path / "out", rig)
    splits = [record["split"] for record in records_of(tmp_path / "out")]
    assert splits == [split_of(step, scene.spec.output) for step in (0, 0, 1, 1, 2, 2)]
    assert summary.images == {"train": 4, "val": 2}
    with pytest.raises(InputError, match=r"folds must be 2 to 3, the layouts of different poses of .* \(got 4\)"):
        write_folds(tmp_path / "out", 4)
    assert [fold.images for fold in write_folds(tmp_path / "out", 3)] == [2, 2, 2]
    for fold in (1, 2, 3):
        names = (tmp_path / f"out/fold{fold}_val.txt").read_text().split()
        one, other = sorted(int(Path(name).stem) for name in names)
        assert one % 2 == 0 and other == one + 1
    assert list(audit_dataset(tmp_path / "out").violations) == []
    (tmp_path / "out/layouts/0002.json").write_text("{}")
    with pytest.raises(InputError, match=r"layouts/0002\.json: must be the layout of a finished dataset \(KeyError"):
        write_folds(tmp_path / "out", 3)


def test_frames_without_objects_are_spread_over_splits_and_folds(scene: Scene, frames: list, tmp_path: Path) -> None:
    """Their poses are equal because there are none; one split with all of them would leave the others without any."""
    empty = Layout.from_poses(scene, {})
    background = next(render_frames(scene, layouts=empty, quality="fast", progress=False))
    write_frames(scene, tmp_path / "out", [*[background] * 4, frames[0], frames[0]])
    splits = [record["split"] for record in records_of(tmp_path / "out")]
    assert splits == [split_of(layout, scene.spec.output) for layout in (0, 1, 2, 3, 4, 4)]
    assert sorted(fold.images for fold in write_folds(tmp_path / "out", 5)) == [1, 1, 1, 1, 2]


def test_folds_of_frames_of_one_arrangement_are_refused(scene: Scene, frames: list, tmp_path: Path) -> None:
    write_frames(scene, tmp_path / "out", [frames[0]] * 3)
    reason = r"must have at least 2 layouts of different poses to be divided into folds \(got 1\)"
    with pytest.raises(InputError, match=reason):
        write_folds(tmp_path / "out", 2)


def test_the_manifest_records_the_exposure_of_the_camera(scene: Scene, tmp_path: Path) -> None:
    motion = Motion(exposure=(0.01, 0.01))
    camera = scene.spec.camera.model_copy(update={"motion": motion})
    scene = replace(scene, spec=scene.spec.model_copy(update={"camera": camera}))
    layout = Layout.from_poses(scene, {"nut": [np.eye(4)], "bolt": [np.diag([1, -1, -1, 1])]})
    frame = next(render_frames(scene, layouts=layout, quality="fast", progress=False))
    out = write_frames(scene, tmp_path / "out", [frame]).path
    (record,) = records_of(out)
    assert record["viewpoint"] == {"motion": json.loads(json.dumps(frame.plan.viewpoint["motion"]))}
    assert list(audit_dataset(out).violations) == []


def test_given_frames_that_differ_from_their_layouts_are_violations(scene: Scene, frames: list, tmp_path: Path) -> None:
    out = write_frames(scene, tmp_path / "out", frames).path
    (out / "layouts/0001.json").write_bytes((out / "layouts/0002.json").read_bytes())
    assert any("layouts/0001.json" in str(one) for one in audit_dataset(out).violations)


def test_invalid_given_frames_are_refused_in_one_sentence(scene: Scene, frames: list, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least one frame"):
        write_frames(scene, tmp_path / "none", [])
    with pytest.raises(InputError, match="already holds a dataset"):
        write_frames(scene, tmp_path / "none", frames)
    with pytest.raises(InputError, match="frame 0: must be of the scene's 64x48 px"):
        write_frames(scene, tmp_path / "wide", film(scene, 1, width=80))
    output = scene.spec.output.model_copy(update={"formats": ("flow",)})
    belt = Conveyor(belt="belt", speed=0.1, interval=0.1)
    flowing = replace(scene, spec=scene.spec.model_copy(update={"output": output, "conveyor": belt}))
    with pytest.raises(InputError, match="flow is not available for frames made in Python of a scene with a conveyor"):
        write_frames(flowing, tmp_path / "flow", frames)


def test_the_flow_of_a_film_is_written_and_audited(scene: Scene, frames: list, tmp_path: Path) -> None:
    """Flow leads to the next frame of the dataset: not from the last one, nor to a frame of another film."""
    output = scene.spec.output.model_copy(update={"formats": ("flow", "exr")})
    scene = replace(scene, spec=scene.spec.model_copy(update={"output": output}))
    aside = Camera.look_at((0.02, -0.05, 0.5), (0, 0, 0), width=64, height=48, fov_x=40)
    (other,) = render_frames(scene, layouts=[frames[0].layout], cameras=aside, quality="fast", progress=False)
    out = write_frames(scene, tmp_path / "out", [*frames, other]).path
    files = [f"flow/{split_of(n, output)}/{n:06d}.flo" for n in range(4)]
    assert [(out / file).is_file() for file in files] == [True, True, False, False]
    assert list(audit_dataset(out).violations) == []
    records = records_of(out)
    assert [record.get("next") for record in records] == [1, 2, None, None]
    # A flow in which the nut stands still contradicts the poses of the manifest.
    flow = cv2.readOpticalFlow(str(out / files[0]))
    assert np.abs(flow[frames[0].instance == frames[0].layout.instances[0].id, 0]).min() > 0.5
    cv2.writeOpticalFlow(str(out / files[0]), np.where(np.abs(flow) < 1e9, 0, flow).astype(np.float32))
    assert any("have a flow that contradicts depth and cameras" in text for _, text in audit_dataset(out).violations)
