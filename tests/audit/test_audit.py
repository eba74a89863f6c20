"""Dataset audit: no violations in a clean dataset; each inserted fault is reported although its checksum matches."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from pycocotools import mask as coco_mask

from mitsplat.audit.audit import POLYGON_AREA, POLYGON_IOU, CrossFrameCheck, audit_dataset
from mitsplat.errors import InputError
from mitsplat.storage.files import Record
from tests.cli.typed import run
from tests.manifests import records_of, store, store_lines


def first(records: list[Record]) -> Any:
    return records[0]["labels"]["instances"][0]


def decode(records: list[Record], label: Any, key: str = "rle") -> np.ndarray:
    width, height = records[0]["labels"]["size"]
    return np.asarray(coco_mask.decode({"size": [height, width], "counts": label[key]}))


def encode(mask: np.ndarray) -> str:
    return str(coco_mask.encode(np.asfortranarray(mask))["counts"].decode())


def test_a_clean_dataset_has_no_violations(clean: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = audit_dataset(clean)
    assert found.violations == ()
    assert found.frames == 6 and found.instances > 10
    assert run("audit", clean) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "violations: 0"


def test_counts_of_the_audit_are_those_of_the_manifest(dataset: Path) -> None:
    """Totals are compared with sums over the manifest, after values were changed that the clean dataset lacks."""
    records = records_of(dataset)
    labels = [label for record in records for label in record["labels"]["instances"]]
    for number, label in enumerate(labels):
        label |= {"polygon_iou": 0.5 if number % 3 else 1.0, "marks": ["occluded", "disagreeing"][: number % 3]}
    records[0]["labels"]["dropped"]["hidden"], records[1]["labels"]["dropped"]["hidden"] = 2, 3
    store(dataset, records)
    found = audit_dataset(dataset)
    low = [label["area"] > POLYGON_AREA and label["polygon_iou"] < POLYGON_IOU for label in labels]
    assert found.low_polygons == sum(low) != sum(label["area"] <= POLYGON_AREA for label in labels)
    assert (found.frames, found.instances) == (len(records), len(labels))
    assert found.files == sum(len(record["files"]) for record in records)
    marks = [label["marks"] for label in labels]
    assert found.marked == {mark: sum(mark in of for of in marks) for mark in ("occluded", "disagreeing")}
    assert found.dropped["hidden"] == 5
    assert found.dropped["fragments"] == sum(record["labels"]["dropped"]["fragments"] for record in records)


def lose_a_label(root: Path, records: list[Record]) -> None:
    path = root / "labels/train/000000.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))


def swap_a_class(root: Path, records: list[Record]) -> None:
    path = root / "labels/train/000000.txt"
    path.write_text(str(1 - int(path.read_text()[0])) + path.read_text()[1:])


def move_a_polygon(root: Path, records: list[Record]) -> None:
    path = root / "labels/train/000000.txt"
    head, *rest = path.read_text().splitlines()
    kind, *values = head.split()
    moved = [kind, *(f"{float(value) + (0.04 if i % 2 == 0 else 0):.6f}" for i, value in enumerate(values))]
    path.write_text("\n".join([" ".join(moved), *rest]) + "\n")


def fill_a_hole(root: Path, records: list[Record]) -> None:
    """Cut a hole into the mask in the manifest and leave the polygon unchanged."""
    label = first(records)
    mask = decode(records, label)
    x0, y0, x1, y1 = label["box"]
    mask[(y0 + y1) // 2 - 2 : (y0 + y1) // 2 + 3, (x0 + x1) // 2 - 2 : (x0 + x1) // 2 + 3] = 0
    label |= {"rle": encode(mask), "area": int(mask.sum())}
    label["visible_fraction"] = round(label["area"] / label["amodal_area"], 6)


def overlap_masks(root: Path, records: list[Record]) -> None:
    one, other = records[0]["labels"]["instances"][:2]
    other |= {key: one[key] for key in ("rle", "box", "area", "amodal_rle", "amodal_box", "amodal_area")}
    other |= {key: one[key] for key in ("silhouette_area", "silhouette_box", "visible_fraction", "truncation")}


def claim_visibility(root: Path, records: list[Record]) -> None:
    first(records)["visible_fraction"] = 0.5


def deny_truncation(root: Path, records: list[Record]) -> None:
    first(records)["silhouette_area"] += 100


def scale_a_pose(root: Path, records: list[Record]) -> None:
    first(records)["world_from_object"][0][0] = 1.5


def halve_measured_depths(root: Path, records: list[Record]) -> None:
    """Halve the depths of a sensor that misses the upper half of the image."""
    path = root / "depth-sensor/train/000000.png"
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) // 2
    picture[: len(picture) // 2] = 0
    cv2.imwrite(str(path), picture)


def merge_ids(root: Path, records: list[Record]) -> None:
    path = root / "instances/train/000000.png"
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    picture[picture == 2] = 1
    cv2.imwrite(str(path), picture)


def resize_an_image(root: Path, records: list[Record]) -> None:
    path = root / "images/train/000000.png"
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (32, 24)))


def repeat_an_image(root: Path, records: list[Record]) -> None:
    shutil.copyfile(root / "images/train/000000.png", root / "images/train/000001.png")


def leak_a_layout(root: Path, records: list[Record]) -> None:
    record = next(record for record in records if record["layout"] == records[0]["layout"] and record["view"] == 1)
    record["split"] = "val"


def paint_a_class(root: Path, records: list[Record]) -> None:
    path = root / "semantic/train/000000.png"
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), np.where(picture == 1, 2, picture).astype(np.uint8))


def erase_depth(root: Path, records: list[Record]) -> None:
    path = root / "depth/train/000000.png"
    cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def erode_a_bop_mask(root: Path, records: list[Record]) -> None:
    path = root / "bop/train/000000/mask_visib/000000_000000.png"
    cv2.imwrite(str(path), cv2.erode(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), np.ones((3, 3))))


def widen_a_box(root: Path, records: list[Record]) -> None:
    path = root / "yolo-detect/labels/train/000000.txt"
    values = path.read_text().split()
    path.write_text(path.read_text().replace(values[3], f"{float(values[3]) * 1.1:.6f}", 1))


def turn_a_rotated_box(root: Path, records: list[Record]) -> None:
    path = root / "yolo-obb/labels/train/000000.txt"
    kind, *values = path.read_text().splitlines()[0].split()
    turned = " ".join([kind, *(f"{float(value) + 0.02 * (i in (0, 4)):.6f}" for i, value in enumerate(values))])
    path.write_text("\n".join([turned, *path.read_text().splitlines()[1:]]) + "\n")


def flip_a_keypoint(root: Path, records: list[Record]) -> None:
    path = root / "yolo-pose/labels/train/000000.txt"
    head, *rest = path.read_text().splitlines()
    path.write_text("\n".join([head[:-1] + str((int(head[-1]) + 1) % 3), *rest]) + "\n")


def shift_segments(root: Path, records: list[Record]) -> None:
    path = root / "panoptic/train/000000.png"
    cv2.imwrite(str(path), np.roll(cv2.imread(str(path)), 3, axis=1))


def write_nan(root: Path, records: list[Record]) -> None:
    path = root / "yolo-obb/labels/train/000000.txt"
    values = path.read_text().split(" ")
    path.write_text(" ".join([values[0], "nan", *values[2:]]))


def shorten_a_line(root: Path, records: list[Record]) -> None:
    path = root / "yolo-detect/labels/train/000000.txt"
    head, *rest = path.read_text().splitlines()
    path.write_text("\n".join([" ".join(head.split()[:4]), *rest]) + "\n")


def forget_a_depth(root: Path, records: list[Record]) -> None:
    del records[0]["files"]["depth/train/000000.png"]


def forget_a_bop_mask(root: Path, records: list[Record]) -> None:
    del records[0]["files"]["bop/train/000000/mask/000000_000000.png"]


def claim_a_polygon(root: Path, records: list[Record]) -> None:
    first(records)["polygon_iou"] = 0.5


def claim_an_area(root: Path, records: list[Record]) -> None:
    first(records)["area"] += 1


def claim_a_full_area(root: Path, records: list[Record]) -> None:
    first(records)["amodal_area"] += 1


def shrink_a_silhouette(root: Path, records: list[Record]) -> None:
    """Remove the lowest row of an unoccluded instance from its silhouette only."""
    label = first(records)
    mask = decode(records, label, "amodal_rle")
    _, y0, _, y1 = label["amodal_box"]
    mask[y1 - 1] = 0
    columns = np.flatnonzero(mask.any(axis=0)).tolist()
    label["amodal_box"] = [columns[0], y0, columns[-1] + 1, y1 - 1]
    label |= {"amodal_rle": encode(mask), "amodal_area": int(mask.sum())}


def widen_a_silhouette(root: Path, records: list[Record]) -> None:
    first(records)["silhouette_box"][2] += 1


def repeat_an_id(root: Path, records: list[Record]) -> None:
    records[0]["labels"]["instances"][1]["id"] = 1


def rename_a_class(root: Path, records: list[Record]) -> None:
    label = first(records)
    label["class"] = {"nut": "bolt", "bolt": "nut"}[label["class"]]


def add_a_mark(root: Path, records: list[Record]) -> None:
    first(records)["marks"] = ["occluded"]


def change_rules(root: Path, **rules: float) -> None:
    content = json.loads((root / "dataset.json").read_text())
    content["scene"]["labels"] |= rules
    (root / "dataset.json").write_text(json.dumps(content))


def omit_an_occlusion_mark(root: Path, records: list[Record]) -> None:
    change_rules(root, min_visible=0.99)


def omit_a_disagreement_mark(root: Path, records: list[Record]) -> None:
    change_rules(root, min_agreement=0.9)
    first(records)["agreement"] = 0.89


def keep_small_instances(root: Path, records: list[Record]) -> None:
    change_rules(root, min_pixels=first(records)["area"] + 1)


def change_layout(root: Path, change: Callable[[list[Any]], object]) -> None:
    path = root / "layouts/0000.json"
    layout = json.loads(path.read_text())
    change(layout["instances"])
    path.write_text(json.dumps(layout))


def swap_an_asset_of_the_layout(root: Path, records: list[Record]) -> None:
    change_layout(root, lambda instances: instances[0].update(asset=1 - instances[0]["asset"]))


def add_to_the_layout(root: Path, records: list[Record]) -> None:
    change_layout(root, lambda instances: instances.append(instances[0] | {"id": 99}))


def remove_from_the_layout(root: Path, records: list[Record]) -> None:
    change_layout(root, lambda instances: instances.pop(0))


def drop_a_category(root: Path, records: list[Record]) -> None:
    path = root / "annotations/instances_train.json"
    content = json.loads(path.read_text())
    content["categories"].pop()
    path.write_text(json.dumps(content))


def invert_cameras(root: Path, records: list[Record]) -> None:
    for record in records:
        camera = record["camera"]
        camera["world_from_camera"] = np.linalg.inv(camera["world_from_camera"]).tolist()


def replace_first_line(path: Path, values: list[float]) -> None:
    head, *rest = path.read_text().splitlines()
    path.write_text("\n".join([" ".join([head.split()[0], *map(str, values)]), *rest]) + "\n")


def write_two_vertices(root: Path, records: list[Record]) -> None:
    replace_first_line(root / "labels/train/000000.txt", [0.1, 0.1, 0.2, 0.2])


def write_half_a_vertex(root: Path, records: list[Record]) -> None:
    replace_first_line(root / "labels/train/000000.txt", [0.1, 0.1, 0.2, 0.2, 0.1, 0.2, 0.3])


def leave_the_image(root: Path, records: list[Record]) -> None:
    replace_first_line(root / "labels/train/000000.txt", [0.1, 0.1, 1.01, 0.2, 0.1, 0.2])


def write_three_corners(root: Path, records: list[Record]) -> None:
    replace_first_line(root / "yolo-obb/labels/train/000000.txt", [0.1, 0.1, 0.2, 0.1, 0.2, 0.2])


def train_on_the_other_split(root: Path, records: list[Record]) -> None:
    path = root / "data.yaml"
    path.write_text(path.read_text().replace("train: images/train", "train: images/val"))


def swap_keypoint_names(root: Path, records: list[Record]) -> None:
    path = root / "yolo-pose/data.yaml"
    path.write_text(path.read_text().replace('"top"', '"bottom"', 1))


def model_in_metres(root: Path, records: list[Record]) -> None:
    path = root / "bop/models/obj_000001.ply"
    mesh = trimesh.load_mesh(path)
    mesh.apply_scale(0.001)
    mesh.export(path)


FAULTS: dict[Callable[[Path, list[Record]], None], tuple[str, str]] = {
    lose_a_label: ("labels/train/000000.txt", "lines for"),
    swap_a_class: ("labels/train/000000.txt", "class is"),
    move_a_polygon: ("labels/train/000000.txt", "does not reproduce its mask"),
    fill_a_hole: ("labels/train/000000.txt", "does not reproduce its mask"),
    overlap_masks: ("manifest.jsonl, frame 0", "belong to more than one instance"),
    claim_visibility: ("manifest.jsonl, frame 0", "its visible fraction is"),
    deny_truncation: ("manifest.jsonl, frame 0", "its truncation is"),
    scale_a_pose: ("manifest.jsonl, frame 0", "its pose is not a rotation"),
    halve_measured_depths: ("depth-sensor/train/000000.png", "depths have a median error of"),
    merge_ids: ("instances/train/000000.png", "pixels differ from the masks"),
    resize_an_image: ("images/train/000000.png", "is 32x24 px"),
    repeat_an_image: ("images/train/000001.png", "is the same picture as"),
    leak_a_layout: ("manifest.jsonl", "are in both train and val"),
    paint_a_class: ("semantic/train/000000.png", "differ from the masks' classes"),
    erase_depth: ("depth/train/000000.png", "have no depth"),
    erode_a_bop_mask: ("bop/train/000000/mask_visib/000000_000000.png", "differ from the manifest's mask"),
    widen_a_box: ("yolo-detect/labels/train/000000.txt", "does not match its box"),
    turn_a_rotated_box: ("yolo-obb/labels/train/000000.txt", "is no rectangle"),
    flip_a_keypoint: ("yolo-pose/labels/train/000000.txt", "keypoints differ"),
    write_nan: ("yolo-obb/labels/train/000000.txt", "not finite"),
    shorten_a_line: ("yolo-detect/labels/train/000000.txt", "does not match its box"),
    shift_segments: ("panoptic/train/000000.png", "differ from the masks"),
    forget_a_depth: ("manifest.jsonl, frame 0", "of the format depth"),
    forget_a_bop_mask: (
        "manifest.jsonl, frame 0",
        "does not list bop/train/000000/mask/000000_000000.png of the format bop",
    ),
    claim_a_polygon: ("labels/train/000000.txt", "the IoU of its polygon is"),
    claim_an_area: ("manifest.jsonl, frame 0", "do not match its mask"),
    claim_a_full_area: ("manifest.jsonl, frame 0", "do not match its mask"),
    shrink_a_silhouette: ("manifest.jsonl, frame 0", "pixels outside its silhouette"),
    widen_a_silhouette: ("manifest.jsonl, frame 0", "does not match its silhouette"),
    repeat_an_id: ("manifest.jsonl, frame 0", "instance 1 is labelled 2 times"),
    rename_a_class: ("manifest.jsonl, frame 0", "instance 1: class 1 is not 'bolt'"),
    add_a_mark: ("manifest.jsonl, frame 0", "its marks ['occluded'] do not match the thresholds"),
    omit_an_occlusion_mark: ("manifest.jsonl, frame 0", "instance 3: its marks [] do not match the thresholds"),
    omit_a_disagreement_mark: ("manifest.jsonl, frame 0", "instance 1: its marks [] do not match the thresholds"),
    keep_small_instances: ("manifest.jsonl, frame 0", "instance 1: has 104 pixels, fewer than 105"),
    swap_an_asset_of_the_layout: ("manifest.jsonl, frame 1", "instance 1 is of another asset or class than in layouts"),
    add_to_the_layout: ("manifest.jsonl, frame 1", "4 labels and 0 unlabelled instances are not all of layouts"),
    remove_from_the_layout: ("manifest.jsonl, frame 1", "instance 1 is not in layouts/0000.json"),
    drop_a_category: ("annotations/instances_train.json", "categories: there are 1, not 2"),
    invert_cameras: ("manifest.jsonl", "times their size away from its poses"),
    write_two_vertices: ("labels/train/000000.txt", "must have three or more vertices (got 4 numbers)"),
    write_half_a_vertex: ("labels/train/000000.txt", "must have three or more vertices (got 7 numbers)"),
    leave_the_image: ("labels/train/000000.txt", "its polygon leaves the image"),
    write_three_corners: ("yolo-obb/labels/train/000000.txt", "its line is not four corners"),
    train_on_the_other_split: ("data.yaml", "train is images/val, not images/train"),
    swap_keypoint_names: ("yolo-pose/data.yaml", "its keypoints are not"),
    model_in_metres: ("bop/models/models_info.json", "does not state the measures of bop/models/obj_000001.ply"),
}


@pytest.mark.parametrize("plant", FAULTS, ids=lambda plant: plant.__name__)
def test_each_planted_fault_is_a_violation(
    dataset: Path, plant: Callable[[Path, list[Record]], None], capsys: pytest.CaptureFixture[str]
) -> None:
    records = records_of(dataset)
    plant(dataset, records)
    store(dataset, records)
    assert run("audit", dataset) == 1
    file, text = FAULTS[plant]
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith(f"{file}: ") and text in line for line in lines), lines


@pytest.mark.parametrize("file", ["images/train/000000.png", "flow/train/000000.flo", "layers/train/000000.exr"])
def test_a_changed_or_missing_file_is_a_violation(dataset: Path, file: str) -> None:
    path = dataset / file
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert (file, "has another SHA-256 than the manifest states") in audit_dataset(dataset).violations
    path.unlink()
    assert (file, "is missing") in audit_dataset(dataset).violations


@pytest.mark.parametrize(
    ("file", "change", "place"),
    [
        ("annotations/instances_train.json", lambda c: c["annotations"][0]["bbox"].__setitem__(0, 1), "bbox is [1, "),
        ("annotations/instances_train.json", lambda c: c["annotations"][0].update(category_id=9), "category_id"),
        ("annotations/amodal_train.json", lambda c: c["annotations"].pop(), "annotations"),
        ("annotations/panoptic_train.json", lambda c: c["categories"][0].update(name="x"), "categories[0]: name"),
        (
            "annotations/panoptic_train.json",
            lambda c: c["annotations"][0]["segments_info"][0].update(id=[1]),
            "segments_info must be a list of segments",
        ),
        ("bop/train/000000/scene_gt.json", lambda c: c["0"][0]["cam_t_m2c"].__setitem__(2, 5.0), "cam_t_m2c is"),
        ("bop/train/000000/scene_gt_info.json", lambda c: c["0"][0].update(visib_fract=0.1), "visib_fract"),
    ],
)
def test_annotations_that_disagree_with_the_manifest_are_violations(
    dataset: Path, file: str, change: Callable[[Any], None], place: str
) -> None:
    content = json.loads((dataset / file).read_text())
    change(content)
    (dataset / file).write_text(json.dumps(content))
    (found,) = audit_dataset(dataset).violations
    assert found[0] == file and place in found[1]


def test_permuted_class_names_are_violations(dataset: Path) -> None:
    path = dataset / "data.yaml"
    path.write_text(path.read_text().replace("bolt", "x").replace("nut", "bolt").replace("x", "nut"))
    assert [file for file, _ in audit_dataset(dataset).violations] == ["data.yaml"]


@pytest.mark.parametrize("value", [None, 1e308, -1e9, "x", 10**400], ids=lambda value: str(value)[:9])
def test_polygons_outside_of_the_image_are_violations(dataset: Path, value: object) -> None:
    """pycocotools crashes on such numbers, or allocates memory for them."""
    path = dataset / "annotations/polygons_train.json"
    content = json.loads(path.read_text())
    content["annotations"][0]["segmentation"][0][2] = value
    path.write_text(json.dumps(content))
    texts = [text for _, text in audit_dataset(dataset).violations]
    assert any(text.endswith("segmentation is no mask that pycocotools reads") for text in texts), texts


@pytest.mark.parametrize("size", [(-1, -1), (2**31 - 1, 2**31 - 1), (4, 4)])
def test_flow_of_another_size_is_a_violation(dataset: Path, size: tuple[int, int]) -> None:
    """OpenCV crashes on negative sizes, and allocates memory for the size in the header."""
    file = "flow/train/000000.flo"
    (dataset / file).write_bytes(b"PIEH" + struct.pack("<ii", *size) + bytes(64))
    assert (file, "cannot be read as optical flow of the frame's size") in audit_dataset(dataset).violations


def test_deeply_nested_yaml_is_a_violation(dataset: Path) -> None:
    (dataset / "data.yaml").write_text("a: " + "[" * 20_000)
    ((file, text),) = audit_dataset(dataset).violations
    assert file == "data.yaml" and text.startswith("cannot be read")


def test_a_layout_without_objects_is_a_violation_if_there_are_labels(dataset: Path) -> None:
    path = dataset / "layouts/0000.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"instances": []}))
    texts = [text for _, text in audit_dataset(dataset).violations]
    assert any(text.endswith("is not in layouts/0000.json") for text in texts), texts


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("hold_out", 5), ("hold_out", {"assets": 5}), ("objects", 5), ("objects", [{"asset": "nut"}])),
        *(("conveyor", []), ("conveyor", {"belt": "belt", "speed": 0.1, "interval": "x"})),
        *(("conveyor", {"belt": "no shape", "speed": 0.1, "interval": 1.0}), ("shapes", None)),
    ],
    ids=str,
)
def test_a_dataset_of_a_damaged_scene_is_refused(dataset: Path, key: str, value: object) -> None:
    content = json.loads((dataset / "dataset.json").read_text())
    content["scene"][key] = value
    (dataset / "dataset.json").write_text(json.dumps(content))
    with pytest.raises(
        InputError, match=rf"must be a dataset of this version of mitsplat \(dataset\.json: scene\.{key}"
    ):
        audit_dataset(dataset)


STRAY = (
    *("annotations/instances_test.json", "bop/models/obj_000009.ply", "bop/train/000000/mask/000000_000009.png"),
    *(
        "bop/train/000000/rgb/000099.png",
        "bop/train/000009/scene_gt.json",
        "colmap/images.txt",
        "depth/train/000099.png",
    ),
    *("flow/train/000001.flo", "images/train/000099.png", "images/val/000000.png", "instances/train/000099.png"),
    *("labels/train/000099.txt", "layers/train/000099.exr", "layouts/0009.json", "normals/train/000099.png"),
    *("panoptic/train/000099.png", "semantic/train/000099.png"),
    *("yolo-detect/labels/train/000099.txt", "yolo-obb/images/train/000099.png"),
    "yolo-pose/images/train/000099.png",
)
"""Files that belong to no frame, in the folder of every format. The dataset has no COLMAP cameras."""


def test_files_of_no_frame_are_violations(dataset: Path) -> None:
    for file in STRAY:
        (dataset / file).parent.mkdir(parents=True, exist_ok=True)
        (dataset / file).write_text("")
    (dataset / "labels/train.cache").write_text("")  # cache file written by Ultralytics
    (dataset / "notes.txt").write_text("mine")
    found = audit_dataset(dataset).violations
    assert found == tuple((file, "belongs to no frame of the manifest") for file in STRAY)


WHOLE = (
    *(
        f"annotations/{n}_{s}.json"
        for n in ("instances", "polygons", "amodal", "panoptic", "poses")
        for s in ("train", "val")
    ),
    *("data.yaml", "yolo-detect/data.yaml", "yolo-obb/data.yaml", "yolo-pose/data.yaml"),
    *("layouts/0000.json", "layouts/0002.json"),
    *(f"bop/train/000000/scene_{part}.json" for part in ("camera", "gt", "gt_info")),
    *("bop/camera.json", "bop/models/models_info.json", "bop/models/obj_000001.ply", "contact_sheet.jpg"),
)


def test_missing_files_that_describe_frames_are_violations(dataset: Path) -> None:
    for file in WHOLE:
        (dataset / file).unlink()
    found = dict(audit_dataset(dataset).violations)
    assert set(found) == set(WHOLE)
    assert all(text.startswith("is missing") for text in found.values())


@pytest.mark.parametrize(
    "damage", [b"", b"{", b"null", b"[1, 2]", b'{"images": 3, "annotations": [3], "frames": [{}]}', b"\xff"]
)
def test_damaged_annotations_are_one_violation_per_file(dataset: Path, damage: bytes) -> None:
    """Each damaged file gives one violation and no traceback, for any content."""
    files = [file for file in WHOLE if file.endswith((".json", ".yaml", ".txt"))]
    for file in files:
        (dataset / file).write_bytes(damage)
    found = {file for file, _ in audit_dataset(dataset).violations}
    assert set(files) <= found


def test_entries_of_no_frame_are_violations(dataset: Path) -> None:
    """Extra entries are reported at the end and in the middle of a file, and as duplicates."""
    for name in ("annotations/instances_val.json", "annotations/panoptic_train.json", "annotations/poses_train.json"):
        content = json.loads((dataset / name).read_text())
        entries = content["frames" if "poses" in name else "annotations"]
        copied = json.loads(json.dumps(entries[-1]))
        copied["id" if "poses" in name else "image_id"] = 77
        entries.append(copied)
        (dataset / name).write_text(json.dumps(content))
    gt = dataset / "bop/train/000000/scene_gt.json"
    gt.write_text(gt.read_text().replace('"1": ', '"0": '))
    found = audit_dataset(dataset).violations
    text = "has an entry of frame 77, which the manifest does not have at this position"
    for name in ("annotations/instances_val.json", "annotations/panoptic_train.json", "annotations/poses_train.json"):
        assert (name, text) in found
    assert ("bop/train/000000/scene_gt.json", "has 2 entries of frame 0") in found
    assert ("bop/train/000000/scene_gt.json", "has 0 entries of frame 1") in found
    assert ("annotations/instances_val.json", "id 4 is not above those before it") not in found


def test_a_damaged_manifest_is_a_violation(dataset: Path) -> None:
    with (dataset / "manifest.jsonl").open("a") as file:
        file.write('{"index": 7}\n')
    (found,) = [text for file, text in audit_dataset(dataset).violations]
    assert found.startswith("line 7 is not the record of a frame")


@pytest.mark.parametrize(
    ("keys", "value", "text"),
    [
        (("labels", "instances", 0, "box"), [0, 0, 0, 0], "instance 1: rle: its box must lie in the image"),
        (("labels", "instances", 0, "amodal_box"), [0, 0, 1000, 9], "amodal_rle: its box must lie in the image"),
        (("labels", "instances", 0, "rle"), "", "must be a complete run-length code of a mask in its box (got '' for"),
        (("labels", "instances", 0, "rle"), "1", "must be a complete run-length code of a mask in its box"),
        (("labels", "instances", 0, "silhouette_area"), 0, "silhouette_area: Input should be greater"),
        (("labels", "instances", 0, "class_index"), 2, "class_index must be below 2 (got 2)"),
        (("labels", "instances", 0, "asset"), 9, "asset must be below 2 (got 9)"),
        (("labels", "instances", 0, "keypoints"), [[1.0, 1.0, 2.0]] * 3, "keypoints must be those of its class"),
        (("labels", "size"), [32, 24], "labels.size must be the camera's"),
        (("camera", "intrinsics"), [[1.0]], "camera.intrinsics"),
        (("environment",), None, "environment must be a segment"),
        (("depth_scale",), None, "depth_scale must be stated"),
        (("files",), {}, "files must list the frame's image"),
        (("split",), "test", "split must be among the dataset's (got test)"),
        (("split",), "exam", "split: Input should be 'train', 'val' or 'test'"),
    ],
)
def test_an_invalid_manifest_record_is_one_violation(
    dataset: Path, keys: tuple[Any, ...], value: Any, text: str
) -> None:
    records = records_of(dataset)
    place: Any = records[0]
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    store_lines(dataset, records)
    found = [violation for file, violation in audit_dataset(dataset).violations if file == "manifest.jsonl"]
    assert len(found) == 1 and found[0].startswith("line 1 is not the record of a frame (") and text in found[0]


def test_a_folder_without_a_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be a dataset of mitsplat"):
        audit_dataset(tmp_path)
    (tmp_path / "dataset.json").write_text('{"mitsplat": "0.0.1", "scene": {}}')
    with pytest.raises(InputError, match="must be a dataset of this version of mitsplat"):
        audit_dataset(tmp_path)


@pytest.mark.parametrize(("instances", "violations"), [([], 0), ([{"id": 1}], 1)])
def test_identical_images_are_a_violation_only_if_they_show_objects(instances: list[Any], violations: int) -> None:
    """Empty layouts under a fixed camera give identical images of the environment."""
    records = [
        {
            "index": index,
            "layout": index,
            "split": "train",
            "files": {f"images/train/{index:06d}.png": "ab" * 32},
            "labels": {"instances": instances},
        }
        for index in range(2)
    ]
    check = CrossFrameCheck()
    for record in records:
        assert check.add(record) == []
    assert len(list(check.check(records))) == violations
