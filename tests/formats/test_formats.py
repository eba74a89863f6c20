"""Round trip of every format: adversarial frames are written, and rasterising each file gives the same masks."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import trimesh
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from ruamel.yaml import YAML

from mitsplat.errors import InputError
from mitsplat.formats import bop, coco, maps
from mitsplat.formats.registry import Catalogue, CollectionWriter, write_frame
from mitsplat.formats.yolo import rotated_box
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import Silhouette
from mitsplat.labels.flow import optical_flow
from mitsplat.labels.labels import HIDDEN, VISIBLE, LabelRules, Truth, label_instances
from mitsplat.labels.polygons import fill_polygon
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.spec.image_spec import StereoSensor
from mitsplat.scene.spec.scene_spec import FORMATS
from mitsplat.storage.files import Record
from tests.labels.test_labels import Seen, read_yolo, resample, whole
from tests.synthetic import CERTIFICATE, frame_around

WIDTH, HEIGHT = 160, 120
CLASSES = ("bolt", "nut")
KEYPOINTS = (("head", "tip"), ("middle",))
POINTS = {0: np.array([[0.0, 0, 0], [0, 0, -0.05]]), 1: np.array([[0.01, 0, 0]])}
LENS = {"fy": 150.0, "cx": 76.0, "cy": 63.0}
"""Pixels that are not square, and a principal point beside the middle."""
CAMERA = replace(Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=WIDTH, height=HEIGHT, fov_x=60), **LENS)
LATER_CAMERA = Camera.look_at((0.1, 0, 1), (0, 0, 0), up=(0, 1, 0), width=WIDTH, height=HEIGHT, fov_x=50)
"""Camera of the frames from index 8 on."""


def disc(ids: np.ndarray, centre: tuple[int, int], radius: int, value: int) -> np.ndarray:
    return cv2.circle(ids, centre, radius, value, cv2.FILLED)


@dataclass(frozen=True)
class Drawn:
    """Instances drawn one over the other, with the ground truth of covered and of visible pixels."""

    covered: dict[int, tuple[np.ndarray, int, int]]

    @property
    def ids(self) -> np.ndarray:
        ids = np.zeros((HEIGHT, WIDTH), dtype=np.uint16)
        for number, (mask, x, y) in self.covered.items():
            ids[Silhouette.cropped(mask, x, y).image_mask(WIDTH, HEIGHT)] = number
        return ids


def shape(draw: Any, *, margin: int = 60) -> tuple[np.ndarray, int, int]:
    """Draw a mask on a canvas that extends ``margin`` pixels beyond the image."""
    canvas = np.zeros((HEIGHT + 2 * margin, WIDTH + 2 * margin), dtype=np.int32)
    draw(canvas, margin)
    return canvas > 0, -margin, -margin


def filled_disc(x: int, y: int, radius: int, hole: int = 0) -> tuple[np.ndarray, int, int]:
    def draw(canvas: np.ndarray, margin: int) -> None:
        disc(canvas, (x + margin, y + margin), radius, 1)
        if hole:
            disc(canvas, (x + margin, y + margin), hole, 0)

    return shape(draw)


def block(x0: int, y0: int, x1: int, y1: int) -> tuple[np.ndarray, int, int]:
    return np.ones((y1 - y0, x1 - x0), dtype=bool), x0, y0


def crowd() -> dict[int, tuple[np.ndarray, int, int]]:
    return {1 + i: block(4 + i % 15 * 10, 6 + i // 15 * 13, 11 + i % 15 * 10, 16 + i // 15 * 13) for i in range(120)}


LAYOUTS = {
    "donut around a bolt": {1: filled_disc(80, 60, 45, 25), 2: filled_disc(82, 61, 12)},
    "cut by the border": {1: filled_disc(5, 60, 30), 2: filled_disc(158, 118, 25), 3: filled_disc(80, -10, 20)},
    "seen through a hole": {1: filled_disc(80, 60, 30), 2: filled_disc(80, 60, 50, 15)},
    "two of a class touch": {1: block(20, 20, 60, 60), 3: block(60, 30, 100, 70)},
    "a sliver of three pixels": {1: block(40, 40, 70, 43), 2: block(40, 43, 90, 80)},
    "hidden entirely": {1: block(50, 50, 60, 60), 2: filled_disc(55, 55, 30)},
    "a hundred and twenty": crowd(),
    "ids of sixteen bits": {255: block(5, 5, 40, 40), 256: block(50, 5, 90, 40), 65535: block(100, 60, 150, 110)},
    "cut in two": {1: block(20, 40, 140, 60), 2: block(70, 20, 90, 100)},
    "nothing": {},
}


def frame_of(drawn: Drawn, index: int, *, rules: LabelRules | None = None) -> Any:
    """Build the frame that a renderer would make of the drawing."""
    ids, camera = drawn.ids, CAMERA if index < 8 else LATER_CAMERA
    rng = np.random.default_rng(index)
    instances = []
    for number in drawn.covered:
        pose = trimesh.transformations.random_rotation_matrix(rng.random(3))
        pose[:3, 3] = rng.uniform((-0.6, -0.6, -0.3), (0.6, 0.6, 0.3))
        instances.append(Seen(number, (number - 1) % 2, pose, (number - 1) % 2))
    silhouettes = {number: Silhouette.cropped(mask, x, y) for number, (mask, x, y) in drawn.covered.items()}
    depth = np.where(ids > 0, 0.8, 1.0).astype(np.float32)
    labels = label_instances(
        Truth(ids, ids, silhouettes, depth), instances, CLASSES, rules or LabelRules(), camera=camera, keypoints=POINTS
    )
    pose = camera.world_from_camera.copy()
    pose[:3, 3] += 0.05 * pose[:3, 0]
    plan = SimpleNamespace(
        index=index,
        layout=index // 2,
        view=index % 2,
        split="train" if index % 4 < 2 else "val",
        camera=camera,
        next_camera=replace(camera, world_from_camera=pose),
        lights=(),
        draws={},
        seed=index,
        viewpoint={},
        belt=None,
    )
    return frame_around(
        plan,
        Layout(index // 2, tuple(instances), CERTIFICATE),
        labels,
        image=rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8),
        ids=ids,
        depth=depth,
        normal=np.broadcast_to(np.float32([0, -0.6, 0.8]), (HEIGHT, WIDTH, 3)) * (ids > 0)[..., None],
    )


@dataclass(frozen=True)
class Written:
    """Dataset of all layouts in all formats."""

    root: Path
    frames: list[Any]
    records: list[Record]

    @property
    def pairs(self) -> list[tuple[Any, Record]]:
        return list(zip(self.frames, self.records, strict=True))


MESHES = [trimesh.creation.box(extents=(0.02, 0.03, 0.05)), trimesh.creation.icosphere(radius=0.02)]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    root = tmp_path_factory.mktemp("formats")
    spec = SimpleNamespace(
        output=SimpleNamespace(formats=FORMATS, image="png", views=2),
        labels=SimpleNamespace(source="splats"),
        empty=0.0,
        all_regions=((None, ("drop",)),),
        environment=None,
        shapes=(),
        objects=(),
        background=None,
    )
    sensor = StereoSensor(noise=0, shift=0, step=1e-4, range=(0.9, 2))
    catalogue = Catalogue(CLASSES, KEYPOINTS, ("bolt", "nut"), MESHES, depth_sensor=sensor)
    frames = [frame_of(Drawn(covered), index) for index, covered in enumerate(LAYOUTS.values())]
    records = [write_frame(frame, root, spec, catalogue) for frame in frames]  # type: ignore[arg-type]
    with CollectionWriter(root, catalogue, FORMATS) as collection:
        for record in records:
            collection.add(record)
        collection.commit()
    return Written(root, frames, records)


def masks(frame: Any) -> list[np.ndarray]:
    return [whole(label, (HEIGHT, WIDTH)) for label in frame.labels.instances]


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.count_nonzero(one & other) / np.count_nonzero(one | other))


def png(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None, path
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB) if picture.ndim == 3 else picture


def test_the_drawn_layouts_have_their_stated_occlusions(written: Written) -> None:
    by_name = dict(zip(LAYOUTS, written.frames, strict=True))
    assert [label.truncation > 0.3 for label in by_name["cut by the border"].labels.instances] == [True] * 3
    assert by_name["seen through a hole"].labels.instances[0].visible_fraction < 0.4
    assert by_name["hidden entirely"].labels.dropped["hidden"] == 1
    assert len(by_name["a hundred and twenty"].labels.instances) == 120
    assert [label.id for label in by_name["ids of sixteen bits"].labels.instances] == [255, 256, 65535]
    sliver = by_name["a sliver of three pixels"].labels.instances[0]
    assert sliver.box[3] - sliver.box[1] == 3
    for frame in written.frames:
        shown = np.zeros((HEIGHT, WIDTH), dtype=int)
        for mask in masks(frame):
            shown += mask
        np.testing.assert_array_equal(shown, frame.instance > 0)


class TestYolo:
    def test_segments_fill_to_the_masks(self, written: Written) -> None:
        for frame, record in written.pairs:
            text = (written.root / f"labels/{record['split']}/{record['index']:06d}.txt").read_text()
            if not frame.labels.instances:
                assert text == ""
                continue
            classes, boxes, read = read_yolo(text, WIDTH, HEIGHT)
            for label, mask, kind, box, back in zip(
                frame.labels.instances, masks(frame), classes, boxes, read, strict=True
            ):
                assert kind == label.class_index
                np.testing.assert_allclose(box, label.box, atol=0.03)
                assert not (mask & ~back).any()
                if cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)[0] == 2:
                    assert iou(mask, back) >= 0.99
                else:  # readers also fill the bridge that crosses the occluder
                    assert np.count_nonzero(back & ~mask) <= 20

    def test_boxes_equal_those_of_the_labels(self, written: Written) -> None:
        for frame, rows in self.rows(written, "yolo-detect"):
            for label, (kind, x, y, width, height) in zip(frame.labels.instances, rows, strict=True):
                assert kind == label.class_index
                size = np.array([WIDTH, HEIGHT, WIDTH, HEIGHT])
                box = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2]) * size
                np.testing.assert_allclose(box, label.box, atol=1e-3)

    def test_rotated_boxes_hold_the_mask_and_are_smallest(self, written: Written) -> None:
        for frame, rows in self.rows(written, "yolo-obb"):
            for label, mask, row in zip(frame.labels.instances, masks(frame), rows, strict=True):
                corners = np.array(row[1:]).reshape(4, 2) * (WIDTH, HEIGHT)
                middle, size, _ = cv2.minAreaRect(corners.astype(np.float32))  # as Ultralytics reads rotated boxes
                assert 0 <= middle[0] <= WIDTH and 0 <= middle[1] <= HEIGHT
                x0, y0, x1, y1 = label.box
                assert np.prod(size) <= (x1 - x0) * (y1 - y0) + 0.5
                ys, xs = np.nonzero(mask)
                for x, y in zip(xs, ys, strict=True):
                    assert cv2.pointPolygonTest(corners.astype(np.float32), (x + 0.5, y + 0.5), True) >= 0.45

    def test_a_rotated_bar_has_a_rotated_box_of_its_size(self) -> None:
        ids = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        cv2.fillPoly(ids, [cv2.boxPoints(((80, 60), (80, 20), 30)).astype(np.int32)], 1)
        frame = frame_of(Drawn({1: (ids > 0, 0, 0)}), 0)
        _, size, _ = cv2.minAreaRect(
            rotated_box(frame.labels.instances[0], np.array([WIDTH, HEIGHT])).astype(np.float32)
        )
        np.testing.assert_allclose(sorted(size), (21, 81), atol=1.5)

    def test_rotated_boxes_of_bars_through_the_image_fit_into_it(self) -> None:
        """Ultralytics drops the whole image if the upright bounds of a rotated box are larger than it."""
        size = np.array([WIDTH, HEIGHT])
        for points, thickness, is_upright in (
            (((-20, -20), (180, 140)), 20, False),
            (((-30, 150), (190, -30)), 6, False),
            (((0, 0), (160, 120)), 110, True),
        ):
            ids = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
            cv2.line(ids, *points, 1, thickness)
            (label,) = frame_of(Drawn({1: (ids > 0, 0, 0)}), 0).labels.instances
            corners = rotated_box(label, size)
            assert (np.ptp(corners, axis=0) <= size + 1e-6).all()
            if is_upright:
                np.testing.assert_allclose([*corners.min(axis=0), *corners.max(axis=0)], label.box, atol=1e-6)
                continue
            one, other, *_ = sides = np.roll(corners, -1, axis=0) - corners
            np.testing.assert_allclose(sides[2:], [-one, -other], atol=1e-6)  # a rectangle
            assert one @ other == pytest.approx(0, abs=1e-3)
            middle, extents, _ = cv2.minAreaRect(corners.astype(np.float32))
            assert min(extents) == pytest.approx(thickness, abs=3)
            assert max(extents) > 150
            np.testing.assert_allclose(middle, size / 2, atol=6)
            assert (np.ptp(corners, axis=0) / size).max() == pytest.approx(1)

    def test_keypoints_have_position_and_visibility(self, written: Written) -> None:
        seen = set()
        for frame, rows in self.rows(written, "yolo-pose"):
            for label, row in zip(frame.labels.instances, rows, strict=True):
                assert len(row) == 5 + 3 * 2
                points = np.array(row[5:]).reshape(2, 3)
                pose = label.world_from_object
                expected, _ = frame.camera.project(POINTS[label.asset] @ pose[:3, :3].T + pose[:3, 3])
                for (x, y, visibility), place in zip(points, expected, strict=False):
                    seen.add(int(visibility))
                    if visibility:
                        np.testing.assert_allclose((x * WIDTH, y * HEIGHT), place, atol=0.01)
                    else:
                        assert (x, y) == (0, 0)
                        assert not (0 <= place[0] < WIDTH and 0 <= place[1] < HEIGHT)
                if label.class_index == 1:
                    np.testing.assert_array_equal(points[1], 0)
        assert seen >= {0, 1}
        data = YAML(typ="safe").load(written.root / "yolo-pose/data.yaml")
        assert data["kpt_shape"] == [2, 3]
        assert data["kpt_names"] == {0: ["head", "tip"], 1: ["middle", "unused_1"]}

    def test_a_keypoint_is_hidden_by_meshes_and_by_surroundings_in_front_of_it(self) -> None:
        ids = np.full((HEIGHT, WIDTH), 1, dtype=np.uint16)
        silhouettes = {1: Silhouette.cropped(ids == 1, 0, 0)}
        pose = np.eye(4)
        pose[2, 3] = 0.1  # 0.9 m in front of the camera
        middle = slice(HEIGHT // 2 - 5, HEIGHT // 2 + 5), slice(WIDTH // 2 - 5, WIDTH // 2 + 5)
        covered, half_covered = ids.copy(), ids.copy()
        covered[middle] = 0
        half_covered[middle[0], WIDTH // 2 :] = 0
        for shown, nearest, blocked, expected in (
            (ids, 0.9, [False, False], [VISIBLE, VISIBLE]),
            (ids, 0.5, [False, False], [VISIBLE, VISIBLE]),  # other objects have meshes
            (ids, 0.9, [False, True], [VISIBLE, HIDDEN]),
            (covered, 0.5, [False, False], [HIDDEN, HIDDEN]),
            (covered, 2.0, [False, False], [VISIBLE, VISIBLE]),
            (covered, 0.0, [False, False], [VISIBLE, VISIBLE]),
            (half_covered, 0.5, [False, False], [VISIBLE, VISIBLE]),
        ):
            truth = Truth(shown, shown, silhouettes, np.full((HEIGHT, WIDTH), nearest))
            labels = label_instances(
                *(truth, [Seen(1, 0, pose)], CLASSES, LabelRules()),
                camera=CAMERA,
                keypoints=POINTS,
                blocked={1: np.array(blocked)},
            )
            assert labels.instances[0].keypoints[:, 2].tolist() == expected

    @pytest.mark.parametrize("task", ["yolo-detect", "yolo-obb", "yolo-pose"])
    def test_images_lie_beside_the_labels(self, written: Written, task: str) -> None:
        for record in written.records:
            name = f"images/{record['split']}/{record['index']:06d}.png"
            assert (written.root / task / name).read_bytes() == (written.root / name).read_bytes()
            assert record["files"][f"{task}/{name}"] == record["files"][name]

    @staticmethod
    def rows(written: Written, task: str) -> list[tuple[Any, list[list[float]]]]:
        files = [written.root / f"{task}/labels/{r['split']}/{r['index']:06d}.txt" for r in written.records]
        rows = [[[float(v) for v in line.split()] for line in file.read_text().splitlines()] for file in files]
        return list(zip(written.frames, rows, strict=True))


class TestCoco:
    @pytest.mark.parametrize("name", ["instances", "polygons", "amodal"])
    def test_pycocotools_reads_the_masks_of_the_labels(self, written: Written, name: str) -> None:
        for split in ("train", "val"):
            read = COCO(written.root / f"annotations/{name}_{split}.json")
            read.info()
            assert read.dataset["licenses"] == []
            for frame, record in written.pairs:
                if record["split"] != split:
                    continue
                for label, entry in zip(frame.labels.instances, read.imgToAnns[frame.index], strict=True):
                    visible = whole(label, (HEIGHT, WIDTH))
                    expected = label.amodal.image_mask(WIDTH, HEIGHT) if name == "amodal" else visible
                    np.testing.assert_array_equal(read.annToMask(entry), expected)
                    assert isinstance(entry["segmentation"], list) == (name == "polygons")
                    np.testing.assert_array_equal(coco_mask.toBbox(read.annToRLE(entry)), entry["bbox"])
                    assert (entry["area"], entry["category_id"]) == (expected.sum(), label.class_index + 1)
                    points, pose = np.reshape(entry["keypoints"], (-1, 3)), label.world_from_object
                    labelled = points[:, 2] > 0
                    assert entry["num_keypoints"] == np.count_nonzero(labelled)  # hidden ones too
                    places, _ = frame.camera.project(POINTS[label.asset] @ pose[:3, :3].T + pose[:3, 3])
                    np.testing.assert_allclose(points[labelled, :2], places[labelled], atol=0.01)
                    assert not points[~labelled].any()
                    if name == "amodal":
                        np.testing.assert_array_equal(
                            coco_mask.decode(entry["visible_segmentation"]), whole(label, (HEIGHT, WIDTH))
                        )
            assert read.cats[1]["keypoints"] == ["head", "tip"]

    def test_panoptic_annotations_agree_with_their_picture(self, written: Written) -> None:
        """panopticapi's rules hold: image and annotation have the same ids, and areas are pixel counts."""
        for split in ("train", "val"):
            content = json.loads((written.root / f"annotations/panoptic_{split}.json").read_text())
            kinds = {category["id"]: category for category in content["categories"]}
            by_image = {entry["image_id"]: entry for entry in content["annotations"]}
            for frame, record in written.pairs:
                if record["split"] != split:
                    continue
                entry = by_image[frame.index]
                picture = png(written.root / "panoptic" / split / entry["file_name"]).astype(np.uint32)
                ids = picture[..., 0] + 256 * picture[..., 1] + 256**2 * picture[..., 2]
                segments = {segment["id"]: segment for segment in entry["segments_info"]}
                assert set(np.unique(ids)) - {0} == set(segments)
                for number, segment in segments.items():
                    assert segment["area"] == np.count_nonzero(ids == number)
                for label, mask in zip(frame.labels.instances, masks(frame), strict=True):
                    np.testing.assert_array_equal(ids == label.id, mask)
                    assert segments[label.id]["category_id"] == label.class_index + 1
                (stuff,) = (s for s in segments.values() if not kinds[s["category_id"]]["isthing"])
                np.testing.assert_array_equal(ids == stuff["id"], frame.instance == 0)

    def test_the_environment_segment_has_the_bounds_of_its_pixels(self) -> None:
        frame = frame_of(Drawn({1: block(0, 0, 160, 80), 2: block(0, 80, 30, 120), 3: block(100, 80, 160, 120)}), 0)
        environment = coco.environment_segment(frame.labels, frame.instance)
        assert environment == {"id": 4, "area": 70 * 40, "box": [30, 80, 100, 120]}

    def test_poses_equal_those_of_the_labels(self, written: Written) -> None:
        content = json.loads((written.root / "annotations/poses_train.json").read_text())
        frames = {entry["id"]: entry for entry in content["frames"]}
        for frame, record in written.pairs:
            if record["split"] == "train":
                for label, entry in zip(frame.labels.instances, frames[frame.index]["instances"], strict=True):
                    expected = frame.camera.camera_from_world @ label.world_from_object
                    np.testing.assert_allclose(entry["camera_from_object"], expected, atol=1e-12)
                    assert entry["object"] == label.asset


class TestBop:
    """BOP output against docs/bop_datasets_format.md and scripts/calc_gt_info.py of the BOP toolkit."""

    def test_scenes_have_cameras_poses_masks_and_depth_of_the_frames(self, written: Written) -> None:
        for frame, record in written.pairs:
            folder = written.root / f"bop/{record['split']}/{record['layout']:06d}"
            camera, gt, info = (
                json.loads((folder / f"scene_{part}.json").read_text())[str(frame.index)]
                for part in ("camera", "gt", "gt_info")
            )
            depth = png(folder / f"depth/{frame.index:06d}.png") * camera["depth_scale"]
            np.testing.assert_allclose(depth, 1000 * frame.depth, atol=camera["depth_scale"] / 2 + 1e-3)
            assert (folder / f"rgb/{frame.index:06d}.png").is_file()
            intrinsics = np.array(camera["cam_K"]).reshape(3, 3)
            for position, (label, pose, entry) in enumerate(zip(frame.labels.instances, gt, info, strict=True)):
                silhouette = label.amodal.image_mask(WIDTH, HEIGHT)
                mask = png(folder / f"mask/{frame.index:06d}_{position:06d}.png")
                visible = png(folder / f"mask_visib/{frame.index:06d}_{position:06d}.png")
                assert set(np.unique(visible)) <= {0, 255}
                np.testing.assert_array_equal(mask > 0, silhouette)
                np.testing.assert_array_equal(visible > 0, whole(label, (HEIGHT, WIDTH)))
                assert entry["px_count_visib"] == np.count_nonzero(visible)
                assert entry["px_count_valid"] == np.count_nonzero(depth[silhouette] > 0)
                assert entry["px_count_all"] == label.silhouette_area >= np.count_nonzero(mask)
                assert entry["visib_fract"] == entry["px_count_visib"] / entry["px_count_all"]
                assert entry["bbox_visib"] == self.bbox(visible > 0)
                if label.truncation == 0:
                    assert entry["bbox_obj"] == self.bbox(silhouette)
                rotation, shift = np.array(pose["cam_R_m2c"]).reshape(3, 3), np.array(pose["cam_t_m2c"])
                points = MESHES[pose["obj_id"] - 1].vertices
                local = 1000 * points @ rotation.T + shift
                projected = local @ intrinsics.T
                expected, _ = frame.camera.project(trimesh.transform_points(points, label.world_from_object))
                np.testing.assert_allclose(projected[:, :2] / projected[:, 2:] + 0.5, expected, atol=1e-6)

    @staticmethod
    def bbox(mask: np.ndarray) -> list[int]:
        """Compute a bounding box by the rule of misc.calc_2d_bbox."""
        ys, xs = mask.nonzero()
        return [int(xs.min()), int(ys.min()), int(xs.max() - xs.min()), int(ys.max() - ys.min())]

    def test_the_camera_of_the_dataset_is_that_of_the_first_frame(self, written: Written) -> None:
        """Its keys are those that bop_toolkit_lib.inout.load_cam_params reads."""
        camera = json.loads((written.root / "bop/camera.json").read_text())
        assert camera.keys() == {"cx", "cy", "depth_scale", "fx", "fy", "height", "width"}
        assert (camera["width"], camera["height"]) == (WIDTH, HEIGHT)
        scene = json.loads((written.root / "bop/train/000000/scene_camera.json").read_text())["0"]
        (fx, _, cx), (_, fy, cy), _ = np.reshape(scene["cam_K"], (3, 3))
        assert (camera["fx"], camera["fy"], camera["cx"], camera["cy"]) == (fx, fy, cx, cy)
        assert camera["depth_scale"] == scene["depth_scale"]
        assert (fx, fy, cx, cy) == (CAMERA.fx, CAMERA.fy, CAMERA.cx - 0.5, CAMERA.cy - 0.5)

    def test_a_frame_of_a_distorted_lens_is_refused(self, written: Written) -> None:
        """Frames made in Python can have any camera, but BOP has no distortion."""
        camera = replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0))
        frame = SimpleNamespace(index=3, camera=camera, labels=written.frames[0].labels)
        with pytest.raises(InputError, match=r"^frame 3: bop must have a camera without lens distortion \(got \[0\.1"):
            bop.write(SimpleNamespace(frame=frame))  # type: ignore[arg-type]

    def test_a_second_visit_of_a_scene_is_refused(self, written: Written, tmp_path: Path) -> None:
        """Its files would replace those of the first visit, and labels would be lost."""
        writer = bop.ScenesWriter(tmp_path, Catalogue(CLASSES, KEYPOINTS, ("bolt", "nut"), MESHES))
        for index in (0, 2, 4):  # layouts 0, 1 and 2
            writer.add(written.records[index])
        with pytest.raises(ValueError, match=r"must be added by ascending layout \(got 1 after 2\)"):
            writer.add(written.records[3])
        writer.discard()

    def test_models_are_in_millimetres_with_their_extents(self, written: Written) -> None:
        info = json.loads((written.root / "bop/models/models_info.json").read_text())
        for number, mesh in enumerate(MESHES, start=1):
            back = trimesh.load_mesh(written.root / f"bop/models/obj_{number:06d}.ply")
            np.testing.assert_allclose(back.bounds, 1000 * mesh.bounds, atol=1e-3)
            head = (written.root / f"bop/models/obj_{number:06d}.ply").read_text().split("end_header")[0]
            assert re.findall(r"property float (\w+)", head) == ["x", "y", "z", "nx", "ny", "nz"]  # normals for shading
            distances = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices[None], axis=-1)
            assert info[str(number)]["diameter"] == pytest.approx(1000 * distances.max())
            assert info[str(number)]["size_y"] == pytest.approx(1000 * mesh.extents[1])


class TestMaps:
    def test_instance_and_semantic_maps_equal_the_labels(self, written: Written) -> None:
        for frame, record in written.pairs:
            name = f"{record['split']}/{frame.index:06d}.png"
            instances, semantic = png(written.root / "instances" / name), png(written.root / "semantic" / name)
            assert instances.dtype == np.uint16
            np.testing.assert_array_equal(instances, frame.instance)
            expected = np.where(frame.instance > 0, (frame.instance.astype(int) - 1) % 2 + 1, 0)
            np.testing.assert_array_equal(semantic, expected)

    def test_pixels_without_a_label_are_ignored_not_background(self) -> None:
        frame = frame_of(Drawn({1: block(10, 10, 12, 12), 2: block(40, 40, 60, 60)}), 0)
        assert frame.labels.dropped["small"] == 1
        semantic = maps.semantic_picture(frame.labels, frame.instance, CLASSES)
        assert (semantic[10, 10], semantic[50, 50], semantic[0, 0]) == (255, 2, 0)
        assert maps.instance_picture(frame.labels)[10, 10] == 0
        environment = coco.environment_segment(frame.labels, frame.instance)
        assert environment is not None
        picture = coco.panoptic_image(maps.instance_picture(frame.labels), frame.instance, environment)
        assert picture[10, 10].tolist() == [0, 0, 0]
        assert picture[0, 0].tolist() == [environment["id"], 0, 0]

    def test_depth_and_normal_maps_equal_the_frame(self, written: Written) -> None:
        for frame, record in written.pairs:
            name = f"{record['split']}/{frame.index:06d}.png"
            assert record["depth_scale"] == 0.1
            np.testing.assert_array_equal(png(written.root / "depth" / name), np.where(frame.instance > 0, 8000, 10000))
            assert record["depth_sensor_scale"] == 0.1
            measured = png(written.root / "depth-sensor" / name)
            assert not measured[frame.instance > 0].any()  # nearer than the sensor's range
            assert set(np.unique(measured)) == {0, 10000}
            normals = png(written.root / "normals" / name)
            assert (normals[frame.instance > 0] == [32768, 13107, 58982]).all()
            assert (normals[frame.instance == 0] == 0).all()

    def test_exr_layers_equal_the_frame(self, written: Written) -> None:
        for frame, record in written.pairs:
            path = written.root / f"layers/{record['split']}/{frame.index:06d}.exr"
            with OpenEXR.File(str(path), separate_channels=True) as file:
                pixels = {name: channel.pixels for name, channel in file.channels().items()}
            np.testing.assert_array_equal(pixels["instance"], frame.instance)
            np.testing.assert_array_equal(pixels["Z"], frame.depth)

    @pytest.mark.parametrize(
        ("farthest", "scale"), [(6.5534, 0.1), (6.5536, 1.0), (65.534, 1.0), (65.536, 10.0), (9e9, 100.0)]
    )
    def test_the_depth_scale_fits_the_largest_depth(self, farthest: float, scale: float) -> None:
        depth = np.array([[0.0, 0.00001, farthest]])
        assert maps.depth_scale(depth) == scale
        assert maps.depth_picture(depth).tolist()[0][:2] == [0, 1]

    def test_flow_of_a_plane_before_a_camera_that_moves_sideways(self, written: Written) -> None:
        """A camera that moves by b parallel to a plane at depth z shifts the plane's image by -f b / z."""
        for frame, record in written.pairs:
            flow = cv2.readOpticalFlow(str(written.root / f"flow/{record['split']}/{frame.index:06d}.flo"))
            assert flow.shape == (HEIGHT, WIDTH, 2)
            np.testing.assert_allclose(flow[..., 0], -frame.camera.fx * 0.05 / frame.depth, rtol=1e-4)
            np.testing.assert_allclose(flow[..., 1], 0, atol=1e-4)

    def test_flow_is_unknown_where_depth_is_missing(self) -> None:
        flow = optical_flow(np.array([[0.0, 1.0]]), CAMERA.resized(2, 1), CAMERA.resized(2, 1))
        assert (np.abs(flow[0, 0]) > 1e9).all()
        np.testing.assert_allclose(flow[0, 1], 0, atol=1e-5)


def test_pycolmap_reads_the_cameras_of_the_frames(written: Written) -> None:
    code = (
        "import zlib, sys, json, pycolmap\n"
        "model = pycolmap.Reconstruction(sys.argv[1])\n"
        "print(json.dumps([[i.name, i.cam_from_world().matrix().tolist(), i.camera.calibration_matrix().tolist()]"
        " for i in model.images.values()]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(written.root / "colmap")], capture_output=True, text=True, check=True
    )
    images = {name: (np.array(pose), np.array(intrinsics)) for name, pose, intrinsics in json.loads(done.stdout)}
    assert len(images) == len(written.records)
    for frame, record in written.pairs:
        pose, intrinsics = images[f"{record['split']}/{record['index']:06d}.png"]
        np.testing.assert_allclose(pose, frame.camera.camera_from_world[:3], atol=1e-12)
        np.testing.assert_allclose(intrinsics, frame.camera.intrinsics)


class TestCatalogue:
    def test_bop_refuses_lens_distortion(self, scene_data: dict[str, Any], write_scene: Any) -> None:
        scene_data["output"]["formats"] = ["bop"]
        scene_data["camera"]["intrinsics"] = {"fov_x": 60, "distortion": [0.1, 0, 0, 0]}
        with pytest.raises(InputError, match=r"bop must have a camera without lens distortion \(got \[0\.1"):
            Catalogue.of(load_scene(write_scene(scene_data)))

    def test_pose_labels_need_keypoints(self, scene_data: dict[str, Any], write_scene: Any) -> None:
        scene_data["output"]["formats"] = ["yolo-pose"]
        path = write_scene(scene_data)
        with pytest.raises(InputError, match="yolo-pose needs an asset with keypoints"):
            Catalogue.of(load_scene(path))
        manual = path.parent / "assets/nut/asset.yaml"
        manual.write_text(manual.read_text() + "keypoints: {top: [0, 0, 0.005]}\n")
        assert Catalogue.of(load_scene(path)).keypoint_names == ((), ("top",))

    def test_assets_of_a_class_with_different_keypoints_are_refused(
        self, scene_data: dict[str, Any], write_scene: Any
    ) -> None:
        scene_data["objects"] = [
            {"asset": "assets/nut", "class_name": "a"},
            {"asset": "assets/bolt", "class_name": "a"},
        ]
        path = write_scene(scene_data)
        manual = path.parent / "assets/nut/asset.yaml"
        manual.write_text(manual.read_text() + "keypoints: {top: [0, 0, 0.005]}\n")
        with pytest.raises(InputError, match=r"class 'a' must define the same keypoints \(got \['top'\] in nut"):
            Catalogue.of(load_scene(path))


def test_polygons_of_visible_parts_survive_resampling() -> None:
    """IoU is at least 0.99 for instances of more than 200 pixels in one part.

    An instance cut into parts needs a bridge across the occluder.
    """
    for covered in LAYOUTS.values():
        for label in frame_of(Drawn(covered), 0).labels.instances:
            mask = whole(label, (HEIGHT, WIDTH))
            parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)[0] - 1
            points = resample(label.polygon.astype(np.float32), max(1000, len(label.polygon) + 1))
            if label.area > 200 and parts == 1:
                assert iou(fill_polygon(points, WIDTH, HEIGHT), mask) >= 0.99
