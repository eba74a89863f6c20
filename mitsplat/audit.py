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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pycocotools import mask as coco_mask

from mitsplat import bop
from mitsplat.assets import read_mesh
from mitsplat.coco import image_file
from mitsplat.errors import InputError
from mitsplat.files import Record
from mitsplat.label import Labels
from mitsplat.readback import CHECKS, Violations, WrittenFrame, check_bop, check_image
from mitsplat.stored import read_content, read_records
from mitsplat.writers import FOLDERS, Catalogue, write_collection
from mitsplat.yolo import TASKS

POLYGON_IOU = 0.99
"""Least IoU of a mask in one part and its polygon, for masks of more than :data:`POLYGON_AREA` pixels."""
POLYGON_AREA = 200

_SHARE = 1e-5
"""Difference of shares that are stored with six decimals."""
_MODEL_ROUNDED = 0.01
"""Difference that the decimals of a model's file make [mm]."""


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
    records, violations = read_records(root, content)
    marked, dropped = Counter[str](), Counter[str]()
    instances = low = files = 0
    for record in records:
        labels, file = Labels.from_json(record["labels"]), image_file(record)
        where = f"manifest.jsonl, frame {record['index']}"
        found = list(_check_files(root, record))
        damaged = {name for name, _ in found}
        violations += found
        violations += ((where, text) for text in _check_formats(record, content))
        violations += ((where, text) for text in _check_labels(record, labels, content))
        frame = WrittenFrame(root, record, labels, content)
        for prefix, check in CHECKS.items():
            for name in sorted(name for name in record["files"] if name.startswith(prefix) and name not in damaged):
                violations += ((name, text) for text in check(frame, root / name))
        if file not in damaged:
            violations += ((file, text) for text in check_image(frame, root / file))
        violations += check_bop(frame, damaged)
        instances += len(labels.instances)
        files += len(record["files"])
        low += sum(label.area > POLYGON_AREA and label.polygon_iou < POLYGON_IOU for label in labels.instances)
        marked.update(mark for label in labels.instances for mark in label.marks)
        dropped.update(labels.dropped)
    violations += _check_whole(root, records)
    violations += _check_collection(root, records, content)
    if "bop" in content["scene"]["output"]["formats"]:
        violations += _check_models(root, content)
    return Audit(len(records), instances, files, tuple(violations), low, dict(marked), dict(dropped))


def _check_files(root: Path, record: Record) -> Violations:
    for file, digest in record["files"].items():
        if not (root / file).is_file():
            yield file, "is missing"
        elif hashlib.sha256((root / file).read_bytes()).hexdigest() != digest:
            yield file, "is not what was written: its SHA-256 differs from the manifest's"


def _check_formats(record: Record, content: Mapping[str, Any]) -> Iterator[str]:
    for name in content["scene"]["output"]["formats"]:
        if name in FOLDERS and not any(file.startswith(FOLDERS[name]) for file in record["files"]):
            yield f"lists no file of the format {name}"


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
        if abs(label.polygon_iou - entry["polygon_iou"]) > _SHARE:
            yield f"{name}: the IoU of its polygon is {label.polygon_iou:.6f}, not {entry['polygon_iou']}"
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
    folders = [f"{task.folder}{kind}" for task in TASKS.values() for kind in ("images", "labels")]
    for folder in sorted([*folders, "voc/Annotations", "voc/JPEGImages"]):
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


def _check_models(root: Path, content: Mapping[str, Any]) -> Violations:
    """Whether BOP's models are there and measure what is said of them."""
    file = "bop/models/models_info.json"
    try:
        info = json.loads((root / file).read_bytes())
    except (OSError, ValueError) as error:
        yield file, f"cannot be read ({error})"
        return
    for number in range(1, len(content["assets"]) + 1):
        model = f"bop/models/obj_{number:06d}.ply"
        try:
            measured = bop.model_info(read_mesh(root / model))
        except InputError as error:
            yield model, f"cannot be read ({error})"
            continue
        stated = info.get(str(number)) if isinstance(info, dict) else None
        if not isinstance(stated, dict) or any(
            not isinstance(stated.get(key), float) or abs(stated[key] - value) > _MODEL_ROUNDED
            for key, value in measured.items()
        ):
            yield file, f"does not give the measures of {model}"


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
