"""What datasets are for: detectors of Ultralytics trained on them, alone or mixed with photographs, and judged.

In: datasets of mitsplat, YOLO or COCO folders, and a network's name. Out: the folder of a run with its weights, and
that of an evaluation: average precision by COCO's rules, every detection, and a page. Nothing here needs Mitsuba.
Training and predicting need the extra ``train``; judging detections that are kept needs nothing more.
"""

from __future__ import annotations

from mitsplat.detector.detector_evaluation import Evaluation, evaluate_detector
from mitsplat.detector.likeness import Likeness, compare_with_photographs
from mitsplat.detector.scores import AveragePrecision, DetectionMatches, average_precision
from mitsplat.detector.sets import LabelledSet, read_set
from mitsplat.detector.training import Run, TrainSettings, open_run, train_detector

__all__ = [
    "AveragePrecision",
    "DetectionMatches",
    "Evaluation",
    "LabelledSet",
    "Likeness",
    "Run",
    "TrainSettings",
    "average_precision",
    "compare_with_photographs",
    "evaluate_detector",
    "open_run",
    "read_set",
    "train_detector",
]
