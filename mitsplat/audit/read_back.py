"""Audit of a frame's files, which are read as their users read them and compared with the masks of the manifest."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import ConvexHull, KDTree

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.audit.truth import TrueFrame, TrueInstance, bounds_of
from mitsplat.images.picture_files import read_picture

POLYGON_IOU = 0.99
"""Minimum IoU of a connected mask and its polygon, for masks of more than :data:`POLYGON_AREA` pixels."""
POLYGON_AREA = 200

_PIXEL_TOLERANCE = 4
"""Maximum number of pixels by which a polygon read from text may differ from its mask."""
_POSITION_TOLERANCE = 0.01
"""Tolerance of positions for six decimals and OpenCV's rectangles [px]."""
_MAX_AREA_RATIO = 1.001
"""Maximum ratio of the area of a single-precision rectangle to the smallest possible area."""
Violations = Iterator[tuple[str, str]]
"""Iterator of violations: file, relative to the dataset, and description."""


def check_image(frame: TrueFrame, path: Path) -> Iterator[str]:
    """Yield the violations of the frame's picture."""
    image = read_picture(path)
    width, height = frame.size
    if image is None:
        yield "cannot be read as an image"
    elif image.shape[:2] != (height, width):
        yield f"is {image.shape[1]}x{image.shape[0]} px, its labels are for {width}x{height}"
    elif image.min() == image.max():
        yield "has one colour only"


def _check_copy(frame: TrueFrame, path: Path) -> Iterator[str]:
    """Check that a format's picture is the frame's picture under a second name."""
    image = f"images/{frame.split}/{frame.image_name}"
    if frame.record["files"][path.relative_to(frame.root).as_posix()] != frame.record["files"].get(image):
        yield f"is not the picture {image}"


LineCheck = Callable[[TrueFrame, TrueInstance, list[float]], Iterator[str]]
"""Function that yields the violations in the numbers of an instance's line."""


def _check_lines(check: LineCheck, frame: TrueFrame, path: Path) -> Iterator[str]:
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
        if not row or row[0] != label.kind:
            yield f"{label.name}: class is {row[:1]}, not {label.kind}"
        elif not np.isfinite(row).all():
            yield f"{label.name}: its line holds a number that is not finite"
        else:
            yield from check(frame, label, row[1:])


def _check_segment(frame: TrueFrame, label: TrueInstance, values: list[float]) -> Iterator[str]:
    if len(values) < 6 or len(values) % 2:
        yield f"{label.name}: a polygon must have three or more vertices (got {len(values)} numbers)"
        return
    points = np.array(values).reshape(-1, 2)
    if points.min() < 0 or points.max() > 1:
        yield f"{label.name}: its polygon leaves the image"
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
        yield f"{label.name}: its polygon does not reproduce its mask (IoU {iou:.4f})"
    elif label.area > POLYGON_AREA and parts == 1 and iou < POLYGON_IOU:
        yield f"{label.name}: its polygon has an IoU of {iou:.4f} with its mask"
    if abs(iou - label.entry["polygon_iou"]) > _PIXEL_TOLERANCE / label.area:
        yield f"{label.name}: the IoU of its polygon is {iou:.6f}, not the manifest's {label.entry['polygon_iou']}"
    box = np.concatenate([points.min(axis=0), points.max(axis=0)]) * np.tile(frame.size, 2)
    if np.abs(box - label.box).max() > 0.05:
        yield f"{label.name}: the box of its polygon does not match its mask"


def bridged_pixels(mask: BoolArray) -> int:
    """Return the minimum number of gap pixels that join all parts of a mask (Prim's algorithm, chessboard distance)."""
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    pixels = [np.argwhere(parts == part) for part in range(1, count)]
    trees = [KDTree(places) for places in pixels]
    away = np.full(len(pixels), np.inf)
    joined, total = 0, 0
    away[0] = -1.0
    for _ in range(len(pixels) - 1):
        for other in np.flatnonzero(away > 0):
            away[other] = min(away[other], trees[joined].query(pixels[other], p=np.inf)[0].min())
        joined = int(np.where(away > 0, away, np.inf).argmin())
        total += int(away[joined]) - 1
        away[joined] = -1.0
    return total


def _check_box(frame: TrueFrame, label: TrueInstance, values: list[float]) -> Iterator[str]:
    if len(values) != 4 or not _is_box(values, frame, label):
        yield f"{label.name}: its line does not match its box"


def _check_rotated(frame: TrueFrame, label: TrueInstance, values: list[float]) -> Iterator[str]:
    """Check that four corners are the smallest rectangle that contains the mask's pixels."""
    if len(values) != 8:
        yield f"{label.name}: its line is not four corners"
        return
    corners = np.array(values).reshape(4, 2) * frame.size
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    if lengths.min() < 0.5 or np.abs(np.sum(sides * np.roll(sides, -1, axis=0), axis=1)).max() > 0.1 * lengths.max():
        yield f"{label.name}: its line is no rectangle"
        return
    ys, xs = np.nonzero(label.mask)
    squares = np.concatenate([np.stack([xs + dx, ys + dy], axis=1) for dx in (0, 1) for dy in (0, 1)])
    hull = squares[ConvexHull(squares).vertices] + np.array(label.box[:2], dtype=np.float64)
    along = (hull[:, None] - corners) @ (sides / lengths[:, None] ** 2).T  # (points, corners, sides)
    inside = np.diagonal(along, axis1=1, axis2=2) * lengths
    # The smallest rectangle has a side on the hull (Freeman and Shapira 1975).
    edges = np.roll(hull, -1, axis=0) - hull
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    smallest = min(np.ptp(hull @ edge) * np.ptp(hull @ (-edge[1], edge[0])) for edge in edges)
    tolerance = 0.05
    if inside.min() < -tolerance or (inside - lengths).max() > tolerance:
        yield f"{label.name}: its line is not the smallest rectangle around its mask: pixels lie outside"
    elif lengths[0] * lengths[1] > _MAX_AREA_RATIO * smallest + tolerance * lengths.max():
        yield f"{label.name}: its line is not the smallest rectangle around its mask: one of {smallest:.1f} px fits"


def _check_pose(frame: TrueFrame, label: TrueInstance, values: list[float]) -> Iterator[str]:
    count = max(map(len, frame.content["keypoints"]), default=0)
    if len(values) != 4 + 3 * count or not _is_box(values[:4], frame, label):
        yield f"{label.name}: its line does not match its box and {count} keypoints"
        return
    points = np.array(values[4:]).reshape(-1, 3) * [*frame.size, 1]
    stated = np.array(label.entry["keypoints"], dtype=np.float64).reshape(-1, 3)
    expected = np.concatenate([stated, np.zeros((count - len(stated), 3))])
    if np.abs(points - expected).max() > _POSITION_TOLERANCE:
        yield f"{label.name}: its keypoints differ from the manifest's"


def read_grey(path: Path, frame: TrueFrame) -> Int64Array | None:
    """Read a grey picture of 8 or 16 bits; return None if it does not have the frame's size."""
    picture = read_picture(path, cv2.IMREAD_UNCHANGED)
    if picture is None or picture.shape != frame.size[::-1]:
        return None
    return picture.astype(np.int64)


def _check_instances(frame: TrueFrame, path: Path) -> Iterator[str]:
    picture = read_grey(path, frame)
    if picture is None:
        yield "cannot be read as a grey image of the frame's size"
    elif (picture != frame.ids).any():
        yield f"{np.count_nonzero(picture != frame.ids)} pixels differ from the masks"


def _check_semantic(frame: TrueFrame, path: Path) -> Iterator[str]:
    picture = read_grey(path, frame)
    if picture is None:
        yield "cannot be read as a grey image of the frame's size"
        return
    void = 255 if len(frame.content["classes"]) < 255 else 65535
    wrong = (picture != frame.classes) & ~((picture == void) & (frame.ids == 0))
    if wrong.any():
        yield f"{np.count_nonzero(wrong)} pixels differ from the masks' classes"


def segment_picture(frame: TrueFrame, path: Path) -> Int64Array | None:
    """Read the ids of a panoptic picture, R + 256 G + 65536 B as in panopticapi."""
    picture = read_picture(path)
    if picture is None or picture.shape[:2] != frame.size[::-1]:
        return None
    blue, green, red = (picture[..., channel].astype(np.int64) for channel in range(3))
    return np.asarray(red + 256 * green + 65536 * blue)


def _check_panoptic(frame: TrueFrame, path: Path) -> Iterator[str]:
    ids = segment_picture(frame, path)
    if ids is None:
        yield "cannot be read as an image of the frame's size"
        return
    stuff = frame.record.get("environment")
    wrong = (ids != frame.ids) & ~((frame.ids == 0) & (ids == (stuff or {"id": 0})["id"]))
    if wrong.any():
        yield f"{np.count_nonzero(wrong)} pixels differ from the masks"
    elif stuff is not None:
        box = bounds_of(ids == stuff["id"])
        if list(box) != stuff["box"] or np.count_nonzero(ids == stuff["id"]) != stuff["area"]:
            yield f"its environment has the box {list(box)}, not {stuff['box']} as in the manifest, or another area"


def _check_depth(frame: TrueFrame, path: Path) -> Iterator[str]:
    picture = read_picture(path, cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint16 or picture.shape != frame.size[::-1]:
        yield "cannot be read as a 16-bit image of the frame's size"
    elif (missing := np.count_nonzero((frame.ids > 0) & (picture == 0))) and _from_splats(frame):
        yield f"{missing} pixels of instances have no depth"


def _from_splats(frame: TrueFrame) -> bool:
    """Return True if labels and depths come from the same source, the splats."""
    return bool(frame.content["scene"]["labels"]["source"] == "splats")


def check_bop(frame: TrueFrame, damaged: Collection[str]) -> Violations:
    """Check the frame's BOP pictures, except those that are known to be damaged."""
    if "bop" not in frame.formats:
        return
    name = f"{frame.index:06d}"
    checks: dict[str, Callable[[Path], Iterator[str]]] = {
        f"{frame.bop_folder}/rgb/{frame.image_name}": lambda path: _check_copy(frame, path),
        f"{frame.bop_folder}/depth/{name}.png": lambda path: _check_depth(frame, path),
    }
    for position, label in enumerate(frame.instances):
        for folder in ("mask", "mask_visib"):
            expected = frame.full_mask(label, amodal=folder == "mask")
            checks[f"{frame.bop_folder}/{folder}/{name}_{position:06d}.png"] = partial(_check_mask, expected)
    for file, check in checks.items():
        if file in frame.record["files"] and file not in damaged:
            yield from ((file, text) for text in check(frame.root / file))


def _check_mask(expected: BoolArray, path: Path) -> Iterator[str]:
    picture = read_picture(path, cv2.IMREAD_UNCHANGED)
    if picture is None or picture.shape != expected.shape:
        yield "cannot be read as a grey image of the frame's size"
    elif ((picture > 0) != expected).any():
        yield f"{np.count_nonzero((picture > 0) != expected)} pixels differ from the manifest's mask"


CHECKS: dict[str, Callable[[TrueFrame, Path], Iterator[str]]] = {
    "images/": check_image,
    "labels/": partial(_check_lines, _check_segment),
    "yolo-detect/labels/": partial(_check_lines, _check_box),
    "yolo-obb/labels/": partial(_check_lines, _check_rotated),
    "yolo-pose/labels/": partial(_check_lines, _check_pose),
    **{f"{folder}/": _check_copy for folder in ("yolo-detect/images", "yolo-obb/images", "yolo-pose/images")},
    "instances/": _check_instances,
    "semantic/": _check_semantic,
    "panoptic/": _check_panoptic,
    "depth/": _check_depth,
}
"""Check functions of files, by folder prefix."""


def _is_box(values: list[float], frame: TrueFrame, label: TrueInstance) -> bool:
    x, y, width, height = np.array(values) * np.tile(frame.size, 2)
    box: Float64Array = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
    return bool(np.abs(box - label.box).max() <= _POSITION_TOLERANCE)
