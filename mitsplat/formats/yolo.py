"""YOLO labels for Ultralytics: one text file per image, one line per instance, positions in [0, 1].

=========== =============================== ==================================================================
format      folder                          numbers of a line after the class index
=========== =============================== ==================================================================
yolo        ``labels/``                     x y of the outline of :func:`mitsplat.labels.polygons.outline`
yolo-detect ``yolo-detect/labels/``         x y of the box's centre, width, height
yolo-obb    ``yolo-obb/labels/``            x y of the four corners of :func:`rotated_box`
yolo-pose   ``yolo-pose/labels/``           the box, then x y v of every keypoint: 2 visible, 1 hidden, 0 outside
=========== =============================== ==================================================================

Ultralytics finds a label by the path of its image. Each task except ``yolo`` therefore has its own folder, with the
images under second names. All classes have the same number of keypoints, the largest; missing keypoints are zeros.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.formats.format import AnnotationWriter, Catalogue, Format, FrameFiles
from mitsplat.labels.labels import UNLABELLED, InstanceLabel, Labels
from mitsplat.storage.files import SPLITS, Record, write_text


@dataclass(frozen=True)
class Task:
    """Task of Ultralytics.

    Attributes:
        folder: Folder of its dataset.
        numbers: Function of an instance and the image size (2,) that returns the positions of the instance's line [px].
    """

    folder: str
    numbers: Callable[[InstanceLabel, Float64Array], Float64Array]


def format_of(task: str) -> Format:
    """Return the format of a task."""
    entries = (TASKS[task].folder.rstrip("/"),) if TASKS[task].folder else ("labels", "data.yaml")
    return Format(entries, partial(write, task=task), partial(DataYaml, task=task))


def write(files: FrameFiles, task: str) -> None:
    """Write a frame's label file; add the picture under a second name for tasks with their own folder."""
    folder, text = TASKS[task].folder, yolo_lines(files.frame.labels, task, files.catalogue.num_keypoints)
    if folder:
        files.add_image(folder + files.image)
    files.add_bytes(f"{folder}labels/{files.name}.txt", text.encode())


class DataYaml(AnnotationWriter):
    """Writer of the ``data.yaml`` of a task."""

    def __init__(self, root: Path, catalogue: Catalogue, task: str) -> None:
        super().__init__()
        self._path, self._class_names = root / TASKS[task].folder / "data.yaml", catalogue.class_names
        self._keypoint_names = catalogue.keypoint_names if task == "yolo-pose" else None
        self._splits: set[str] = set()

    def add(self, record: Record) -> None:
        """Record the frame's split."""
        self._splits.add(record["split"])

    def commit(self) -> None:
        """Write the file."""
        write_text(self._path, data_yaml(self._class_names, self._splits, self._keypoint_names))


def yolo_lines(labels: Labels, task: str = "yolo", num_keypoints: int = 0) -> str:
    """Return the lines of a label file.

    Args:
        labels: Labels of the image.
        task: Key of :data:`TASKS`.
        num_keypoints: Number of keypoints on each line of ``yolo-pose``.
    """
    size = np.array((labels.width, labels.height), dtype=np.float64)
    lines = []
    for label in labels.instances:
        points = (TASKS[task].numbers(label, size).reshape(-1, 2) / size).ravel().tolist()
        text = [str(label.class_index), " ".join(["%.6f"] * len(points)) % tuple(points)]
        if task == "yolo-pose":
            missing = np.zeros((num_keypoints - len(label.keypoints), 3))
            for x, y, visibility in np.concatenate([label.keypoints, missing]):
                text += [f"{x / size[0]:.6f}", f"{y / size[1]:.6f}", str(int(visibility) if visibility else UNLABELLED)]
        lines.append(" ".join(text) + "\n")
    return "".join(lines)


def data_yaml(
    class_names: Sequence[str], splits: Iterable[str], keypoint_names: Sequence[Sequence[str]] | None = None
) -> str:
    """Return the description of a dataset for Ultralytics; ``keypoint_names`` of every class for ``yolo-pose``.

    The description has no ``path``, so Ultralytics resolves the splits from the file's own folder.
    """
    present = [split for split in SPLITS if split in splits]
    lines = ["# Paths are relative to this file."]
    for split in SPLITS:
        if split in present or (not present and split != "test"):
            lines.append(f"{split}: images/{split}")
        elif split != "test":
            lines.append(f"{split}: images/{present[0]} # there are no images for {split}; Ultralytics wants some")
    return "\n".join(lines) + "\n" + names_yaml(class_names, keypoint_names)


def names_yaml(class_names: Sequence[str], keypoint_names: Sequence[Sequence[str]] | None = None) -> str:
    """Return the class names, and the keypoints of every class for ``yolo-pose``, as lines of ``data.yaml``."""
    lines = ["names:" if class_names else "names: {}"]
    lines += [f"  {i}: {json.dumps(name, ensure_ascii=False)}" for i, name in enumerate(class_names)]
    if keypoint_names is not None:
        count = max(map(len, keypoint_names), default=0)
        lines += [f"kpt_shape: [{count}, 3]", "kpt_names:"]
        for i, names in enumerate(keypoint_names):
            padded = [*names, *(f"unused_{k}" for k in range(len(names), count))]
            lines.append(f"  {i}: {json.dumps(padded, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"


def rotated_box(label: InstanceLabel, size: Float64Array) -> Float64Array:
    """Return the corners of the smallest rectangle around the whole pixels of the mask [px], shape (4, 2).

    Ultralytics ignores images with a rectangle whose upright bounding box is larger than the image. The long sides of
    such a rectangle are shortened to fit. If it is too wide for that, the upright box of the mask takes its place.

    Args:
        label: The instance.
        size: Width and height of the image [px].
    """
    x0, y0 = label.box[:2]
    ys, xs = np.nonzero(label.mask)
    pixels = np.concatenate([np.stack([xs + dx, ys + dy], axis=1) for dx in (0, 1) for dy in (0, 1)])
    rectangle = cv2.minAreaRect(cv2.convexHull(pixels.astype(np.int32)).astype(np.float32))
    corners = np.asarray(cv2.boxPoints(rectangle), dtype=np.float64)
    centre, sides = corners.mean(axis=0), np.diff(corners[:3], axis=0)
    across, along = sides[np.argsort((sides**2).sum(axis=1), kind="stable")]
    if (excess := np.abs(across) + np.abs(along) - size).max() > 0:
        share = 1.0 - float((excess / np.maximum(np.abs(along), 1e-9)).max())
        along = share * along
        if share <= 0 or along @ along < across @ across:
            return _corners(label)
        signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        corners = centre + 0.5 * signs @ np.stack([across, along])
    return np.add(corners, (x0, y0), dtype=np.float64)


def _corners(label: InstanceLabel) -> Float64Array:
    x0, y0, x1, y1 = label.box
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=np.float64)


def _outline(label: InstanceLabel, _: Float64Array) -> Float64Array:
    return label.polygon


def _centred_box(label: InstanceLabel, _: Float64Array) -> Float64Array:
    x0, y0, x1, y1 = label.box
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0], dtype=np.float64)


TASKS = {
    "yolo": Task("", _outline),
    "yolo-detect": Task("yolo-detect/", _centred_box),
    "yolo-obb": Task("yolo-obb/", rotated_box),
    "yolo-pose": Task("yolo-pose/", _centred_box),
}
