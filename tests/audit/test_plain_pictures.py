"""Pictures of one colour: a violation only where the masks have outlines, which such a picture cannot show."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from mitsplat.audit.picture_check import check_image

NOTHING, EVERYWHERE = np.zeros((6, 8), np.int64), np.full((6, 8), 3)
OBJECT = np.pad(np.full((2, 2), 3), ((1, 3), (2, 4)))


@pytest.mark.parametrize(
    ("ids", "colour", "fault"),
    [
        (NOTHING, (200, 200, 200), None),
        (NOTHING, (10, 60, 200), None),
        (NOTHING, (0, 0, 0), None),
        (EVERYWHERE, (10, 60, 200), None),
        (OBJECT, (200, 200, 200), "has one colour only"),
        (OBJECT, (10, 60, 200), "has one colour only"),
    ],
)
def test_a_plain_picture_is_a_violation_if_its_masks_have_outlines(
    tmp_path: Path, ids: np.ndarray, colour: tuple[int, ...], fault: str | None
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((6, 8, 3), colour, np.uint8))
    frame = cast(Any, SimpleNamespace(size=(8, 6), ids=ids))
    found = list(check_image(frame, tmp_path / "a.png"))
    assert [message.startswith(str(fault)) for message in found] == [True] * (fault is not None)
