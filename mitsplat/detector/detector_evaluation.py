"""Evaluation of a trained detector on labelled images.

The evaluation folder::

    results.json      average precision of boxes and masks, in total and by class; cost of each kind of error; confusion
                      matrix; provenance (run, weights, versions, data)
    detections.json   all detections, in COCO's results format
    truth.json        the labels as a COCO dataset, with the image and category ids of detections.json
    report.html       the report page
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsplat.detector.detector_report import make_report
from mitsplat.detector.labelled_sets.labelled_set import LabelledSet, Sample, Split, check_masks, match_classes
from mitsplat.detector.labelled_sets.pictures import read_upright
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.libraries import (
    STRIDE,
    check_device,
    check_torchvision,
    check_weights,
    linked_weights,
    load_libraries,
    torch_device,
    versions,
)
from mitsplat.detector.losses import error_gains
from mitsplat.detector.scores import (
    CONFIDENCE,
    IOU,
    MAX_DETECTIONS,
    AveragePrecision,
    Detection,
    DetectionMatches,
    confuse,
)
from mitsplat.detector.training import check_folder, open_run
from mitsplat.errors import InputError
from mitsplat.images.masks import encode_mask
from mitsplat.pages.html import REPORT_FILE
from mitsplat.progress import Progress
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.files import JsonObject, storage_errors, write_text

MIN_SCORE, NMS_IOU = 0.001, 0.7
"""Least score of stored detections, and IoU threshold of the non-maximum suppression within a class."""

_EVALUATION_FILES = frozenset(("truth.json", "detections.json", "results.json", REPORT_FILE))
"""Names of the files of an evaluation."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of a detector evaluation.

    Attributes:
        path: Folder of the evaluation.
        results: Content of ``results.json``.
    """

    path: Path
    results: JsonObject

    @property
    def page(self) -> Path:
        """Path of the HTML report."""
        return self.path / REPORT_FILE


def evaluate_detector(
    run: str | Path,
    data: str | Path,
    out: str | Path | None = None,
    *,
    split: Split = "val",
    size: int | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> Evaluation:
    """Predict on labelled images with the weights of a run, and write the evaluation.

    Args:
        run: Folder of a finished training.
        data: A mitsplat dataset, a YOLO folder or a COCO folder. Labels of classes that the detector does not have are
            not used; a warning names them.
        out: Output folder; ``evaluation/<name of data>-<split>`` in the run by default. An existing evaluation is
            replaced.
        split: Split of the images to evaluate.
        size: Longer side to which images are scaled [px]; the size of the training by default.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``, with PyTorch's GPU numbers.
        progress: Called after each image.

    Raises:
        InputError: If the run is not finished, the images do not satisfy :func:`mitsplat.detector.read_set`, the data
            lack a class of the detector, or the detector predicts masks and the labels are only boxes. Also if ``out``
            contains the images or unrelated files.
        MissingResourceError: If Ultralytics or the GPU is missing.
    """
    trained, root = open_run(run), Path(data)
    check_device(device)
    size = int(trained.record["settings"]["size"]) if size is None else size
    if size < STRIDE or size % STRIDE:
        raise InputError(f"--size must be a multiple of {STRIDE} px (got {size})")
    found = match_classes(read_set(root, split, progress), trained.class_names, str(trained.path))
    if trained.has_masks:
        check_masks(found)
    name = f"{root.resolve().name}-{split}"
    out = trained.path / "evaluation" / name if out is None else Path(out)
    if root.resolve().is_relative_to(out.resolve()):
        raise InputError(f"{out}: must not contain the evaluated images, {root}: choose another folder")
    check_folder(out, "an evaluation", _EVALUATION_FILES)
    load_libraries()
    check_torchvision()
    network = str(trained.record["settings"]["model"])
    check_weights(trained.weights, network, masks=trained.has_masks, classes=len(trained.class_names))
    number, device_name = torch_device(device)
    started = time.perf_counter()
    detections = detect(
        trained.weights, found.samples, masks=trained.has_masks, size=size, device=number, progress=progress
    )
    about = {
        "run": str(trained.path),
        "weights": file_hash(trained.weights),
        "size": size,
        "device": device_name,
        "versions": versions(),
        "seconds": round(time.perf_counter() - started, 1),
    }
    return write_evaluation(found, detections, out, masks=trained.has_masks, about=about)


def detect(
    weights: Path,
    samples: Sequence[Sample],
    *,
    masks: bool,
    size: int,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[Detection]:
    """Return the detections of Ultralytics weights in images, in COCO's results format.

    Image ids count from 1. Images are predicted one at a time, so the result of an image does not depend on the others.
    Masks have the size of the image.
    """
    from ultralytics import YOLO  # optional

    with linked_weights(weights) as name:
        model, found = YOLO(name, task="segment" if masks else "detect"), []
    for number, sample in enumerate(samples, start=1):
        (result,) = model.predict(
            read_upright(sample.path),
            conf=MIN_SCORE,
            iou=NMS_IOU,
            max_det=MAX_DETECTIONS,
            imgsz=size,
            device=device,
            rect=False,
            retina_masks=True,
            verbose=False,
        )
        boxes = result.boxes.xyxy.cpu().numpy().astype(np.float64)
        scores, kinds = result.boxes.conf.cpu().numpy(), result.boxes.cls.cpu().numpy()
        for i, (x0, y0, x1, y1) in enumerate(boxes.tolist()):
            detection: Detection = {
                "image_id": number,
                "category_id": int(kinds[i]) + 1,
                "bbox": [round(value, 3) for value in (x0, y0, x1 - x0, y1 - y0)],
                "score": round(float(scores[i]), 6),
            }
            if masks:
                left, top = max(math.floor(x0), 0), max(math.floor(y0), 0)
                right, bottom = min(math.ceil(x1) + 1, sample.width), min(math.ceil(y1) + 1, sample.height)
                mask = result.masks.data[i, top:bottom, left:right].cpu().numpy() > 0
                counts = encode_mask(mask, (left, top, right, bottom), (sample.width, sample.height))
                detection["segmentation"] = {"size": [sample.height, sample.width], "counts": counts}
            found.append(detection)
        if progress is not None:
            progress(number, len(samples), "predicting")
    return found


def coco_truth(found: LabelledSet, *, masks: bool) -> JsonObject:
    """Return the labels as a COCO dataset; ids of images, annotations and categories count from 1."""
    annotations: list[JsonObject] = []
    for number, sample in enumerate(found.samples, start=1):
        for instance in sample.instances:
            x0, y0, x1, y1 = instance.box
            annotation = {
                "id": len(annotations) + 1,
                "image_id": number,
                "category_id": instance.class_index + 1,
                "bbox": [round(value, 3) for value in (x0, y0, x1 - x0, y1 - y0)],
                "area": round((x1 - x0) * (y1 - y0), 3),
                "iscrowd": int(instance.crowd),
            }
            if masks:
                annotation["segmentation"] = instance.encode_mask(sample.width, sample.height)
            annotations.append(annotation)
    return {
        "images": [
            {"id": number, "file_name": sample.name, "width": sample.width, "height": sample.height}
            for number, sample in enumerate(found.samples, start=1)
        ],
        "annotations": annotations,
        "categories": [{"id": i, "name": name} for i, name in enumerate(found.class_names, start=1)],
    }


def write_evaluation(
    found: LabelledSet, detections: Sequence[Detection], out: str | Path, *, masks: bool, about: JsonObject
) -> Evaluation:
    """Compare stored detections with the labels, and write the evaluation folder; Ultralytics is not needed.

    Args:
        found: The labelled images.
        detections: Detections in COCO's results format, with ids as in :func:`coco_truth`.
        out: Output folder.
        masks: True to evaluate masks as well as boxes.
        about: Further entries of ``results.json``, for example how the detections were made.
    """
    out, truth = Path(out), coco_truth(found, masks=masks)
    scores = {"box": DetectionMatches(truth, detections, "bbox").average_precision()}
    if masks:
        scores["mask"] = DetectionMatches(truth, detections, "segm").average_precision()
    confusion = confuse(truth, detections)
    results = {
        **about,
        "data": found.to_record(),
        "rules": {
            "least_score": MIN_SCORE,
            "nms_iou": NMS_IOU,
            "most_detections": MAX_DETECTIONS,
            "confusion": {"least_score": CONFIDENCE, "iou": IOU},
        },
        **{kind: _score_record(score) for kind, score in scores.items()},
        "gains": {kind: round(gain, 5) for kind, gain in error_gains(truth, detections, scores["box"]).items()},
        "confusion": {"classes": [*found.class_names, "nothing"], "matrix": confusion.matrix.tolist()},
    }
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        write_text(out / "truth.json", json.dumps(truth))
        write_text(out / "detections.json", json.dumps(list(detections)))
        write_text(out / REPORT_FILE, make_report(found, truth, detections, scores, confusion, results))
        write_text(out / "results.json", json.dumps(results, indent=2) + "\n")
    return Evaluation(out, results)


def _score_record(score: AveragePrecision) -> JsonObject:
    return {
        "map50_95": round(score.map50_95, 5) if score.classes else None,
        "map50": round(score.map50, 5) if score.classes else None,
        "classes": {
            name: {"ap50_95": round(mean, 5), "ap50": round(at_half, 5)}
            for name, (mean, at_half) in score.classes.items()
        },
    }
