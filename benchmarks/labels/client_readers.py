"""Readers of datasets by other programs, one function for each client, for `benchmarks.labels.clients`.

    python benchmarks/labels/client_readers.py CLIENT FORMAT DATASET OUT.json

This file runs in the environment of the client, without mitsplat. It writes, for each image, a list of class name, box
(x0, y0, x1, y1) [px], and mask as positions of changes along the rows of the image, or None without masks.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

Found = Iterator[tuple[str, str, Any, Any]]
"""Image name, class name, box (x0, y0, x1, y1) and mask (H, W) or None."""

FILES = {"coco": "instances", "coco-polygons": "polygons"}


def splits(root: Path) -> list[str]:
    """Return the splits that have images."""
    return [path.name for path in sorted((root / "images").iterdir()) if any(path.iterdir())]


def annotations(root: Path, form: str, split: str) -> str:
    """Return the COCO file of a format."""
    return str(root / f"annotations/{FILES[form]}_{split}.json")


def corners(box: Any) -> list[float]:
    """Convert x, y, width, height to x0, y0, x1, y1."""
    x, y, w, h = (float(value) for value in box)
    return [x, y, x + w, y + h]


def by_pycocotools(root: Path, form: str) -> Found:
    """Read COCO files with pycocotools."""
    from pycocotools.coco import COCO

    for split in splits(root):
        read = COCO(annotations(root, form, split))
        read.info()
        for number, image in read.imgs.items():
            for one in read.loadAnns(read.getAnnIds(number)):
                name = read.cats[one["category_id"]]["name"]
                yield image["file_name"], name, corners(one["bbox"]), read.annToMask(one)


def by_supervision(root: Path, form: str) -> Found:
    """Read COCO files and YOLO folders with supervision."""
    import supervision

    for split in splits(root):
        images = str(root / "images" / split)
        if form == "yolo":
            read = supervision.DetectionDataset.from_yolo(
                images, str(root / "labels" / split), str(root / "data.yaml"), force_masks=True
            )
        else:
            read = supervision.DetectionDataset.from_coco(images, annotations(root, form, split), force_masks=True)
        for path, _, found in read:
            masks = [] if found.mask is None else found.mask  # None if the image has no objects
            for box, mask, number in zip(found.xyxy, masks, found.class_id, strict=True):
                yield Path(path).name, read.classes[number], box.tolist(), mask


def by_ultralytics(root: Path, form: str) -> Found:
    """Read YOLO folders with the dataset of Ultralytics' trainers."""
    os.environ["YOLO_OFFLINE"] = "true"
    from ultralytics.data.dataset import YOLODataset
    from ultralytics.data.utils import check_det_dataset, polygon2mask

    folder = root / ("" if form == "yolo" else form)
    data = check_det_dataset(str(folder / "data.yaml"), autodownload=False)
    for split in splits(root):
        images, task = str(folder / "images" / split), "segment" if form == "yolo" else "detect"
        read = YOLODataset(img_path=images, data=data, task=task, augment=False)
        for label in read.labels:
            height, width = label["shape"]
            segments = label["segments"] or [None] * len(label["cls"])
            for number, (x, y, w, h), points in zip(label["cls"][:, 0], label["bboxes"], segments, strict=True):
                box = [(x - w / 2) * width, (y - h / 2) * height, (x + w / 2) * width, (y + h / 2) * height]
                mask = None
                if points is not None:
                    mask = polygon2mask((height, width), [(points * (width, height)).ravel()])
                yield Path(label["im_file"]).name, data["names"][int(number)], [float(value) for value in box], mask


def by_datumaro(root: Path, form: str) -> Found:
    """Import COCO and the boxes of YOLO with Datumaro, which CVAT uses."""
    import datumaro

    logging.disable(logging.CRITICAL)
    if form == "yolo-detect":
        reads = [datumaro.Dataset.import_from(str(root / form), "yolo")]
    else:
        reads = [
            datumaro.Dataset.import_from(annotations(root, form, split), "coco_instances") for split in splits(root)
        ]
    for read in reads:
        names = [label.name for label in read.categories()[datumaro.AnnotationType.label]]
        for item in read:
            found = sorted(item.annotations, key=lambda one: one.id)
            boxes = [one for one in found if one.type == datumaro.AnnotationType.bbox]
            masks = [one for one in found if one.type == datumaro.AnnotationType.mask] or [None] * len(boxes)
            for box, mask in zip(boxes, masks, strict=True):
                pixels = None if mask is None else np.asarray(mask.image)
                yield Path(item.id).name, names[box.label], corners(box.get_bbox()), pixels


def by_fiftyone(root: Path, form: str) -> Found:
    """Import COCO with FiftyOne, without its database."""
    from fiftyone.utils.coco import COCODetectionDatasetImporter

    for split in splits(root):
        importer = COCODetectionDatasetImporter(
            data_path=str(root / "images" / split),
            labels_path=annotations(root, form, split),
            label_types=["segmentations"],
        )
        with importer:
            for path, about, found in importer:
                width, height = about["width"], about["height"]
                for one in found.detections if found is not None else []:
                    box = corners(np.multiply(one.bounding_box, (width, height) * 2))
                    x0, y0 = round(box[0]), round(box[1])
                    mask = np.zeros((height, width), dtype=bool)
                    mask[y0 : y0 + one.mask.shape[0], x0 : x0 + one.mask.shape[1]] = one.mask
                    yield Path(path).name, one.label, box, mask


def by_label_studio(root: Path, form: str) -> Found:
    """Convert YOLO folders to tasks with the converter of the Label Studio SDK."""
    from label_studio_sdk.converter.imports.yolo import convert_yolo_to_ls

    names = json.loads((root / "dataset.json").read_text())["classes"]
    for split in splits(root):
        with tempfile.TemporaryDirectory() as folder:
            for kind in ("images", "labels"):
                (Path(folder) / kind).symlink_to(root / form / kind / split)
            (Path(folder) / "classes.txt").write_text("\n".join(names) + "\n")
            out = Path(folder) / "tasks.json"
            convert_yolo_to_ls(folder, str(out))
            for task in json.loads(out.read_text()):
                for one in task["annotations"][0]["result"] if task.get("annotations") else []:
                    value, size = one["value"], (one["original_width"], one["original_height"])
                    box = np.multiply([value[key] for key in ("x", "y", "width", "height")], np.array(size * 2) / 100)
                    yield Path(task["data"]["image"]).name, value["rectanglelabels"][0], corners(box), None


def by_bop_toolkit(root: Path, form: str) -> Found:
    """Read a BOP dataset with the toolkit's ``inout``."""
    from bop_toolkit_lib import inout

    inout.load_cam_params(root / "bop/camera.json")
    models = inout.load_json(root / "bop/models/models_info.json", keys_to_int=True)
    records = [json.loads(line) for line in (root / "manifest.jsonl").read_text().splitlines()]
    classes = {one["asset"] + 1: one["class"] for record in records for one in record["labels"]["instances"]}
    if missing := classes.keys() - models:
        raise ValueError(f"models_info.json lacks the objects {missing}")
    for scene in sorted(path.parent for path in (root / "bop").glob("*/*/scene_gt.json")):
        inout.load_scene_camera(scene / "scene_camera.json")
        poses = inout.load_scene_gt(scene / "scene_gt.json")
        infos = inout.load_json(scene / "scene_gt_info.json", keys_to_int=True)
        for number, placed in poses.items():
            (image,) = (scene / "rgb").glob(f"{number:06d}.*")
            for position, pose in enumerate(placed):
                x, y, w, h = infos[number][position]["bbox_visib"]  # w and h are one pixel less than the extent
                mask = inout.load_im(scene / f"mask_visib/{number:06d}_{position:06d}.png") > 0
                yield image.name, classes[pose["obj_id"]], [x, y, x + w + 1, y + h + 1], mask


def by_torchvision(root: Path, form: str) -> Found:
    """Read COCO files with torchvision's ``CocoDetection``."""
    import torch

    # The operators of its wheel do not load with a CPU build of PyTorch. The import needs their names, datasets none.
    for name in ("nms", "qnms"):
        torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    from torchvision.datasets import CocoDetection

    for split in splits(root):
        read = CocoDetection(str(root / "images" / split), annotations(root, form, split))
        for number, (_, found) in zip(read.ids, read, strict=True):
            for one in found:
                name = read.coco.cats[one["category_id"]]["name"]
                yield read.coco.imgs[number]["file_name"], name, corners(one["bbox"]), read.coco.annToMask(one)


def main() -> None:
    """Read a dataset and write what the client found."""
    client, form, root, out = sys.argv[1], sys.argv[2], Path(sys.argv[3]).resolve(), Path(sys.argv[4])
    found: dict[str, list[Any]] = {}
    for image, name, box, mask in globals()[f"by_{client}"](root, form):
        runs = None if mask is None else np.flatnonzero(np.diff(np.asarray(mask).astype(bool).ravel(), prepend=False))
        found.setdefault(Path(image).stem, []).append([name, box, None if runs is None else runs.tolist()])
    out.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
