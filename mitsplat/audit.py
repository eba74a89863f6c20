"""Re-check a dataset from its files alone.

The manifest's masks are the truth that every other file must agree with. They are checked for what any labels must be:
exclusive, inside their silhouettes, of the stated boxes, areas and shares, above the stated thresholds. Then every file
of every format is read back the way its users do, and rasterised where it draws: polygons and pictures of ids.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pycocotools import mask as coco_mask

from mitsplat import bop
from mitsplat.coco import camera_of, image_file
from mitsplat.errors import InputError
from mitsplat.files import Record
from mitsplat.label import InstanceLabel, Labels
from mitsplat.maps import instance_picture
from mitsplat.outline import fill_polygon
from mitsplat.writers import Catalogue, write_collection
from mitsplat.yolo import TASKS, rotated_box

POLYGON_IOU = 0.99
"""Least IoU of a mask in one part and its polygon, for masks of more than :data:`POLYGON_AREA` pixels."""
POLYGON_AREA = 200

_ROUNDED_PIXELS = 4
"""Pixels by which a polygon read from text may differ from the outline of its mask."""
_ROUNDED = 0.01
"""Distance that six decimals and OpenCV's rectangles may move a position [px]."""
_SHARE = 1e-5
"""Difference of shares that are stored with six decimals."""

Violations = Iterator[tuple[str, str]]
"""File, relative to the dataset, and what is wrong with it."""


@dataclass(frozen=True)
class Audit:
    """What an audit found.

    Attributes:
        frames, instances, files: How many were checked.
        violations: File and sentence of each.
        low_polygons: Masks of more than :data:`POLYGON_AREA` pixels whose polygon is below :data:`POLYGON_IOU` because
            bridges join their parts.
        marked: Instances below a threshold, by mark.
        dropped: What was not labelled, by reason.
    """

    frames: int
    instances: int
    files: int
    violations: tuple[tuple[str, str], ...]
    low_polygons: int
    marked: dict[str, int]
    dropped: dict[str, int]


def audit_dataset(root: str | Path) -> Audit:
    """Check every file of a dataset.

    Raises:
        InputError: If the folder is no dataset of mitsplat.
    """
    root = Path(root)
    content = read_content(root)
    records, violations = read_records(root)
    marked, dropped = Counter[str](), Counter[str]()
    instances = low = files = 0
    for record in records:
        labels, file = Labels.from_json(record["labels"]), image_file(record)
        where = f"manifest.jsonl, frame {record['index']}"
        found = list(_check_files(root, record))
        missing = {name for name, _ in found}
        violations += found
        violations += ((where, text) for text in _check_labels(record, labels, content))
        frame = _Frame(root, record, labels, content)
        for prefix, check in _CHECKS.items():
            for name in sorted(name for name in record["files"] if name.startswith(prefix) and name not in missing):
                violations += ((name, text) for text in check(frame, root / name))
        if file not in missing:
            violations += ((file, text) for text in _check_image(frame, root / file))
        violations += _check_bop(frame)
        instances += len(labels.instances)
        files += len(record["files"])
        low += sum(label.area > POLYGON_AREA and label.polygon_iou < POLYGON_IOU for label in labels.instances)
        marked.update(mark for label in labels.instances for mark in label.marks)
        dropped.update(labels.dropped)
    violations += _check_whole(root, records)
    violations += _check_collection(root, records, content)
    return Audit(len(records), instances, files, tuple(violations), low, dict(marked), dict(dropped))


@dataclass(frozen=True, eq=False)
class _Frame:
    root: Path
    record: Record
    labels: Labels
    content: Mapping[str, Any]

    def whole(self, label: InstanceLabel, *, amodal: bool = False) -> npt.NDArray[np.bool_]:
        canvas = np.zeros((self.labels.height, self.labels.width), dtype=bool)
        x0, y0, x1, y1 = label.amodal.box if amodal else label.box
        canvas[y0:y1, x0:x1] = label.amodal.mask if amodal else label.mask
        return canvas


def read_content(root: Path) -> dict[str, Any]:
    """What decides a dataset's bytes, ``dataset.json``.

    Raises:
        InputError: If the folder is no dataset of mitsplat, or one of a version before labels were audited.
    """
    try:
        content: dict[str, Any] = json.loads((root / "dataset.json").read_bytes())
        present = {"mitsplat", "scene", "classes", "keypoints", "assets"} <= set(content) and "labels" in content[
            "scene"
        ]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{root} must be a dataset of mitsplat (dataset.json: {error})") from error
    if not present or not (root / "manifest.jsonl").is_file():
        raise InputError(f"{root} must be a dataset of this version of mitsplat, with dataset.json and manifest.jsonl")
    return content


def read_records(root: Path) -> tuple[list[Record], list[tuple[str, str]]]:
    """The frames' records that can be read, and what is wrong with the manifest's other lines."""
    records, violations = [], []
    for number, line in enumerate((root / "manifest.jsonl").read_bytes().splitlines(), start=1):
        try:
            record = json.loads(line)
            Labels.from_json(record["labels"])
            camera_of(record)
            image_file(record)
        except (ValueError, KeyError, TypeError, StopIteration) as error:
            violations.append(("manifest.jsonl", f"line {number} is not the record of a frame ({error!r})"))
            continue
        records.append(record)
    return records, violations


def _check_files(root: Path, record: Record) -> Violations:
    for file, digest in record["files"].items():
        if not (root / file).is_file():
            yield file, "is missing"
        elif hashlib.sha256((root / file).read_bytes()).hexdigest() != digest:
            yield file, "is not what was written: its SHA-256 differs from the manifest's"


def _check_labels(record: Record, labels: Labels, content: Mapping[str, Any]) -> Iterator[str]:
    """Whether the labels can be right at all."""
    classes, rules = content["classes"], content["scene"]["labels"]
    for number, count in Counter(label.id for label in labels.instances).items():
        if count > 1:
            yield f"instance {number} is labelled {count} times"
    times = np.zeros((labels.height, labels.width), dtype=np.uint16)
    for entry, label in zip(record["labels"]["instances"], labels.instances, strict=True):
        name = f"instance {label.id}"
        mask, amodal = (
            coco_mask.decode({"size": [labels.height, labels.width], "counts": entry[key]}).astype(bool)
            for key in ("rle", "amodal_rle")
        )
        times += mask
        if not 0 <= label.class_index < len(classes) or classes[label.class_index] != label.class_name:
            yield f"{name}: class {label.class_index} is not {label.class_name!r}"
        for key, shown, area in (("box", mask, entry["area"]), ("amodal_box", amodal, entry["amodal_area"])):
            if list(_bounds(shown)) != list(entry[key]) or np.count_nonzero(shown) != area:
                yield f"{name}: {key} {entry[key]} and area {area} are not those of its mask"
        if (mask & ~amodal).any():
            yield f"{name}: its mask has pixels outside its silhouette"
        if amodal.sum() > label.silhouette_area:
            yield f"{name}: its silhouette is smaller in all than in the image"
        fraction = int(mask.sum()) / max(1, int(amodal.sum()))
        if abs(fraction - entry["visible_fraction"]) > _SHARE:
            yield f"{name}: its visible fraction is {fraction:.6f}, not {entry['visible_fraction']}"
        truncation = 1 - np.count_nonzero(amodal) / label.silhouette_area
        if abs(truncation - entry["truncation"]) > _SHARE:
            yield f"{name}: its truncation is {truncation:.6f}, not {entry['truncation']}"
        below = {"occluded": fraction < rules["min_visible"] - _SHARE}
        below["disagreeing"] = label.agreement < rules["min_agreement"] - _SHARE
        if set(label.marks) != {mark for mark, is_below in below.items() if is_below}:
            yield f"{name}: its marks {list(label.marks)} are not those that the thresholds give"
        if np.count_nonzero(mask) < rules["min_pixels"]:
            yield f"{name}: has {np.count_nonzero(mask)} pixels, fewer than {rules['min_pixels']}"
        if not _is_rigid(label.world_from_object):
            yield f"{name}: its pose is not a rotation and a translation"
        parts = cv2.connectedComponents(label.mask.astype(np.uint8), connectivity=8)[0] - 1
        if label.area > POLYGON_AREA and parts == 1 and label.polygon_iou < POLYGON_IOU:
            yield f"{name}: its polygon has an IoU of {label.polygon_iou:.4f} with its mask"
    if (times > 1).any():
        yield f"{np.count_nonzero(times > 1)} pixels belong to more than one instance"


def _check_image(frame: _Frame, path: Path) -> Iterator[str]:
    image = cv2.imread(str(path))
    if image is None:
        yield "cannot be read as an image"
    elif image.shape[:2] != (frame.labels.height, frame.labels.width):
        yield f"is {image.shape[1]}x{image.shape[0]} px, its labels are for {frame.labels.width}x{frame.labels.height}"
    elif image.min() == image.max():
        yield "has one colour only"


def _rows(frame: _Frame, path: Path) -> Iterator[tuple[InstanceLabel, list[float]] | str]:
    """The instances and the numbers of their lines, or what is wrong with the file."""
    try:
        rows = [[float(value) for value in line.split()] for line in path.read_text().splitlines()]
    except ValueError as error:
        yield f"holds something else than numbers ({error})"
        return
    if len(rows) != len(frame.labels.instances):
        yield f"has {len(rows)} lines for {len(frame.labels.instances)} instances"
        return
    for label, row in zip(frame.labels.instances, rows, strict=True):
        if not row or row[0] != label.class_index:
            yield f"instance {label.id}: class is {row[:1]}, not {label.class_index}"
        else:
            yield label, row[1:]


def _check_segments(frame: _Frame, path: Path) -> Iterator[str]:
    size = np.array([frame.labels.width, frame.labels.height])
    for row in _rows(frame, path):
        if isinstance(row, str):
            yield row
            continue
        label, values = row
        if len(values) < 6 or len(values) % 2:
            yield f"instance {label.id}: a polygon must have three or more vertices (got {len(values)} numbers)"
            continue
        points = np.array(values).reshape(-1, 2)
        if points.min() < 0 or points.max() > 1:
            yield f"instance {label.id}: its polygon leaves the image"
        read = fill_polygon(points * size, *map(int, size))
        outline = fill_polygon(label.polygon, *map(int, size))
        mask = frame.whole(label)
        if np.count_nonzero(read ^ mask) > np.count_nonzero(outline ^ mask) + _ROUNDED_PIXELS:
            iou = np.count_nonzero(read & mask) / np.count_nonzero(read | mask)
            yield f"instance {label.id}: its polygon does not give its mask back (IoU {iou:.4f})"
        box = np.concatenate([points.min(axis=0), points.max(axis=0)]) * np.tile(size, 2)
        if np.abs(box - label.box).max() > 0.05:
            yield f"instance {label.id}: the box of its polygon is not that of its mask"


def _check_boxes(frame: _Frame, path: Path) -> Iterator[str]:
    for row in _rows(frame, path):
        if isinstance(row, str):
            yield row
        elif not _is_box(row[1][:4], row[0], frame.labels) or len(row[1]) != 4:
            yield f"instance {row[0].id}: its line is not its box"


def _check_rotated(frame: _Frame, path: Path) -> Iterator[str]:
    size = np.array([frame.labels.width, frame.labels.height])
    for row in _rows(frame, path):
        if isinstance(row, str):
            yield row
            continue
        label, values = row
        if len(values) != 8 or np.abs(np.array(values).reshape(4, 2) * size - rotated_box(label)).max() > _ROUNDED:
            yield f"instance {label.id}: its line is not the smallest rectangle around its mask"


def _check_pose(frame: _Frame, path: Path) -> Iterator[str]:
    size = np.array([frame.labels.width, frame.labels.height])
    count = max(map(len, frame.content["keypoints"]))
    for row in _rows(frame, path):
        if isinstance(row, str):
            yield row
            continue
        label, values = row
        if len(values) != 4 + 3 * count or not _is_box(values[:4], label, frame.labels):
            yield f"instance {label.id}: its line is not its box and {count} keypoints"
            continue
        points = np.array(values[4:]).reshape(-1, 3) * [*size, 1]
        expected = np.concatenate([label.keypoints, np.zeros((count - len(label.keypoints), 3))])
        if np.abs(points - expected).max() > _ROUNDED:
            yield f"instance {label.id}: its keypoints are not those of the manifest"


def _check_instances(frame: _Frame, path: Path) -> Iterator[str]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    expected = instance_picture(frame.labels)
    if picture is None or picture.shape != expected.shape:
        yield "cannot be read as a grey image of the frame's size"
    elif (picture != expected).any():
        yield f"{np.count_nonzero(picture != expected)} pixels differ from the masks"


def _check_semantic(frame: _Frame, path: Path) -> Iterator[str]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    labelled = instance_picture(frame.labels) > 0
    if picture is None or picture.shape != labelled.shape:
        yield "cannot be read as a grey image of the frame's size"
        return
    expected = np.zeros(picture.shape, dtype=picture.dtype)
    for label in frame.labels.instances:
        expected[frame.whole(label)] = label.class_index + 1
    ignored = picture == (255 if picture.dtype == np.uint8 else 65535)
    wrong = (picture != expected) & ~(ignored & ~labelled)
    if wrong.any():
        yield f"{np.count_nonzero(wrong)} pixels differ from the masks' classes"


def _check_panoptic(frame: _Frame, path: Path) -> Iterator[str]:
    picture = cv2.imread(str(path))
    if picture is None or picture.shape[:2] != (frame.labels.height, frame.labels.width):
        yield "cannot be read as an image of the frame's size"
        return
    ids = picture.astype(np.uint32) @ np.array([65536, 256, 1], dtype=np.uint32)  # blue, green, red
    expected = instance_picture(frame.labels)
    stuff = frame.record.get("environment", {}).get("id", 0)
    wrong = (ids != expected) & ~((expected == 0) & (ids == stuff))
    if wrong.any():
        yield f"{np.count_nonzero(wrong)} pixels differ from the masks"


def _check_depth(frame: _Frame, path: Path) -> Iterator[str]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint16 or picture.shape != (frame.labels.height, frame.labels.width):
        yield "cannot be read as a 16-bit image of the frame's size"
    elif frame.content["scene"]["labels"]["source"] == "splats":
        missing = np.count_nonzero((instance_picture(frame.labels) > 0) & (picture == 0))
        if missing:
            yield f"{missing} pixels of instances have no depth"


def _check_bop(frame: _Frame) -> Violations:
    scene = bop.scene_folder(frame.record)
    if not any(file.startswith(scene) for file in frame.record["files"]):
        return
    for position, label in enumerate(frame.labels.instances):
        for folder in ("mask", "mask_visib"):
            file = f"{scene}/{folder}/{frame.record['index']:06d}_{position:06d}.png"
            picture = cv2.imread(str(frame.root / file), cv2.IMREAD_UNCHANGED)
            expected = frame.whole(label, amodal=folder == "mask")
            if picture is None or picture.shape != expected.shape:
                yield file, "cannot be read as a grey image of the frame's size"
            elif ((picture > 0) != expected).any():
                yield file, f"{np.count_nonzero((picture > 0) != expected)} pixels differ from the manifest's mask"


_CHECKS: dict[str, Callable[[_Frame, Path], Iterator[str]]] = {
    "labels/": _check_segments,
    "yolo-detect/labels/": _check_boxes,
    "yolo-obb/labels/": _check_rotated,
    "yolo-pose/labels/": _check_pose,
    "instances/": _check_instances,
    "semantic/": _check_semantic,
    "panoptic/": _check_panoptic,
    "depth/": _check_depth,
}


def _check_whole(root: Path, records: list[Record]) -> Violations:
    """What no single frame shows: repeated frames, views of a layout in two splits, files of no frame."""
    for index, count in Counter(record["index"] for record in records).items():
        if count > 1:
            yield "manifest.jsonl", f"frame {index} has {count} lines"
    splits, images = defaultdict[int, set[str]](set), defaultdict[str, list[str]](list)
    for record in records:
        splits[record["layout"]].add(record["split"])
        images[record["files"][image_file(record)]].append(image_file(record))
    for layout, found in splits.items():
        if len(found) > 1:
            yield "manifest.jsonl", f"views of layout {layout} are in both {' and '.join(sorted(found))}"
    for same in images.values():
        if len(same) > 1:
            yield same[1], f"is the same picture as {same[0]}"
    known = {file for record in records for file in record["files"]}
    for folder in sorted(f"{task.folder}{kind}" for task in TASKS.values() for kind in ("images", "labels")):
        for path in sorted((root / folder).rglob("*")):
            file = path.relative_to(root).as_posix()
            # Ultralytics leaves a cache of what it read beside the labels.
            if path.is_file() and file not in known and path.suffix != ".cache":
                yield file, "belongs to no frame of the manifest"


def _check_collection(root: Path, records: list[Record], content: Mapping[str, Any]) -> Violations:
    """Whether the files that describe all frames say what the frames' records say."""
    catalogue = Catalogue(content["classes"], content["keypoints"], content["assets"], ())
    with tempfile.TemporaryDirectory() as folder:
        expected = Path(folder)
        write_collection(expected, records, catalogue, content["scene"]["output"]["formats"])
        for path in sorted(path for path in expected.rglob("*") if path.is_file()):
            file = path.relative_to(expected).as_posix()
            if file.startswith("bop/models/"):
                continue
            if not (root / file).is_file():
                yield file, "is missing"
            elif (root / file).read_bytes() != path.read_bytes():
                yield file, _difference(root / file, path)


def _difference(found: Path, expected: Path) -> str:
    """Where a file differs from what the manifest says."""
    if found.suffix == ".json":
        try:
            place = _first_difference(json.loads(found.read_bytes()), json.loads(expected.read_bytes()))
        except ValueError as error:
            return f"is not JSON ({error})"
        return f"differs from the manifest's labels at {place}" if place else "is not as it was written"
    pairs = zip(found.read_text().splitlines(), expected.read_text().splitlines(), strict=False)
    line = next((i for i, (one, other) in enumerate(pairs, start=1) if one != other), "the end")
    return f"differs from the manifest's labels at line {line}"


def _first_difference(found: Any, expected: Any, key: str = "") -> str:
    if isinstance(found, dict) and isinstance(expected, dict):
        for name in sorted({*found, *expected}):
            if place := _first_difference(found.get(name), expected.get(name), f"{key}.{name}" if key else name):
                return place
        return ""
    if isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            if place := _first_difference(one, other, f"{key}[{i}]"):
                return place
        return ""
    return "" if found == expected else f"{key} (got {json.dumps(found)[:60]}, not {json.dumps(expected)[:60]})"


def _bounds(mask: npt.NDArray[np.bool_]) -> tuple[int, int, int, int]:
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (int(xs[0]), int(ys[0]), int(xs[-1]) + 1, int(ys[-1]) + 1) if len(xs) else (0, 0, 0, 0)


def _is_rigid(pose: npt.NDArray[np.float64]) -> bool:
    rotation = pose[:3, :3]
    return bool(
        pose.shape == (4, 4)
        and np.isfinite(pose).all()
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-5
        and np.linalg.det(rotation) > 0
        and (pose[3] == (0, 0, 0, 1)).all()
    )


def _is_box(values: list[float], label: InstanceLabel, labels: Labels) -> bool:
    x, y, width, height = np.array(values) * (labels.width, labels.height, labels.width, labels.height)
    box = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
    return bool(np.abs(box - label.box).max() <= _ROUNDED)
