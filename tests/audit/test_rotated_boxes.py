"""Rotated boxes of bars that cross the image, which the audit recomputes from the pixels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from mitsplat.audit.decoded_frame import bounds_of
from mitsplat.audit.yolo_check import _check_rotated
from mitsplat.formats.yolo import rotated_box

SIZE = np.array([64, 48])


def bar(angle: float, thickness: int, length: float) -> tuple[Any, Any]:
    """Draw a bar through the middle of the image; return a frame and a label with its mask."""
    canvas = np.zeros(SIZE[::-1], dtype=np.uint8)
    along = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(map(int, np.rint(SIZE / 2 + sign * along))) for sign in (-1, 1)]
    cv2.line(canvas, ends[0], ends[1], 1, thickness)
    box = bounds_of(canvas > 0)
    label = SimpleNamespace(box=box, mask=canvas[box[1] : box[3], box[0] : box[2]] > 0)
    return SimpleNamespace(size=tuple(SIZE.tolist())), label


def texts(frame: Any, label: Any, corners: np.ndarray) -> list[str]:
    return list(_check_rotated(frame, label, (corners / SIZE).ravel().tolist()))


SIZES = ((5, 90), (30, 90), (44, 80))
"""Thicknesses and lengths of bars [px]."""
BARS = [(angle, *size) for angle in np.linspace(0.05, 3.1, 12) for size in SIZES]


def test_rotated_boxes_fit_into_the_image_and_pass_the_audit() -> None:
    """Ultralytics drops images with larger rectangles. Thin bars are shortened, thick ones get their upright box."""
    shortened = upright = 0
    for angle, thickness, length in BARS:
        frame, label = bar(angle, thickness, length)
        corners = rotated_box(label, SIZE.astype(float))
        extents = np.ptp(corners, axis=0)
        assert (extents <= SIZE + 1e-6).all(), (angle, thickness)
        assert texts(frame, label, corners) == [], (angle, thickness)
        is_upright = np.allclose([*corners.min(axis=0), *corners.max(axis=0)], label.box, atol=1e-6)
        upright += is_upright
        shortened += bool(np.isclose(extents, SIZE).any()) and not is_upright
    assert shortened > 8 and upright > 2


@pytest.mark.parametrize("fault", ["shifted", "shorter", "narrower"])
def test_wrongly_shortened_rectangles_are_violations(fault: str) -> None:
    """The thin bar is longer than the image allows, so both ends of its rectangle are cut by the same length."""
    frame, label = bar(0.6, 5, 90)
    corners = rotated_box(label, SIZE.astype(float))
    middle = corners.mean(axis=0)
    sides = np.diff(corners[:3], axis=0)
    across, along = (side / np.linalg.norm(side) for side in sides[np.argsort(np.linalg.norm(sides, axis=1))])
    u, v = (corners - middle) @ along, (corners - middle) @ across
    if fault == "shifted":
        u += 1
    elif fault == "narrower":
        v *= 0.8
    else:
        u *= 0.95
    assert texts(frame, label, corners) == []
    assert texts(frame, label, middle + np.outer(u, along) + np.outer(v, across))
