"""Training and evaluation of Ultralytics detectors.

Input: mitsplat datasets, YOLO folders or COCO folders, and the name of a network. Photographs can be mixed in.
Output: a run folder with the weights, and an evaluation folder with the average precision by COCO's rules, all
detections and an HTML page.
The package does not need Mitsuba. Training and prediction need the extra ``train``; the evaluation of stored detections
needs no extra.
"""

from __future__ import annotations

from mitsplat.detector.detector_evaluation import Evaluation, evaluate_detector
from mitsplat.detector.labelled_sets.labelled_set import LabelledSet
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.likeness import Likeness, compare_with_photographs
from mitsplat.detector.scores import AveragePrecision, DetectionMatches
from mitsplat.detector.train_settings import TrainSettings
from mitsplat.detector.training import Run, open_run, train_detector

__all__ = [
    "AveragePrecision",
    "DetectionMatches",
    "Evaluation",
    "LabelledSet",
    "Likeness",
    "Run",
    "TrainSettings",
    "compare_with_photographs",
    "evaluate_detector",
    "open_run",
    "read_set",
    "train_detector",
]
