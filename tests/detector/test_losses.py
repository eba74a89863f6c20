"""Gain in average precision from correcting each kind of error, compared with cases counted by hand."""

from __future__ import annotations

from typing import Any

import pytest

from mitsplat.detector import DetectionMatches
from mitsplat.detector.losses import ERROR_KINDS
from mitsplat.detector.losses import error_gains as gains_over

A, B = [0.0, 0.0, 10.0, 10.0], [50.0, 50.0, 20.0, 20.0]


def truth(*labels: tuple[int, int, list[float]], crowd: int = 0) -> dict[str, Any]:
    """Return labels of (image, class, box) in two images and two classes."""
    return {
        "images": [{"id": image, "width": 100, "height": 100, "file_name": f"{image}.png"} for image in (1, 2)],
        "annotations": [
            {"id": number, "image_id": image, "category_id": kind, "bbox": box, "area": box[2] * box[3],
             "iscrowd": crowd}
            for number, (image, kind, box) in enumerate(labels, 1)
        ],
        "categories": [{"id": 1, "name": "a"}, {"id": 2, "name": "b"}],
    }  # fmt: skip


def found(image: int, kind: int, box: list[float], score: float = 0.9) -> dict[str, Any]:
    return {"image_id": image, "category_id": kind, "bbox": box, "score": score}


def gains(labelled: dict[str, Any], detections: list[dict[str, Any]]) -> dict[str, float]:
    return gains_over(labelled, detections, DetectionMatches(labelled, detections).average_precision())


TWO = truth((1, 1, A), (1, 2, B))


@pytest.mark.parametrize(
    ("detections", "kind", "gain"),
    [
        ([found(1, 1, A), found(1, 1, B)], "another_class", 0.5),
        ([found(1, 1, A), found(1, 2, B), found(2, 2, A, 0.95)], "nothing", 0.25),
        ([found(1, 1, A), found(1, 2, B), found(1, 2, A, 0.5), found(2, 2, B, 0.95)], "nothing", 0.25),
        ([found(1, 1, A), found(1, 2, [50, 50, 20, 12])], "place", 0.35),  # IoU 0.6: correct at 0.5, 0.55 and 0.6
        ([found(1, 1, A), found(1, 2, [50, 50, 20, 8])], "place", 0.5),
    ],
)
def test_a_single_error_has_the_gain_of_its_closed_form(
    detections: list[dict[str, Any]], kind: str, gain: float
) -> None:
    worth = gains(TWO, detections)
    assert worth.keys() == ERROR_KINDS.keys()
    assert worth[kind] == pytest.approx(gain, abs=1e-6)
    assert all(value == pytest.approx(0, abs=1e-6) for other, value in worth.items() if other not in (kind, "missed"))


def test_a_missed_object_counts_as_missed_only() -> None:
    """One of two objects of a class is found. Precision is 1 up to recall 0.5, that is at 51 of 101 recalls."""
    worth = gains(truth((1, 1, A), (2, 1, B)), [found(1, 1, A)])
    assert worth["missed"] == pytest.approx(50 / 101, abs=1e-6)
    assert worth["another_class"] == worth["nothing"] == worth["place"] == 0


def test_perfect_detections_have_no_gain() -> None:
    assert gains(TWO, [found(1, 1, A), found(1, 2, B)]) == dict.fromkeys(ERROR_KINDS, 0.0)


def test_a_second_detection_of_a_label_stays_wrong() -> None:
    """Correcting the class makes one of two detections of a box correct. The second one stays wrong."""
    worth = gains(truth((1, 2, B)), [found(1, 1, B, 0.9), found(1, 1, B, 0.8)])
    assert worth["another_class"] == pytest.approx(1.0)


def test_a_crowd_is_not_a_missed_label() -> None:
    worth = gains(truth((1, 1, A), crowd=1), [found(1, 1, A)])
    assert worth == {}


def test_no_labels_give_no_gains_and_no_detections_are_missed() -> None:
    assert gains(truth(), [found(1, 1, A)]) == {}
    assert gains(TWO, [])["missed"] == pytest.approx(1.0)
