"""Average precision compared with cases counted by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mitsplat.detector.scores import DetectionMatches, confuse, match_boxes
from mitsplat.errors import InputError


def truth(boxes: dict[int, list[tuple[int, list[float]]]]) -> dict[str, Any]:
    """Return labels from boxes by image, each with its class. Masks equal the boxes."""
    annotations = []
    for image, shown in boxes.items():
        for kind, (x, y, w, h) in shown:
            corners = [x, y, x + w, y, x + w, y + h, x, y + h]
            annotations.append(
                {"id": len(annotations) + 1, "image_id": image, "category_id": kind, "bbox": [x, y, w, h],
                 "area": w * h, "iscrowd": 0, "segmentation": [corners]}
            )  # fmt: skip
    images = [{"id": image, "width": 100, "height": 100, "file_name": f"{image}.png"} for image in boxes]
    return {
        "images": images,
        "annotations": annotations,
        "categories": [{"id": 1, "name": "a"}, {"id": 2, "name": "b"}],
    }


def found(image: int, kind: int, box: list[float], score: float) -> dict[str, Any]:
    return {"image_id": image, "category_id": kind, "bbox": box, "score": score}


TRUE = truth({1: [(1, [0, 0, 10, 10]), (1, [50, 50, 20, 20])], 2: [(1, [0, 0, 10, 10])], 3: [(2, [10, 10, 30, 30])]})


def test_average_precision_equals_a_case_computed_by_hand() -> None:
    """The average precision of two classes equals values computed by hand.

    Class a has 3 labels. Its detections by score are right, wrong, right: precisions 1, 1/2, 2/3 at recalls 1/3, 1/3,
    2/3.
    Of the 101 recalls, 0 to 0.33 (34) have precision 1, 0.34 to 0.66 (33) have 2/3, and the rest have 0.

    Class b has one box with an IoU of 16/30. It counts at the threshold 0.5 alone.
    """
    detections = [
        found(1, 1, [0, 0, 10, 10], 0.9),
        found(2, 1, [40, 40, 10, 10], 0.8),
        found(2, 1, [0, 0, 10, 10], 0.7),
        found(3, 2, [10, 10, 30, 16], 0.5),
    ]
    score = DetectionMatches(TRUE, detections).average_precision()
    a = (34 + 33 * 2 / 3) / 101
    assert score.classes["a"] == pytest.approx((a, a), abs=1e-9)
    assert score.classes["b"] == pytest.approx((0.1, 1.0), abs=1e-9)
    assert score.map50 == pytest.approx((a + 1) / 2, abs=1e-9)
    assert score.map50_95 == pytest.approx((a + 0.1) / 2, abs=1e-9)
    assert score.curves["a"][[0, 33, 34, 66, 67]] == pytest.approx([1, 1, 2 / 3, 2 / 3, 0], abs=1e-9)
    assert score.curves["b"] == pytest.approx(np.ones(101), abs=1e-9)


def test_perfect_detections_score_one_and_none_score_zero() -> None:
    perfect = [
        found(a["image_id"], a["category_id"], a["bbox"], 0.5) | {"segmentation": a["segmentation"]}
        for a in TRUE["annotations"]
    ]
    for kind in ("bbox", "segm"):
        score = DetectionMatches(TRUE, perfect, kind).average_precision()  # type: ignore[arg-type]
        assert (score.map50_95, score.map50) == (1.0, 1.0)
    assert DetectionMatches(TRUE, []).average_precision().map50_95 == 0.0


def test_a_subset_of_images_is_scored_independently() -> None:
    rng = np.random.default_rng(0)
    images = {i: [(int(rng.integers(1, 3)), [*rng.integers(0, 60, 2).tolist(), 20, 20])] for i in range(1, 9)}
    labelled = truth(images)
    detections = [
        found(i, kind, [x + float(rng.normal(0, 3)), y, w, h], float(rng.random()))
        for i, [(kind, (x, y, w, h))] in images.items()
        for _ in range(2)
    ]
    matches = DetectionMatches(labelled, detections)
    for chosen in ([1, 2, 3], [8, 4], [5]):
        alone = truth({i: images[i] for i in chosen})
        expected = DetectionMatches(alone, [d for d in detections if d["image_id"] in chosen]).average_precision()
        assert matches.average_precision(chosen).classes == expected.classes
        assert DetectionMatches(labelled, detections).average_precision(chosen).map50_95 == expected.map50_95
    assert matches.average_precision().classes == DetectionMatches(labelled, detections).average_precision().classes
    # An image that is drawn twice counts as two images with the same content.
    twice = truth({1: images[1], 2: images[2], 3: images[1]})
    drawn = [d | {"image_id": n} for n, i in ((1, 1), (2, 2), (3, 1)) for d in detections if d["image_id"] == i]
    assert matches.average_precision([1, 2, 1]).classes == DetectionMatches(twice, drawn).average_precision().classes
    # Earlier calls do not change the result.
    assert (
        matches.average_precision([1, 2, 3]).classes
        == DetectionMatches(labelled, detections).average_precision([1, 2, 3]).classes
    )


def test_classes_without_a_label_do_not_count() -> None:
    score = DetectionMatches(TRUE, [found(3, 2, [10, 10, 30, 30], 0.9)]).average_precision([3])
    assert list(score.classes) == ["b"]
    assert (*score.classes["b"], score.map50_95) == pytest.approx((1, 1, 1))


def test_detections_of_unlabelled_images_and_classes_are_refused() -> None:
    with pytest.raises(InputError, match="got image 9, class 1"):
        DetectionMatches(TRUE, [found(9, 1, [0, 0, 5, 5], 0.5)]).average_precision()
    for images in ([], [7]):
        with pytest.raises(InputError, match="images must be a non-empty list of labelled images"):
            DetectionMatches(TRUE, []).average_precision(images)


def test_the_confusion_matrix_counts_each_kind_of_error() -> None:
    detections = [
        found(1, 1, [0, 0, 10, 10], 0.9),  # correct
        found(1, 2, [51, 50, 20, 20], 0.6),  # another class
        found(2, 1, [0, 0, 10, 10], 0.2),  # score too low: missed
        found(3, 2, [10, 10, 30, 30], 0.8),  # correct
        found(3, 1, [10, 10, 30, 29], 0.7),  # label already matched: background
    ]
    confusion = confuse(TRUE, detections)
    assert confusion.matrix.tolist() == [[1, 1, 1], [0, 1, 0], [1, 0, 0]]
    assert confusion.errors == {1: (1, 0, 1, 0), 2: (0, 1, 0, 0), 3: (1, 0, 0, 1)}


def test_a_label_is_matched_once() -> None:
    labelled = [[0.0, 0.0, 10.0, 10.0], [4.0, 0.0, 10.0, 10.0]]
    assert match_boxes([[0, 0, 10, 10], [1, 0, 10, 10]], labelled) == {0: 0, 1: 1}
    assert match_boxes([[0, 0, 10, 10], [0, 0, 10, 10]], labelled) == {0: 0}
    assert match_boxes([], labelled) == match_boxes(labelled, []) == {}
