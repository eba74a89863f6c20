"""A dataset read by Ultralytics, compared with the manifest, and one epoch of training on it.

    pip install '.[train]'
    python -m benchmarks.labels.train DATASET [--size 320] [--batch 6]

The masks are those of the loss, from Ultralytics' loader at the images' own size. The comparison therefore includes
text, resampling, letterbox and filling. The network starts without pretrained weights, on the CPU, and nothing is
downloaded.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from benchmarks.record import figure, recording
from mitsplat.labels.labels import Labels

os.environ["YOLO_OFFLINE"] = "true"


def compare(root: Path, data: dict[str, Any], split: str) -> tuple[int, list[float], list[float], float]:
    """Compare a split; return the number of images, IoUs, and the box error [px].

    IoUs are those of instances over 200 px in one part, and of all others.
    """
    import cv2
    from ultralytics.cfg import get_cfg
    from ultralytics.data.dataset import YOLODataset

    records = [json.loads(line) for line in (root / "manifest.jsonl").read_text().splitlines()]
    truths = {record["index"]: Labels.from_json(record["labels"]) for record in records}
    first = next(iter(truths.values()))
    side = max(first.width, first.height)
    settings = get_cfg(overrides={"mask_ratio": 1, "overlap_mask": False})
    read = YOLODataset(
        img_path=str(root / "images" / split), data=data, task="segment", imgsz=side, augment=False, hyp=settings
    )
    whole, parted, worst = [], [], 0.0
    for item in (read[i] for i in range(len(read))):
        truth = truths[int(Path(item["im_file"]).stem)]
        kinds = item["cls"].ravel().int().tolist()
        if kinds != [label.class_index for label in truth.instances]:
            raise SystemExit(f"{item['im_file']}: classes {kinds} are not the manifest's")
        left, top = (side - truth.width) // 2, (side - truth.height) // 2  # padding of the letterbox
        boxes = item["bboxes"].numpy().reshape(-1, 4) * side
        for label, box, mask in zip(truth.instances, boxes, item["masks"].numpy(), strict=True):
            canvas = np.zeros((side, side), dtype=bool)
            x0, y0, x1, y1 = label.box
            canvas[top + y0 : top + y1, left + x0 : left + x1] = label.mask
            iou = np.count_nonzero(canvas & (mask > 0)) / np.count_nonzero(canvas | (mask > 0))
            parts = cv2.connectedComponents(label.mask.astype(np.uint8), connectivity=8)[0] - 1
            (whole if label.area > 200 and parts == 1 else parted).append(iou)
            x, y, w, h = box
            found = np.array([x - w / 2 - left, y - h / 2 - top, x + w / 2 - left, y + h / 2 - top])
            worst = max(worst, float(np.abs(found - label.box).max()))
    return len(read), whole, parted, worst


def main() -> None:
    """Print the comparison, and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--batch", type=int, default=6)
    parser.add_argument("--model", default="yolo11n-seg.yaml")
    options = parser.parse_args()
    with recording("labels.train", parser, options, ignore=("dataset",)):
        measure(options)


def measure(options: argparse.Namespace) -> None:
    """Compare both splits, and train."""
    import ultralytics

    root = options.dataset.resolve()
    data = YAML(typ="safe").load(root / "data.yaml")
    data |= {"nc": len(data["names"]), "channels": 3}
    total = 0
    for split in ("train", "val"):
        images, whole, parted, worst = compare(root, data, split)
        total += images
        figure(worst, "px", split, "boxes worst")
        for values, kind in ((whole, "whole"), (parted, "parted")):
            figure(len(values), "", split, kind, "instances")
            figure(min(values, default=float("nan")), "", split, kind, "least iou")
        ious = [f"{np.min(values):.4f} ({len(values)} instances)" if values else "none" for values in (whole, parted)]
        print(f"{split}: {images} images; least IoU with the manifest's masks, over 200 px in one part {ious[0]}, ")
        print(f"  smaller or in parts {ious[1]}; boxes within {worst:.3f} px; classes as in the manifest")
    figure(total, "", "images")
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        model = ultralytics.YOLO(options.model)
        result = model.train(
            data=str(root / "data.yaml"), epochs=1, imgsz=options.size, batch=options.batch, device="cpu", workers=0,
            plots=False, val=True, verbose=False, project=folder, exist_ok=True,
        )  # fmt: skip
        losses = (Path(model.trainer.save_dir) / "results.csv").read_text().splitlines()
    seconds = time.perf_counter() - start
    figure(ultralytics.__version__, "", "ultralytics")
    figure(seconds, "s", "epoch")
    print(f"Ultralytics {ultralytics.__version__}: one epoch in {seconds:.0f} s")
    for name, value in zip(losses[0].split(","), losses[-1].split(","), strict=True):
        if "loss" in name:
            print(f"  {name.strip()}: {value.strip()}")
    print(f"  fitness: {result.fitness:.4g}")


if __name__ == "__main__":
    main()
