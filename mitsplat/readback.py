"""Files of a frame read back the way their users read them, and compared with the masks of the manifest."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat import bop
from mitsplat.coco import image_file
from mitsplat.files import Record
from mitsplat.label import InstanceLabel, Labels
from mitsplat.maps import instance_picture
from mitsplat.outline import fill_polygon
from mitsplat.voc import flags
from mitsplat.yolo import rotated_box

_ROUNDED_PIXELS = 4
"""Pixels by which a polygon read from text may differ from the outline of its mask."""
_ROUNDED = 0.01
"""Distance that six decimals and OpenCV's rectangles may move a position [px]."""
Violations = Iterator[tuple[str, str]]
"""File, relative to the dataset, and what is wrong with it."""


@dataclass(frozen=True, eq=False)
class WrittenFrame:
    """A frame's line in the manifest, and the dataset that it is in."""

    root: Path
    record: Record
    labels: Labels
    content: Mapping[str, Any]

    def whole(self, label: InstanceLabel, *, amodal: bool = False) -> npt.NDArray[np.bool_]:
        """What is seen of an instance, or all that it covers, in the whole image."""
        canvas = np.zeros((self.labels.height, self.labels.width), dtype=bool)
        x0, y0, x1, y1 = label.amodal.box if amodal else label.box
        canvas[y0:y1, x0:x1] = label.amodal.mask if amodal else label.mask
        return canvas


def check_image(frame: WrittenFrame, path: Path) -> Iterator[str]:
    """What is wrong with the frame's picture."""
    image = cv2.imread(str(path))
    if image is None:
        yield "cannot be read as an image"
    elif image.shape[:2] != (frame.labels.height, frame.labels.width):
        yield f"is {image.shape[1]}x{image.shape[0]} px, its labels are for {frame.labels.width}x{frame.labels.height}"
    elif image.min() == image.max():
        yield "has one colour only"


LineCheck = Callable[[WrittenFrame, InstanceLabel, list[float]], Iterator[str]]
"""What is wrong with the numbers of an instance's line."""


def _check_lines(check: LineCheck, frame: WrittenFrame, path: Path) -> Iterator[str]:
    """What is wrong with a file of one line per instance: its class, then numbers."""
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
        elif not np.isfinite(row).all():
            yield f"instance {label.id}: its line holds a number that is not finite"
        else:
            yield from check(frame, label, row[1:])


def _check_segment(frame: WrittenFrame, label: InstanceLabel, values: list[float]) -> Iterator[str]:
    size = np.array([frame.labels.width, frame.labels.height])
    if len(values) < 6 or len(values) % 2:
        yield f"instance {label.id}: a polygon must have three or more vertices (got {len(values)} numbers)"
        return
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


def _check_box(frame: WrittenFrame, label: InstanceLabel, values: list[float]) -> Iterator[str]:
    if len(values) != 4 or not _is_box(values, label, frame.labels):
        yield f"instance {label.id}: its line is not its box"


def _check_rotated(frame: WrittenFrame, label: InstanceLabel, values: list[float]) -> Iterator[str]:
    size = np.array([frame.labels.width, frame.labels.height])
    if len(values) != 8 or np.abs(np.array(values).reshape(4, 2) * size - rotated_box(label)).max() > _ROUNDED:
        yield f"instance {label.id}: its line is not the smallest rectangle around its mask"


def _check_pose(frame: WrittenFrame, label: InstanceLabel, values: list[float]) -> Iterator[str]:
    count = max(map(len, frame.content["keypoints"]), default=0)
    if len(values) != 4 + 3 * count or not _is_box(values[:4], label, frame.labels):
        yield f"instance {label.id}: its line is not its box and {count} keypoints"
        return
    points = np.array(values[4:]).reshape(-1, 3) * [frame.labels.width, frame.labels.height, 1]
    expected = np.concatenate([label.keypoints, np.zeros((count - len(label.keypoints), 3))])
    if np.abs(points - expected).max() > _ROUNDED:
        yield f"instance {label.id}: its keypoints are not those of the manifest"


def _check_voc(frame: WrittenFrame, path: Path) -> Iterator[str]:
    try:
        objects = ElementTree.parse(path).findall("object")
    except ElementTree.ParseError as error:
        yield f"cannot be read as XML ({error})"
        return
    if len(objects) != len(frame.labels.instances):
        yield f"has {len(objects)} objects for {len(frame.labels.instances)} instances"
        return
    for label, entry in zip(frame.labels.instances, objects, strict=True):
        if entry.findtext("name") != label.class_name:
            yield f"instance {label.id}: class is {entry.findtext('name')}, not {label.class_name}"
        box = [entry.findtext(f"bndbox/{name}") for name in ("xmin", "ymin", "xmax", "ymax")]
        if box != [str(value) for value in np.add(label.box, (1, 1, 0, 0))]:
            yield f"instance {label.id}: its box is not that of its mask"
        if [entry.findtext(name) for name in ("truncated", "occluded")] != [str(int(flag)) for flag in flags(label)]:
            yield f"instance {label.id}: its flags are not those of its masks"


def _check_instances(frame: WrittenFrame, path: Path) -> Iterator[str]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    expected = instance_picture(frame.labels)
    if picture is None or picture.shape != expected.shape:
        yield "cannot be read as a grey image of the frame's size"
    elif (picture != expected).any():
        yield f"{np.count_nonzero(picture != expected)} pixels differ from the masks"


def _check_semantic(frame: WrittenFrame, path: Path) -> Iterator[str]:
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


def _check_panoptic(frame: WrittenFrame, path: Path) -> Iterator[str]:
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


def _check_depth(frame: WrittenFrame, path: Path) -> Iterator[str]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint16 or picture.shape != (frame.labels.height, frame.labels.width):
        yield "cannot be read as a 16-bit image of the frame's size"
    elif frame.content["scene"]["labels"]["source"] == "splats":
        missing = np.count_nonzero((instance_picture(frame.labels) > 0) & (picture == 0))
        if missing:
            yield f"{missing} pixels of instances have no depth"


def check_bop(frame: WrittenFrame, damaged: Collection[str]) -> Violations:
    """What is wrong with the frame's BOP pictures, but for those of which it is known already."""
    if "bop" not in frame.content["scene"]["output"]["formats"]:
        return
    scene, listed = bop.scene_folder(frame.record), frame.record["files"]
    name = f"{frame.record['index']:06d}"
    image = Path(image_file(frame.record))
    checks: dict[str, Callable[[Path], Iterator[str]]] = {
        f"{scene}/rgb/{name}{image.suffix}": lambda path: check_image(frame, path),
        f"{scene}/depth/{name}.png": lambda path: _check_depth(frame, path),
    }
    for position, label in enumerate(frame.labels.instances):
        for folder in ("mask", "mask_visib"):
            expected = frame.whole(label, amodal=folder == "mask")
            checks[f"{scene}/{folder}/{name}_{position:06d}.png"] = partial(_check_mask, expected)
    for file, check in checks.items():
        if file not in listed:
            yield file, "is not listed in the manifest"
        elif file not in damaged:
            yield from ((file, text) for text in check(frame.root / file))


def _check_mask(expected: npt.NDArray[np.bool_], path: Path) -> Iterator[str]:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.shape != expected.shape:
        yield "cannot be read as a grey image of the frame's size"
    elif ((picture > 0) != expected).any():
        yield f"{np.count_nonzero((picture > 0) != expected)} pixels differ from the manifest's mask"


CHECKS: dict[str, Callable[[WrittenFrame, Path], Iterator[str]]] = {
    "labels/": partial(_check_lines, _check_segment),
    "yolo-detect/labels/": partial(_check_lines, _check_box),
    "yolo-obb/labels/": partial(_check_lines, _check_rotated),
    "yolo-pose/labels/": partial(_check_lines, _check_pose),
    "voc/Annotations/": _check_voc,
    "instances/": _check_instances,
    "semantic/": _check_semantic,
    "panoptic/": _check_panoptic,
    "depth/": _check_depth,
}
"""What is wrong with a file, by the folder that it is in."""


def _is_box(values: list[float], label: InstanceLabel, labels: Labels) -> bool:
    x, y, width, height = np.array(values) * (labels.width, labels.height, labels.width, labels.height)
    box = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
    return bool(np.abs(box - label.box).max() <= _ROUNDED)
