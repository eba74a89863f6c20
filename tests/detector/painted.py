"""Small labelled images of discs and boxes, in every data format of a detector."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from pycocotools import mask as coco_mask

from mitsplat.arrays import BoolArray
from mitsplat.formats.yolo import data_yaml
from mitsplat.labels.polygons import outline

CLASSES = ("disc", "box")
WIDTH, HEIGHT = 96, 64
HUES = {"disc": (220, 60, 40), "box": (40, 80, 220)}

Shown = list[tuple[str, BoolArray]]
"""Class names and masks (H, W) of the objects in an image."""


def paint(seed: int, *, noise: float = 20.0) -> tuple[np.ndarray, Shown]:
    """Draw an image (H, W, 3) in BGR order with one or two disjoint objects, and return both."""
    rng = np.random.default_rng(seed)
    image = np.clip(rng.normal(110, noise, (HEIGHT, WIDTH, 3)), 0, 255)
    shown = []
    for left in (0, WIDTH // 2)[: int(rng.integers(1, 3))]:
        name = CLASSES[int(rng.integers(2))]
        radius = int(rng.integers(8, 16))
        x, y = left + int(rng.integers(18, 30)), int(rng.integers(18, HEIGHT - 18))
        mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        if name == "disc":
            cv2.circle(mask, (x, y), radius, 1, -1)
        else:
            cv2.rectangle(mask, (x - radius, y - radius // 2), (x + radius, y + radius // 2), 1, -1)
        image[mask > 0] = HUES[name][::-1]
        shown.append((name, mask > 0))
    return image.astype(np.uint8), shown


def yolo_text(shown: Shown, classes: tuple[str, ...] = CLASSES, *, boxes: bool = False) -> str:
    """Format the label file of an image."""
    lines = []
    for name, mask in shown:
        points = outline(mask) / (WIDTH, HEIGHT)
        if boxes:
            low, high = points.min(axis=0), points.max(axis=0)
            points = np.array([(low + high) / 2, high - low])
        lines.append(" ".join([str(classes.index(name)), *(f"{value:.6f}" for value in points.ravel())]) + "\n")
    return "".join(lines)


def write_yolo(
    root: Path,
    counts: dict[str, int],
    *,
    classes: tuple[str, ...] = CLASSES,
    boxes: bool = False,
    first: int = 0,
    mitsplat: bool = False,
) -> Path:
    """Write a YOLO folder, or the parts of a mitsplat dataset that a detector reads."""
    seed = first
    for split, count in counts.items():
        for folder in ("images", "labels"):
            (root / folder / split).mkdir(parents=True, exist_ok=True)
        for number in range(count):
            image, shown = paint(seed)
            cv2.imwrite(str(root / f"images/{split}/{number:06d}.png"), image)
            (root / f"labels/{split}/{number:06d}.txt").write_text(yolo_text(shown, classes, boxes=boxes))
            seed += 1
    (root / "data.yaml").write_text(data_yaml(classes, counts))
    if mitsplat:
        (root / "dataset.json").write_text("{}")
    return root


def write_coco(root: Path, count: int, *, form: str = "polygons", first: int = 0, crowd: bool = False) -> Path:
    """Write a COCO folder with masks as polygons, run lengths, compressed run lengths, or none.

    Its class order is the reverse of that of :func:`write_yolo`.
    """
    (root / "photos").mkdir(parents=True)
    images, annotations = [], []
    for number in range(count):
        image, shown = paint(first + number)
        cv2.imwrite(str(root / f"photos/p{number}.png"), image)
        images.append({"id": 10 * number, "file_name": f"p{number}.png", "width": WIDTH, "height": HEIGHT})
        for name, mask in shown:
            rle = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
            annotation = {
                "id": len(annotations) + 1,
                "image_id": 10 * number,
                "category_id": {"box": 3, "disc": 7}[name],
                "bbox": coco_mask.toBbox(rle).tolist(),
                "area": int(mask.sum()),
                "iscrowd": int(crowd),
            }
            if form == "polygons":
                fine = np.kron(mask, np.ones((8, 8), dtype=bool))  # places corners almost at the pixels' edges
                annotation["segmentation"] = [(outline(fine) / 8).ravel().tolist()]
            elif form == "compressed":
                annotation["segmentation"] = {"size": [HEIGHT, WIDTH], "counts": rle["counts"].decode()}
            elif form == "lengths":
                runs = np.flatnonzero(np.diff(np.pad(mask.T.ravel().astype(int), 1))).tolist()
                counts = np.diff([0, *runs, mask.size]).tolist()
                annotation["segmentation"] = {"size": [HEIGHT, WIDTH], "counts": counts}
            annotations.append(annotation)
    categories = [{"id": 7, "name": "disc"}, {"id": 3, "name": "box"}]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (root / "labels.json").write_text(json.dumps(content))
    return root
