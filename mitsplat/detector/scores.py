"""Detection scores by COCO's rules, from stored labels and detections.

``truth`` is a COCO dataset of instances: ``images`` and ``annotations``, numbered from 1, and ``categories``.
``detections`` is a list in COCO's results format: ``image_id``, ``category_id``, ``bbox`` (x, y, width, height in px),
``score``, and ``segmentation`` (compressed run lengths) if there are masks.
"""

from __future__ import annotations

import contextlib
import io
from collections import defaultdict
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.storage.files import JsonObject

IouType = Literal["bbox", "segm"]
Detection = dict[str, Any]

MAX_DETECTIONS = 300
"""Largest number of detections per image over all classes, by score. COCO's own summary uses 100 per class."""
CONFIDENCE, IOU = 0.25, 0.5
"""Least score and least box IoU of a detection in the confusion matrix."""


@dataclass(frozen=True, eq=False)
class AveragePrecision:
    """Average precision, as a mean over the labelled classes and by class.

    Attributes:
        map50_95: Mean over the IoU thresholds 0.5 to 0.95 in steps of 0.05; NaN if nothing is labelled.
        map50: Average precision at the IoU threshold 0.5.
        classes: Both values by class, without classes that have no labels.
        curves: Precision at IoU 0.5 over recall 0, 0.01, ..., 1, by class, shape (101,) each.
    """

    map50_95: float
    map50: float
    classes: dict[str, tuple[float, float]]
    curves: dict[str, Float64Array]


class DetectionMatches:
    """Matches of detections with labels in each image, computed once for the scores of any sample of the images.

    Args:
        truth: The labels.
        detections: The detections.
        iou_type: Overlap of boxes or of masks.

    Raises:
        InputError: If a detection has an image or a class that is not in ``truth``.
    """

    def __init__(self, truth: JsonObject, detections: Sequence[Detection], iou_type: IouType = "bbox") -> None:
        self.images = [image["id"] for image in truth["images"]]
        self._names = {category["id"]: str(category["name"]) for category in truth["categories"]}
        known = set(self.images)
        for detection in detections:
            if detection["image_id"] not in known or detection["category_id"] not in self._names:
                raise InputError(
                    "detections must refer to images and classes of the labels (got image "
                    f"{detection['image_id']}, class {detection['category_id']})"
                )
        with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints progress messages
            labelled = _coco(truth)
            found = (
                labelled.loadRes([dict(detection) for detection in detections])
                if detections
                else _coco({**truth, "annotations": []})
            )
            self._eval = COCOeval(labelled, found, iou_type)
            self._eval.params.maxDets = [MAX_DETECTIONS]
            self._eval.params.areaRng, self._eval.params.areaRngLbl = [[0, 1e10]], ["all"]
            self._eval.evaluate()
        self._place = {image: i for i, image in enumerate(self._eval.params.imgIds)}

    def average_precision(self, images: Sequence[int] | None = None) -> AveragePrecision:
        """Compute the average precision on some images, or on all images if None.

        A repeated image counts again, as in a bootstrap.

        Raises:
            InputError: If the list is empty or contains an unknown image.
        """
        ids = self.images if images is None else list(images)
        if not ids or not self._place.keys() >= set(ids):
            raise InputError("images must be a non-empty list of labelled images")
        sample, total, params = copy(self._eval), len(self._place), copy(self._eval.params)
        places = [self._place[image] for image in ids]
        sample.evalImgs = [self._eval.evalImgs[k * total + i] for k in range(len(params.catIds)) for i in places]
        params.imgIds = list(range(len(ids)))
        sample.params = sample._paramsEval = params
        with contextlib.redirect_stdout(io.StringIO()):
            sample.accumulate()
        precision = sample.eval["precision"][:, :, :, 0, 0]  # thresholds, recalls, classes
        labelled = [k for k in range(len(params.catIds)) if precision[0, 0, k] >= 0]
        names = [self._names[params.catIds[k]] for k in labelled]
        values = precision[:, :, labelled].mean(axis=1)  # thresholds, classes
        return AveragePrecision(
            float(values.mean()) if labelled else float("nan"),
            float(values[0].mean()) if labelled else float("nan"),
            {name: (float(values[:, i].mean()), float(values[0, i])) for i, name in enumerate(names)},
            {name: precision[0, :, k] for name, k in zip(names, labelled, strict=True)},
        )


@dataclass(frozen=True, eq=False)
class Confusion:
    """Confusion matrix of detections with a score of at least :data:`CONFIDENCE` and a box IoU of at least :data:`IOU`.

    Attributes:
        matrix: Counts by labelled class (rows) and detected class (columns); the last row and column stand for nothing.
        errors: Numbers of correct, missed, wrongly classified and false detections, by image id.
    """

    matrix: Int64Array
    errors: dict[int, tuple[int, int, int, int]]


def confuse(truth: JsonObject, detections: Sequence[Detection]) -> Confusion:
    """Compare the classes of overlapping detections and labels; detections with higher scores are matched first."""
    index = {category["id"]: i for i, category in enumerate(truth["categories"])}
    nothing = len(index)
    matrix = np.zeros((nothing + 1, nothing + 1), dtype=np.int64)
    labels, found, errors = defaultdict(list), defaultdict(list), {}
    for annotation in truth["annotations"]:
        if not annotation.get("iscrowd"):
            labels[annotation["image_id"]].append(annotation)
    for detection in detections:
        if detection["score"] >= CONFIDENCE:
            found[detection["image_id"]].append(detection)
    for image in (image["id"] for image in truth["images"]):
        own, seen = labels[image], sorted(found[image], key=lambda detection: -detection["score"])
        pairs = match_boxes([d["bbox"] for d in seen], [a["bbox"] for a in own])
        own_index, seen_index = ([index[x["category_id"]] for x in xs] for xs in (own, seen))
        right = confused = 0
        for d, a in pairs.items():
            matrix[own_index[a], seen_index[d]] += 1
            right += own_index[a] == seen_index[d]
            confused += own_index[a] != seen_index[d]
        missed = [a for a in range(len(own)) if a not in pairs.values()]
        extra = [d for d in range(len(seen)) if d not in pairs]
        for a in missed:
            matrix[own_index[a], nothing] += 1
        for d in extra:
            matrix[nothing, seen_index[d]] += 1
        errors[image] = right, len(missed), confused, len(extra)
    return Confusion(matrix, errors)


def match_boxes(found: Sequence[Sequence[float]], labelled: Sequence[Sequence[float]]) -> dict[int, int]:
    """Match each detected box, in the given order, with the unmatched labelled box of largest IoU.

    Returns:
        Indices of labelled boxes by index of the detected box, for pairs with an IoU of at least :data:`IOU`.
    """
    pairs: dict[int, int] = {}
    if not labelled:
        return pairs
    free = overlaps(found, labelled)
    for d, row in enumerate(free):
        best = int(row.argmax())
        if row[best] >= IOU:
            pairs[d] = best
            free[:, best] = 0
    return pairs


def overlaps(
    found: Sequence[Sequence[float]], labelled: Sequence[Sequence[float]], crowds: Sequence[bool] | None = None
) -> Float64Array:
    """Compute the IoU (N, M) of N detected boxes with M labelled ones; by default no label is a crowd."""
    if not found or not labelled:
        return np.zeros((len(found), len(labelled)))
    boxes = (np.array(those, dtype=np.float64) for those in (found, labelled))
    return np.asarray(coco_mask.iou(*boxes, [int(crowd) for crowd in crowds or [False] * len(labelled)]))


def _coco(content: JsonObject) -> COCO:
    coco = COCO()
    coco.dataset = dict(content)
    coco.createIndex()
    return coco
