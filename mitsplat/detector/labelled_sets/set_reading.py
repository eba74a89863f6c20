"""Labelled images, read from a folder of any kind."""

from __future__ import annotations

from pathlib import Path

from mitsplat.detector.labelled_sets.coco_folder import read_coco
from mitsplat.detector.labelled_sets.labelled_set import LabelledSet, Split
from mitsplat.detector.labelled_sets.yolo_folder import CLASSES_FILE, read_mitsplat, read_yolo
from mitsplat.errors import InputError
from mitsplat.progress import Progress


def read_set(path: str | Path, split: Split, progress: Progress | None = None) -> LabelledSet:
    """Read labelled images.

    Args:
        path: A mitsplat dataset, a YOLO folder, or a COCO folder.
        split: Split to read. For COCO, this is the file with the split in its name; a single file is always read
            completely.
        progress: Called after each image.

    Raises:
        InputError: If the folder is of none of these kinds or has no image in the split. Also if an image or a label is
            missing, truncated or out of range.
    """
    root = Path(path)
    if not root.is_dir():
        raise InputError(f"{root}: must be the folder of a dataset (got {'a file' if root.exists() else 'nothing'})")
    if (root / "dataset.json").is_file():
        return read_mitsplat(root, split, progress)
    if (root / "data.yaml").is_file() or ((root / CLASSES_FILE).is_file() and (root / "images").is_dir()):
        return read_yolo(root, split, progress)
    return read_coco(root, split, progress)
