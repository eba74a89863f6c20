"""Audit of a dataset from its files alone.

The masks in the manifest are the reference for all other files. First they are checked against the layouts, the scene
and each other: they must be exclusive, lie inside their silhouettes, have the stated boxes, areas and fractions, and
exceed the thresholds. Then every file of every format is read as its users read it, by pycocotools, pycolmap, OpenCV
and the logic of the BOP toolkit. Its content is compared with values recomputed from masks, cameras and poses
(:mod:`mitsplat.audit.truth`). The code that wrote the dataset is not used.

The manifest and the files that describe all frames are read in parallel, one frame at a time.
"""

from __future__ import annotations

import os
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.audit.bop_check import BopReader
from mitsplat.audit.described import InstancesReader, PanopticReader, PosesReader, Reader
from mitsplat.audit.layers_check import LayersReader, PlacementReader
from mitsplat.audit.listed import ColmapReader, LayoutReader, YoloReader
from mitsplat.audit.owned import OwnedFiles, check_listed
from mitsplat.audit.read_back import CHECKS, POLYGON_AREA, POLYGON_IOU, Violations, check_bop
from mitsplat.audit.scene_check import SceneReader
from mitsplat.audit.truth import TrueFrame
from mitsplat.dataset.schema import Records, read_content
from mitsplat.errors import InputError
from mitsplat.images.picture_files import read_picture
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import SPLITS, Record, splits_of

_FRACTION_TOLERANCE = 1e-5
"""Tolerance of fractions that are stored with six decimals."""

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
    root = Path(root)
    content = read_content(root)
    _refuse_special(root)
    records = Records(root, content)
    readers, cross_frame, owned = _readers(root, content), CrossFrameCheck(), OwnedFiles(content)
    violations: list[tuple[str, str]] = []
    marked, dropped = Counter[str](), Counter[str]()
    frames = instances = low = files = 0
    for record in records:
        visit(record)
        frame, found = TrueFrame.of(root, record, content), list(_check_files(root, record))
        damaged = {name for name, _ in found}
        violations += found
        violations += check_listed(record, content)
        violations += ((f"manifest.jsonl, frame {frame.index}", text) for text in _check_labels(frame))
        for file in record["files"]:
            check = next((check for prefix, check in CHECKS.items() if file.startswith(prefix)), None)
            if check is not None and file not in damaged:
                violations += ((file, text) for text in check(frame, root / file))
        violations += check_bop(frame, damaged)
        repeated = cross_frame.add(record)
        violations += repeated
        if not repeated:
            for reader in readers:
                violations += reader.check(frame)
        owned.add(record)
        frames, instances, files = frames + 1, instances + len(frame.instances), files + len(record["files"])
        low += sum(i.area > POLYGON_AREA and i.entry["polygon_iou"] < POLYGON_IOU for i in frame.instances)
        marked.update(mark for instance in frame.instances for mark in instance.entry["marks"])
        dropped.update(record["labels"]["dropped"])
    violations += records.violations
    for reader in readers:
        violations += reader.finish()
    violations += cross_frame.check(records)
    violations += owned.orphans(root)
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


def _readers(root: Path, content: Mapping[str, Any]) -> list[Reader]:
    """Create the readers of files that describe all frames, and the checks across frames and against the scene."""
    splits = splits_of(content["scene"]["output"])
    make: dict[str, Callable[[], list[Reader]]] = {
        "coco": lambda: [InstancesReader(root, content, "instances", split) for split in splits],
        "amodal": lambda: [InstancesReader(root, content, "amodal", split) for split in splits],
        "panoptic": lambda: [PanopticReader(root, content, split) for split in splits],
        "poses": lambda: [PosesReader(root, content, split) for split in splits],
        "bop": lambda: [BopReader(root, content)],
        "colmap": lambda: [ColmapReader(root)],
    }
    readers: list[Reader] = [
        SceneReader(content),
        LayoutReader(root, content),
        LayersReader(content),
        PlacementReader(),
    ]
    readers.append(YoloReader(root, content))
    for name in make:
        if name in content["scene"]["output"]["formats"]:
            readers += make[name]()
    return readers


def _check_files(root: Path, record: Record) -> Violations:
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


def _check_labels(frame: TrueFrame) -> Iterator[str]:
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
        if classes[label.kind] != entry["class"]:
            yield f"{name}: class {label.kind} is not {entry['class']!r}"
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
        fraction = label.area / label.amodal_area
        if abs(fraction - entry["visible_fraction"]) > _FRACTION_TOLERANCE:
            yield f"{name}: its visible fraction is {fraction:.6f}, not {entry['visible_fraction']}"
        truncation = 1 - label.amodal_area / label.silhouette_area
        if abs(truncation - entry["truncation"]) > _FRACTION_TOLERANCE:
            yield f"{name}: its truncation is {truncation:.6f}, not {entry['truncation']}"
        below = {"occluded": fraction < rules["min_visible"] - _FRACTION_TOLERANCE}
        below["disagreeing"] = entry["agreement"] < rules["min_agreement"] - _FRACTION_TOLERANCE
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
