"""Audit of YOLO label files, which are read as by Ultralytics, and of the ``data.yaml`` of every task."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import ConvexHull, KDTree

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.audit.dataset_check import DatasetCheck, FileCheck, Violations
from mitsplat.audit.decoded_frame import DecodedFrame, DecodedInstance
from mitsplat.audit.expected_files import YOLO_FOLDERS
from mitsplat.storage.files import SPLITS, JsonObject

POLYGON_IOU = 0.99
"""Minimum IoU of a connected mask and its polygon, for masks of more than :data:`POLYGON_AREA` pixels."""
POLYGON_AREA = 200

_PIXEL_TOLERANCE = 4
"""Maximum number of pixels by which a polygon read from text may differ from its mask."""
_POSITION_TOLERANCE = 0.01
"""Tolerance of positions for six decimals and OpenCV's rectangles [px]."""
_MAX_AREA_RATIO = 1.001
"""Maximum ratio of the area of a single-precision rectangle to the smallest possible area."""

LineCheck = Callable[[DecodedFrame, DecodedInstance, list[float]], Iterator[str]]
"""Function that yields the violations in the numbers of an instance's line."""


def _check_lines(check: LineCheck, frame: DecodedFrame, path: Path) -> Iterator[str]:
    """Check a file with one line per instance: class index, then numbers."""
    try:
        rows = [[float(value) for value in line.split()] for line in path.read_text().splitlines()]
    except ValueError as error:
        yield f"must contain only numbers ({error})"
        return
    if len(rows) != len(frame.instances):
        yield f"has {len(rows)} lines for {len(frame.instances)} instances"
        return
    for label, row in zip(frame.instances, rows, strict=True):
        if not row or row[0] != label.class_index:
            yield f"{label.name}: class is {row[:1]}, not {label.class_index}"
        elif not np.isfinite(row).all():
            yield f"{label.name}: its line holds a number that is not finite"
        else:
            yield from (f"{label.name}: {text}" for text in check(frame, label, row[1:]))


def _check_segment(frame: DecodedFrame, label: DecodedInstance, values: list[float]) -> Iterator[str]:
    if len(values) < 6 or len(values) % 2:
        yield f"a polygon must have three or more vertices (got {len(values)} numbers)"
        return
    points = np.array(values).reshape(-1, 2)
    if points.min() < 0 or points.max() > 1:
        yield "its polygon leaves the image"
        return
    width, height = frame.size
    # Rasterised as in Ultralytics' polygon2mask: single precision, truncated to pixels, even-odd rule, edges painted.
    canvas = np.zeros((height, width), dtype=np.uint8)
    cv2.fillPoly(canvas, [(points.astype(np.float32) * np.array(frame.size, dtype=np.float32)).astype(np.int32)], 1)
    read, mask = canvas.astype(bool), frame.full_mask(label)
    lost, added = np.count_nonzero(mask & ~read), np.count_nonzero(read & ~mask)
    parts = cv2.connectedComponents(label.mask.astype(np.uint8), connectivity=8)[0] - 1
    iou = (label.area - lost) / (label.area + added)
    if lost > _PIXEL_TOLERANCE or added > _PIXEL_TOLERANCE + (bridged_pixels(label.mask) if parts > 1 else 0):
        yield f"its polygon does not reproduce its mask (IoU {iou:.4f})"
    elif label.area > POLYGON_AREA and parts == 1 and iou < POLYGON_IOU:
        yield f"its polygon has an IoU of {iou:.4f} with its mask"
    if abs(iou - label.entry["polygon_iou"]) > _PIXEL_TOLERANCE / label.area:
        yield f"the IoU of its polygon is {iou:.6f}, not the manifest's {label.entry['polygon_iou']}"
    box = np.concatenate([points.min(axis=0), points.max(axis=0)]) * np.tile(frame.size, 2)
    if np.abs(box - label.box).max() > 0.05:
        yield "the box of its polygon does not match its mask"


def bridged_pixels(mask: BoolArray) -> int:
    """Return the minimum number of gap pixels that join all parts of a mask (H, W), in chessboard distance."""
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    trees = [KDTree(np.argwhere(parts == part)) for part in range(1, count)]
    distances = np.zeros((len(trees), len(trees)))
    for (i, one), (j, other) in combinations(enumerate(trees), 2):
        distances[i, j] = one.query(other.data, p=np.inf)[0].min()
    return int((minimum_spanning_tree(distances).data - 1).sum())


def _check_box(frame: DecodedFrame, label: DecodedInstance, values: list[float]) -> Iterator[str]:
    if len(values) != 4 or not _is_box(values, frame, label):
        yield "its line does not match its box"


def _check_rotated(frame: DecodedFrame, label: DecodedInstance, values: list[float]) -> Iterator[str]:
    """Check that four corners are the smallest rectangle that contains the mask's pixels.

    A rectangle whose upright bounding box is larger than the image is shortened, or replaced by the mask's box.
    """
    if len(values) != 8:
        yield "its line is not four corners"
        return
    corners = np.array(values).reshape(4, 2) * frame.size
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    if lengths.min() < 0.5 or np.abs(np.sum(sides * np.roll(sides, -1, axis=0), axis=1)).max() > 0.1 * lengths.max():
        yield "its line is no rectangle"
        return
    ys, xs = np.nonzero(label.mask)
    squares = np.concatenate([np.stack([xs + dx, ys + dy], axis=1) for dx in (0, 1) for dy in (0, 1)])
    hull = squares[ConvexHull(squares).vertices] + np.array(label.box[:2], dtype=np.float64)
    # The smallest rectangle has a side on the hull (Freeman and Shapira 1975).
    edges = np.roll(hull, -1, axis=0) - hull
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    candidates = np.stack([edges, edges[:, ::-1] * (-1, 1)], axis=1)
    areas = np.array([np.ptp(hull @ axes.T, axis=0).prod() for axes in candidates])
    leaves_image = (_bounding_size(candidates[np.argmin(areas)], hull) > frame.size).any()
    bounds = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
    tolerance = 0.05
    if leaves_image and np.abs(bounds - label.box).max() <= tolerance:
        return
    axes = sides[:2] / lengths[:2, None]
    at, needed = corners @ axes.T, hull @ axes.T
    missing = np.stack([at.min(axis=0) - needed.min(axis=0), needed.max(axis=0) - at.max(axis=0)])
    extents = np.ptp(needed, axis=0)
    if missing.max() > tolerance:
        fills = np.abs(np.ptp(corners, axis=0) - frame.size).min() < tolerance
        is_shortened = missing[:, np.argmin(extents)].max() < tolerance and np.ptp(missing, axis=0).max() < tolerance
        if not (leaves_image and fills and is_shortened):
            yield "its line is not the smallest rectangle around its mask: pixels lie outside"
            return
    if np.maximum(extents, lengths[:2]).prod() > _MAX_AREA_RATIO * areas.min() + tolerance * lengths.max():
        yield f"its line is not the smallest rectangle around its mask: one of {areas.min():.1f} px fits"


def _bounding_size(axes: Float64Array, points: Float64Array) -> Float64Array:
    """Return width and height of the upright box around the rectangle of points (N, 2) along two unit axes (2, 2)."""
    return np.asarray(np.abs(axes).T @ np.ptp(points @ axes.T, axis=0))


def _check_pose(frame: DecodedFrame, label: DecodedInstance, values: list[float]) -> Iterator[str]:
    count = max(map(len, frame.content["keypoints"]), default=0)
    if len(values) != 4 + 3 * count or not _is_box(values[:4], frame, label):
        yield f"its line does not match its box and {count} keypoints"
        return
    points = np.array(values[4:]).reshape(-1, 3) * [*frame.size, 1]
    stated = np.array(label.entry["keypoints"], dtype=np.float64).reshape(-1, 3)
    expected = np.concatenate([stated, np.zeros((count - len(stated), 3))])
    if np.abs(points - expected).max() > _POSITION_TOLERANCE:
        yield "its keypoints differ from the manifest's"


def _is_box(values: list[float], frame: DecodedFrame, label: DecodedInstance) -> bool:
    x, y, width, height = np.array(values) * np.tile(frame.size, 2)
    box: Float64Array = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
    return bool(np.abs(box - label.box).max() <= _POSITION_TOLERANCE)


CHECKS: dict[str, FileCheck] = {
    "labels/": partial(_check_lines, _check_segment),
    "yolo-detect/labels/": partial(_check_lines, _check_box),
    "yolo-obb/labels/": partial(_check_lines, _check_rotated),
    "yolo-pose/labels/": partial(_check_lines, _check_pose),
}
"""Check functions of label files, by folder."""


class DataYamlCheck(DatasetCheck):
    """Check of the ``data.yaml`` of every task."""

    def __init__(self, root: Path, content: JsonObject) -> None:
        self._root, self._content = root, content
        self._splits: set[str] = set()

    def check(self, frame: DecodedFrame) -> Violations:
        """Record the split of the frame."""
        self._splits.add(frame.split)
        yield from ()

    def finish(self) -> Violations:
        """Check that classes, folders and keypoints are those of the dataset."""
        for task, folder in YOLO_FOLDERS.items():
            if task in self._content["scene"]["output"]["formats"]:
                file = f"{folder}data.yaml"
                texts = self._check(self._root / file, with_keypoints=task == "yolo-pose")
                yield from ((file, text) for text in texts)

    def _check(self, path: Path, *, with_keypoints: bool) -> Iterator[str]:
        try:
            data = YAML(typ="safe", pure=True).load(path.read_text())
        except FileNotFoundError:
            yield "is missing"
            return
        except (OSError, ValueError, RecursionError, YAMLError) as error:
            yield f"cannot be read ({' '.join(str(error).split())})"
            return
        if not isinstance(data, dict):
            yield "must be a mapping"
            return
        if data.get("names") != dict(enumerate(self._content["classes"])):
            yield f"names are {str(data.get('names'))[:80]}, not {dict(enumerate(self._content['classes']))}"
        for split in SPLITS[:2]:
            # Ultralytics needs images for both splits, so an empty split has those of another one.
            folder = split if split in self._splits else next((one for one in SPLITS if one in self._splits), split)
            if data.get(split) != f"images/{folder}":
                yield f"{split} is {data.get(split)}, not images/{folder}"
        if data.get("test") != ("images/test" if "test" in self._splits else None):
            yield f"test is {data.get('test')}, which does not match the images of that split"
        if "path" in data:
            yield "must not have a path, because the dataset could not be moved"
        if with_keypoints:
            names = self._content["keypoints"]
            count = max(map(len, names), default=0)
            padded = {
                i: [*points, *(f"unused_{k}" for k in range(len(points), count))] for i, points in enumerate(names)
            }
            if data.get("kpt_shape") != [count, 3] or data.get("kpt_names") != padded:
                yield f"its keypoints are not {padded}"
