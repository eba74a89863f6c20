"""Index of the images of a dataset by class, visibility and size of their labels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import cv2
import numpy as np

from mitsplat.arrays import ByteImage
from mitsplat.dataset.records.record_schema import Records, read_content
from mitsplat.errors import InputError
from mitsplat.formats.coco import image_file
from mitsplat.images.picture_files import read_picture
from mitsplat.labels.labels import Labels
from mitsplat.labels.overlay import class_colour, draw_labels
from mitsplat.storage.files import Record, resolve_inside

OverlayName = Literal["labels", "silhouettes", "none"]
OVERLAYS: tuple[OverlayName, ...] = get_args(OverlayName)


@dataclass(frozen=True)
class Filter:
    """Conditions that at least one label of an image must fulfil together.

    Attributes:
        class_name: Class of the label; None accepts any class, and also images without labels.
        visible: Range of the visible fraction.
        size: Range of the longer side of the box [px].
    """

    class_name: str | None = None
    visible: tuple[float, float] = (0.0, 1.0)
    size: tuple[float, float] = (0.0, np.inf)


class DatasetIndex:
    """Labels of a dataset as arrays; records and images are read on demand.

    Args:
        root: Dataset folder.

    Attributes:
        classes: Names of the classes.
        unreadable: Number of unreadable lines of the manifest, which are skipped.

    Raises:
        InputError: If the folder is no dataset of mitsplat.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        content = read_content(root)
        self._records = Records(root, content)
        self.classes: tuple[str, ...] = tuple(content["classes"])
        numbers, rows = list[int](), list[tuple[int, int, float, int]]()
        for record in self._records:
            index = record["index"]
            numbers.append(index)
            for label in record["labels"]["instances"]:
                x0, y0, x1, y1 = label["box"]
                rows.append((index, label["class_index"], label["visible_fraction"], max(x1 - x0, y1 - y0)))
        self.unreadable = len(self._records.violations)
        self._frames = np.array(numbers, dtype=np.int64)
        self._labels = np.array(rows, dtype=np.float64).reshape(-1, 4)

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def largest(self) -> int:
        """Longer side of the largest label box [px]; 1 if there are no labels."""
        return int(self._labels[:, 3].max(initial=1))

    def find(self, wanted: Filter) -> list[int]:
        """Return the indices of the frames that pass a filter, ascending."""
        if wanted == Filter():
            return [int(index) for index in self._frames]
        if wanted.class_name is not None and wanted.class_name not in self.classes:
            return []
        frame, class_index, visible, size = self._labels.T
        passed = (visible >= wanted.visible[0]) & (visible <= wanted.visible[1])
        passed &= (size >= wanted.size[0]) & (size <= wanted.size[1])
        if wanted.class_name is not None:
            passed &= class_index == self.classes.index(wanted.class_name)
        return [int(index) for index in np.unique(frame[passed])]

    def record(self, index: int) -> Record:
        """Return the record of a frame.

        Raises:
            InputError: If it can no longer be read.
        """
        for record in self._records.of_frame(index):
            return record
        raise InputError(f"{self._root}: the record of frame {index} cannot be read")

    def picture(self, index: int, overlay: OverlayName = "labels") -> tuple[str, ByteImage]:
        """Return a caption and the RGB image (H, W, 3) of a frame with its labels drawn on it.

        Raises:
            InputError: If the image is missing, unreadable, or not a file of the dataset.
        """
        record = self.record(index)
        try:
            path = resolve_inside(self._root, image_file(record))
        except InputError as error:
            raise InputError(f"{self._root}: frame {index}: {error}") from error
        stored = read_picture(path, cv2.IMREAD_COLOR)
        height, width = record["labels"]["size"][::-1]
        if stored is None or stored.shape[:2] != (height, width):
            raise InputError(f"{path}: must be a readable image of {width}x{height} px")
        image = np.ascontiguousarray(stored[..., ::-1], dtype=np.uint8)
        labels = Labels.from_json(record["labels"])
        texts = ", ".join(
            f"{label.class_name} {label.visible_fraction:.0%}{''.join(f' {mark}' for mark in label.marks)}"
            for label in labels.instances
        )
        caption = f"frame {index}, {record['split']}: {texts or 'no labels'}"
        if overlay == "labels":
            return caption, draw_labels(image, labels)
        return caption, _draw_silhouettes(image, labels) if overlay == "silhouettes" else image


def _draw_silhouettes(image: ByteImage, labels: Labels) -> ByteImage:
    """Draw the unoccluded outline of each instance."""
    drawn = image.copy()
    for label in labels.instances:
        contours, _ = cv2.findContours(label.amodal.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        x0, y0 = label.amodal.box[:2]
        cv2.drawContours(drawn, contours, -1, class_colour(label.class_index), 2, offset=(x0, y0))
    return drawn
