"""Audit of a dataset from its files alone.

The masks in the manifest are the reference for all other files. First they are checked against the layouts, the scene
and each other: they must be exclusive, lie inside their silhouettes, have the stated boxes, areas and fractions, and
exceed the thresholds. Then every file of every format is read as its users read it, by pycocotools, pycolmap, OpenCV
and the logic of the BOP toolkit. Its content is compared with values recomputed from masks, cameras and poses
(:mod:`mitsplat.audit.decoded_frame`). The code that wrote the dataset is not used.

The manifest and the files that describe all frames are read in parallel, one frame at a time.
"""

from __future__ import annotations

import os
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsplat.arguments import path_of
from mitsplat.arrays import Float64Array
from mitsplat.audit import picture_check, yolo_check
from mitsplat.audit.bop_check import BopCheck
from mitsplat.audit.coco_check import InstancesCheck, PanopticCheck, PosesCheck
from mitsplat.audit.colmap_check import ColmapCheck
from mitsplat.audit.dataset_check import FRACTION_TOLERANCE, DatasetCheck, Violation, Violations
from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.audit.expected_files import ExpectedFiles
from mitsplat.audit.layers_check import LayersCheck, PlacementCheck
from mitsplat.audit.layout_check import LayoutCheck
from mitsplat.audit.scene_check import SceneCheck
from mitsplat.audit.yolo_check import POLYGON_AREA, POLYGON_IOU, DataYamlCheck
from mitsplat.dataset.records.record_schema import Records, read_content
from mitsplat.errors import InputError
from mitsplat.images.picture_files import read_picture
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import SPLITS, JsonObject, Record, splits_of

_FILE_CHECKS = {**picture_check.CHECKS, **yolo_check.CHECKS}

__all__ = ["POLYGON_AREA", "POLYGON_IOU", "Audit", "audit_dataset"]


@dataclass(frozen=True)
class Audit:
    """Result of an audit.

    Attributes:
        frames, instances, files: Numbers of checked frames, instances and files.
        violations: File and description of each violation.
        low_polygons: Number of masks of more than :data:`POLYGON_AREA` pixels whose polygon has an IoU below
            :data:`POLYGON_IOU` because bridges join their parts.
        marked: Number of instances below a threshold, by mark.
        dropped: Number of unlabelled instances, by reason.
    """

    frames: int
    instances: int
    files: int
    violations: tuple[tuple[str, str], ...]
    low_polygons: int
    marked: dict[str, int]
    dropped: dict[str, int]


def audit_dataset(root: str | Path, visit: Callable[[Record], object] = lambda record: None) -> Audit:
    """Check every file of a dataset.

    Args:
        root: Dataset folder.
        visit: Callback that is called with every readable record, by ascending index.

    Raises:
        InputError: If the folder is no dataset of mitsplat.
    """
    root = path_of(root, "root")
    content = read_content(root)
    _refuse_special(root)
    records = Records(root, content)
    checks, cross_frame, expected = _create_checks(root, content), CrossFrameCheck(), ExpectedFiles(content)
    violations: list[Violation] = []
    marked, dropped = Counter[str](), Counter[str]()
    frames = instances = low = files = 0
    for record in records:
        visit(record)
        frame, damaged = DecodedFrame(root, record, content), dict(_check_hashes(root, record))
        violations += damaged.items()
        violations += expected.check_record(record)
        violations += ((f"manifest.jsonl, frame {frame.index}", text) for text in _check_labels(frame))
        for file in record["files"]:
            check_file = next((check for folder, check in _FILE_CHECKS.items() if file.startswith(folder)), None)
            if check_file is not None and file not in damaged:
                violations += ((file, text) for text in check_file(frame, root / file))
        repeated = cross_frame.add(record)
        violations += repeated
        if not repeated:
            for check in checks:
                violations += check.check(frame)
        frames, instances, files = frames + 1, instances + len(frame.instances), files + len(record["files"])
        low += sum(i.area > POLYGON_AREA and i.entry["polygon_iou"] < POLYGON_IOU for i in frame.instances)
        marked.update(mark for instance in frame.instances for mark in instance.entry["marks"])
        dropped.update(record["labels"]["dropped"])
    violations += records.violations
    for check in checks:
        violations += check.finish()
    violations += cross_frame.check(records)
    violations += expected.check_folders(root)
    violations += _check_rest(root)
    return Audit(frames, instances, files, tuple(violations), low, dict(marked), dict(dropped))


def _refuse_special(root: Path) -> None:
    """Refuse special files, such as pipes, because reading them could block forever.

    Raises:
        InputError: With the first one.
    """
    for folder, _, _ in os.walk(root):
        with os.scandir(folder) as entries:
            for entry in entries:
                if not entry.is_file() and not entry.is_dir() and os.access(entry.path, os.F_OK):
                    raise InputError(f"{entry.path}: must be a regular file or a folder")


def _create_checks(root: Path, content: JsonObject) -> list[DatasetCheck]:
    """Create the checks of files that describe all frames, and the checks across frames and against the scene."""
    output = content["scene"]["output"]
    splits = splits_of(output)
    by_format: dict[str, Callable[[], list[DatasetCheck]]] = {
        "coco": lambda: [InstancesCheck(root, content, "instances", split) for split in splits],
        "coco-polygons": lambda: [InstancesCheck(root, content, "polygons", split) for split in splits],
        "amodal": lambda: [InstancesCheck(root, content, "amodal", split) for split in splits],
        "panoptic": lambda: [PanopticCheck(root, content, split) for split in splits],
        "poses": lambda: [PosesCheck(root, content, split) for split in splits],
        "bop": lambda: [BopCheck(root, content)],
        "colmap": lambda: [ColmapCheck(root)],
    }
    return [
        SceneCheck(content),
        LayoutCheck(root, content),
        LayersCheck(content),
        PlacementCheck(),
        DataYamlCheck(root, content),
        *(check for name, create in by_format.items() if name in output["formats"] for check in create()),
    ]


def _check_hashes(root: Path, record: Record) -> Violations:
    for file, digest in record["files"].items():
        if not (root / file).is_file():
            yield file, "is missing"
            continue
        if file_hash(root / file) != digest:
            yield file, "has another SHA-256 than the manifest states"


def _check_rest(root: Path) -> Violations:
    """Check the files that belong to no format."""
    sheet = root / "contact_sheet.jpg"
    if not sheet.is_file() or read_picture(sheet) is None:
        yield sheet.name, "is missing or cannot be read as an image"
    if not any((root / "scene").glob("*")):
        yield "scene", "must contain the scene file"


def _check_labels(frame: DecodedFrame) -> Iterator[str]:
    """Check that the labels of a frame are consistent."""
    classes, rules = frame.content["classes"], frame.content["scene"]["labels"]
    for number, count in Counter(label.id for label in frame.instances).items():
        if count > 1:
            yield f"instance {number} is labelled {count} times"
    times = np.zeros(frame.size[::-1], dtype=np.uint16)
    for label in frame.instances:
        entry, name = label.entry, label.name
        mask, amodal = frame.full_mask(label), frame.full_mask(label, amodal=True)
        times += mask
        if classes[label.class_index] != entry["class"]:
            yield f"{name}: class {label.class_index} is not {entry['class']!r}"
        for key, box, area, stated in (
            ("box", label.box, label.area, entry["area"]),
            ("amodal_box", label.amodal_box, label.amodal_area, entry["amodal_area"]),
        ):
            if list(box) != entry[key] or area != stated:
                yield f"{name}: {key} {entry[key]} and area {stated} do not match its mask"
        if (mask & ~amodal).any():
            yield f"{name}: its mask has pixels outside its silhouette"
        if label.amodal_area > label.silhouette_area:
            yield f"{name}: its silhouette_area is below the number of its pixels in the image"
        x0, y0, x1, y1 = entry["silhouette_box"]
        left, top, right, bottom = label.amodal_box
        if not (x0 <= left and y0 <= top and x1 >= right and y1 >= bottom) or (
            label.amodal_area == label.silhouette_area and (x0, y0, x1, y1) != label.amodal_box
        ):
            yield f"{name}: silhouette_box {entry['silhouette_box']} does not match its silhouette"
        if abs(label.visible_fraction - entry["visible_fraction"]) > FRACTION_TOLERANCE:
            yield f"{name}: its visible fraction is {label.visible_fraction:.6f}, not {entry['visible_fraction']}"
        if abs(label.truncation - entry["truncation"]) > FRACTION_TOLERANCE:
            yield f"{name}: its truncation is {label.truncation:.6f}, not {entry['truncation']}"
        below = {"occluded": label.visible_fraction < rules["min_visible"] - FRACTION_TOLERANCE}
        below["disagreeing"] = entry["agreement"] < rules["min_agreement"] - FRACTION_TOLERANCE
        if set(entry["marks"]) != {mark for mark, is_below in below.items() if is_below}:
            yield f"{name}: its marks {entry['marks']} do not match the thresholds"
        if label.area < rules["min_pixels"]:
            yield f"{name}: has {label.area} pixels, fewer than {rules['min_pixels']}"
        if not _is_rigid(label.pose):
            yield f"{name}: its pose is not a rotation and a translation"
    if (times > 1).any():
        yield f"{np.count_nonzero(times > 1)} pixels belong to more than one instance"


class CrossFrameCheck:
    """Checks across frames: repeated frames or pictures, and layouts in two splits; 16 bytes per frame."""

    def __init__(self) -> None:
        self._last = -1
        self._splits, self._pictures = array("Q"), array("Q")

    def add(self, record: Record) -> list[tuple[str, str]]:
        """Add a frame; return a violation if the frame has a line already."""
        self._splits.append(len(SPLITS) * record["layout"] + SPLITS.index(record["split"]))
        self._pictures.append(_picture(record) or 0)
        repeated = record["index"] == self._last
        self._last = record["index"]
        return [("manifest.jsonl", f"frame {record['index']} has several lines")] if repeated else []

    def check(self, records: Records) -> Violations:
        """Yield the violations after all frames were added."""
        places = np.unique(np.array(self._splits, dtype=np.uint64)).astype(np.int64)
        layouts = places // len(SPLITS)
        for layout in np.unique(layouts[1:][layouts[1:] == layouts[:-1]]):
            found = [SPLITS[place % len(SPLITS)] for place in places[layouts == layout]]
            yield "manifest.jsonl", f"views of layout {layout} are in both {' and '.join(found)}"
        pictures, counts = np.unique(np.array(self._pictures, dtype=np.uint64), return_counts=True)
        same = {int(picture) for picture in pictures[counts > 1]} - {0}
        first: dict[int, str] = {}
        for record in records if same else ():
            if (picture := _picture(record)) in same:
                file = next(file for file in record["files"] if file.startswith("images/"))
                if (other := first.setdefault(picture, file)) != file:
                    yield file, f"is the same picture as {other}"


def _picture(record: Record) -> int:
    """Return the first 64 bits of the picture's SHA-256.

    The value is 0 if the stored text is no SHA-256, or if the frame is empty. Empty layouts under a fixed camera have
    equal pictures, which is no fault.
    """
    if not record["labels"]["instances"]:
        return 0
    digest = next(digest for file, digest in record["files"].items() if file.startswith("images/"))
    try:
        return int(digest[:16], 16)
    except ValueError:
        return 0


def _is_rigid(pose: Float64Array) -> bool:
    rotation = pose[:3, :3]
    return bool(
        pose.shape == (4, 4)
        and np.isfinite(pose).all()
        and np.abs(rotation).max() < 2  # products of larger values may overflow
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-5
        and np.linalg.det(rotation) > 0
        and (pose[3] == (0, 0, 0, 1)).all()
    )
