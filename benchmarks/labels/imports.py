"""COCO files of a dataset, read by other tools and compared with the manifest.

    python benchmarks/labels/imports.py datumaro DATASET      # pip install datumaro pycocotools; CVAT imports by it
    python benchmarks/labels/imports.py fiftyone DATASET      # pip install fiftyone pycocotools

Each tool has its own environment, which needs no mitsplat. The dataset must have the format coco. Every image, class,
box and mask must equal that of the manifest. FiftyOne's importer is called without its database.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # the package itself requires mitsplat
from record import figure, recording

Instances = dict[str, list[Any]]


class Truth:
    """Instances of the manifest by split and image name, and counts of comparisons."""

    def __init__(self, root: Path) -> None:
        self.splits: dict[str, Instances] = {"train": {}, "val": {}}
        for line in (root / "manifest.jsonl").read_text().splitlines():
            record = json.loads(line)
            self.splits[record["split"]][f"{record['index']:06d}"] = record["labels"]["instances"]
            self.width, self.height = record["labels"]["size"]
        self.images = self.boxes = self.masks = 0

    def check_box(self, label: Any, name: str, box: Any) -> None:
        """Compare a class and a box of x, y, width, height [px]."""
        x0, y0, x1, y1 = label["box"]
        if name != label["class"] or not np.allclose(box, [x0, y0, x1 - x0, y1 - y0]):
            raise SystemExit(f"{name} at {box} is {label['class']} at {label['box']} in the manifest")
        self.boxes += 1

    def check_mask(self, label: Any, mask: Any) -> None:
        """Compare a mask of the whole image or of its box."""
        x0, y0, x1, y1 = label["box"]
        whole = coco_mask.decode({"size": [self.height, self.width], "counts": label["rle"]}).astype(bool)
        expected = whole if mask.shape == whole.shape else whole[y0:y1, x0:x1]
        if mask.shape != expected.shape or (mask.astype(bool) != expected).any():
            raise SystemExit(f"the mask of {label['class']} at {label['box']} is not the manifest's")
        self.masks += 1


def by_datumaro(root: Path, truth: Truth) -> None:
    """Import COCO with Datumaro."""
    import datumaro

    logging.getLogger().setLevel(logging.ERROR)  # Datumaro reports every JSON file of another format
    read = datumaro.Dataset.import_from(str(root), "coco_instances")
    names = [label.name for label in read.categories()[datumaro.AnnotationType.label]]
    for split, items in read.subsets().items():
        for item in items:
            labels = truth.splits[split].pop(item.id)
            truth.images += item.media.data.shape[:2] == (truth.height, truth.width)
            annotations = sorted(item.annotations, key=lambda one: one.id)
            for kind in (datumaro.AnnotationType.bbox, datumaro.AnnotationType.mask):
                found = [one for one in annotations if one.type == kind]
                for label, one in zip(labels, found, strict=bool(found) or not labels):
                    if kind == datumaro.AnnotationType.mask:
                        truth.check_mask(label, np.asarray(one.image))
                    else:
                        truth.check_box(label, names[one.label], one.get_bbox())


def by_fiftyone(root: Path, truth: Truth) -> None:
    """Import COCO with FiftyOne."""
    from fiftyone.utils.coco import COCODetectionDatasetImporter

    for split, instances in truth.splits.items():
        importer = COCODetectionDatasetImporter(
            data_path=str(root / "images" / split),
            labels_path=str(root / f"annotations/instances_{split}.json"),
            label_types=["segmentations"],
        )
        with importer:
            for path, _, found in importer:
                labels = instances.pop(Path(path).stem)
                truth.images += 1
                for label, one in zip(labels, found.detections if found is not None else [], strict=True):
                    box = np.multiply(one.bounding_box, (truth.width, truth.height) * 2)
                    truth.check_box(label, one.label, box)
                    truth.check_mask(label, one.mask)


def main() -> None:
    """Print the counts of comparisons."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tool", choices=("datumaro", "fiftyone"))
    parser.add_argument("dataset", type=Path)
    options = parser.parse_args()
    command = "python", "benchmarks/labels/imports.py"
    with recording("labels.imports", parser, options, ignore=("dataset",), command=command):
        compare(options)


def compare(options: argparse.Namespace) -> None:
    """Import and compare all files."""
    truth = Truth(options.dataset)
    held = [instances for split in truth.splits.values() for instances in split.values()]
    figure(len(held), "", "images")
    figure(sum(map(len, held)), "", "instances")
    tools = {"datumaro": by_datumaro, "fiftyone": by_fiftyone}
    tools[options.tool](options.dataset, truth)
    if missing := [name for instances in truth.splits.values() for name in instances]:
        raise SystemExit(f"images that were not imported: {missing}")
    for count, what in ((truth.images, "images"), (truth.boxes, "boxes"), (truth.masks, "masks")):
        figure(count, "", "compared", what)
    print(f"{options.tool}: {truth.images} images, {truth.boxes} boxes, {truth.masks} masks as in the manifest")


if __name__ == "__main__":
    main()
