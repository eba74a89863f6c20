"""Loss of average precision by kind of error.

Method of Bolya et al. 2020, "TIDE: A General Toolbox for Identifying Object Detection Errors": an oracle corrects one
kind of error, and average precision is computed again. The gains of the kinds do not add up.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from mitsplat.detector.scores import IOU, AveragePrecision, Detection, DetectionMatches, overlaps
from mitsplat.storage.files import JsonObject

MIN_NEAR_IOU = 0.1
"""Least IoU of a badly placed box with a label of its class."""

ERROR_KINDS = {
    "another_class": "wrong class",
    "nothing": "false detection",
    "place": "badly placed box",
    "missed": "missed",
}
"""Kinds of errors and their descriptions."""


def error_gains(truth: JsonObject, detections: Sequence[Detection], before: AveragePrecision) -> dict[str, float]:
    """Return the gain in box mAP50-95 if one kind of error (:data:`ERROR_KINDS`) is corrected.

    Args:
        truth: The labels.
        detections: The detections.
        before: Average precision of the detections.

    Returns:
        Gains by kind; empty if nothing is labelled.
    """
    if not before.classes:
        return {}
    found: dict[str, list[Detection]] = {kind: [] for kind in ERROR_KINDS}
    hit: set[int] = set()
    by_image = _by_image(truth["annotations"])
    for image, seen in _by_image(detections).items():
        judged = _correct_errors(sorted(seen, key=lambda one: -one["score"]), by_image.get(image, []), hit)
        for kind, corrected in judged.items():
            found[kind] += corrected
    missed = [one for one in truth["annotations"] if one["id"] not in hit and not one.get("iscrowd")]
    keys = ("image_id", "category_id", "bbox")
    found["missed"] = [*detections, *({key: one[key] for key in keys} | {"score": 1.0} for one in missed)]
    return {
        kind: DetectionMatches(truth, corrected).average_precision().map50_95 - before.map50_95
        for kind, corrected in found.items()
    }


def _by_image(entries: Sequence[JsonObject]) -> dict[int, list[JsonObject]]:
    found = defaultdict(list)
    for entry in entries:
        found[entry["image_id"]].append(entry)
    return found


def _correct_errors(
    seen: Sequence[Detection], labels: Sequence[JsonObject], hit: set[int]
) -> dict[str, list[Detection]]:
    """Return the detections of an image with each kind of error corrected, and add the detected labels to ``hit``.

    ``seen`` is sorted by descending score. A detection of the wrong class gets the right class, or is removed if the
    label was detected already. A badly placed box gets the box of its label.
    """
    corrected: dict[str, list[Detection]] = {kind: [] for kind in ERROR_KINDS if kind != "missed"}
    crowds = [bool(one.get("iscrowd")) for one in labels]
    overlap = overlaps([one["bbox"] for one in seen], [one["bbox"] for one in labels], crowds)
    classes = np.array([one["category_id"] for one in labels])
    taken: set[int] = set()
    for detection, row in zip(seen, overlap, strict=True):
        own = np.where(classes == detection["category_id"], row, 0.0)
        free = np.where(np.isin(np.arange(len(labels)), list(taken)), 0.0, own)
        variants = dict.fromkeys(corrected, detection)
        if free.max(initial=0.0) >= IOU:
            label = int(free.argmax())
            if not crowds[label]:
                taken.add(label)
                hit.add(int(labels[label]["id"]))
                variants["place"] = {**detection, "bbox": labels[label]["bbox"]}
        elif own.max(initial=0.0) >= IOU:
            pass  # a duplicate, which may fit better than the first detection
        elif row.max(initial=0.0) >= IOU:
            label = int(row.argmax())
            if label in taken or crowds[label]:
                del variants["another_class"]
            else:
                variants["another_class"] = {**detection, "category_id": labels[label]["category_id"]}
        elif free.max(initial=0.0) >= MIN_NEAR_IOU:
            variants["place"] = {**detection, "bbox": labels[int(free.argmax())]["bbox"]}
        else:
            del variants["nothing"]
        for kind, one in variants.items():
            corrected[kind].append(one)
    return corrected
