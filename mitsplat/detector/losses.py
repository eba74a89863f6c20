"""Which errors of a detector cost it most: what its average precision would be without each kind of them.

After Bolya et al. 2020, "TIDE: A General Toolbox for Identifying Object Detection Errors": each kind is mended as an
oracle would, everything else is left, and average precision is measured again. Gains do not add up.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mitsplat.detector.scores import IOU, AveragePrecision, Detection, DetectionMatches, overlaps

NEAR = 0.1
"""Overlap of boxes from which a detection is one of a label of its class that fits badly."""

KINDS = {
    "another_class": "taken for another class",
    "nothing": "found where it is not",
    "place": "boxes that do not fit",
    "missed": "missed",
}
"""Of errors, and in words."""


def gains(truth: Mapping[str, Any], detections: Sequence[Detection], before: AveragePrecision) -> dict[str, float]:
    """How much the average precision of boxes (mAP50-95) would rise if one kind of error (:data:`KINDS`) were mended.

    Args:
        truth: What is labelled.
        detections: What was found.
        before: Their average precision.

    Returns:
        Gains by kind; none if nothing is labelled.
    """
    if not before.classes:
        return {}
    found: dict[str, list[Detection]] = {kind: [] for kind in KINDS}
    hit: set[int] = set()
    by_image = _by_image(truth["annotations"])
    for image, seen in _by_image(detections).items():
        judged = _judge(sorted(seen, key=lambda one: -one["score"]), by_image.get(image, []), hit)
        for kind, mended in judged.items():
            found[kind] += mended
    missed = [one for one in truth["annotations"] if one["id"] not in hit and not one.get("iscrowd")]
    kept = ("image_id", "category_id", "bbox")
    found["missed"] = [*detections, *({key: one[key] for key in kept} | {"score": 1.0} for one in missed)]
    return {
        kind: DetectionMatches(truth, mended).average_precision().map50_95 - before.map50_95
        for kind, mended in found.items()
    }


def _by_image(entries: Sequence[Mapping[str, Any]]) -> dict[int, list[Any]]:
    found = defaultdict(list)
    for entry in entries:
        found[entry["image_id"]].append(entry)
    return found


def _judge(seen: Sequence[Detection], labels: Sequence[Mapping[str, Any]], hit: set[int]) -> dict[str, list[Detection]]:
    """The detections of an image by falling score, with each kind of error mended; labels that are found go to ``hit``.

    The class of one that is taken for another becomes right, unless what is labelled was found as well. What fits badly
    gets the label's box.
    """
    mended: dict[str, list[Detection]] = {kind: [] for kind in KINDS if kind != "missed"}
    crowds = [bool(one.get("iscrowd")) for one in labels]
    overlap = overlaps([one["bbox"] for one in seen], [one["bbox"] for one in labels], crowds)
    classes = np.array([one["category_id"] for one in labels])
    taken: set[int] = set()
    for detection, row in zip(seen, overlap, strict=True):
        own = np.where(classes == detection["category_id"], row, 0.0)
        free = np.where(np.isin(np.arange(len(labels)), list(taken)), 0.0, own)
        kept = dict.fromkeys(mended, detection)
        if free.max(initial=0.0) >= IOU:
            label = int(free.argmax())
            if not crowds[label]:
                taken.add(label)
                hit.add(int(labels[label]["id"]))
                kept["place"] = {**detection, "bbox": labels[label]["bbox"]}
        elif own.max(initial=0.0) >= IOU:
            pass  # another one of it, which may fit better than the first
        elif row.max(initial=0.0) >= IOU:
            label = int(row.argmax())
            if label in taken or crowds[label]:
                del kept["another_class"]
            else:
                kept["another_class"] = {**detection, "category_id": labels[label]["category_id"]}
        elif free.max(initial=0.0) >= NEAR:
            kept["place"] = {**detection, "bbox": labels[int(free.argmax())]["bbox"]}
        else:
            del kept["nothing"]
        for kind, one in kept.items():
            mended[kind].append(one)
    return mended
