"""Split, emptiness and environment of a layout, determined by the seed and the index of the layout."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

import numpy as np

from mitsplat.scene.spec.scene_spec import Output, SceneSpec
from mitsplat.scene.streams import random_stream, weighted_choice

Split = Literal["train", "val", "test"]


def split_of(layout: int, output: Output) -> Split:
    """Return the split of a layout by ``output.validation`` and ``output.test``, but not by the number of layouts.

    The second layout is the first of the smaller split. Of n layouts, floor(1 + (n - 2) share) belong to the smaller of
    two splits. With a test split, layouts are first divided into test and others; then the others are divided into
    training and validation by the same rule.
    """
    return _place_in_split(layout, output)[0]


def _place_in_split(layout: int, output: Output) -> tuple[Split, int]:
    """Return the split of a layout, and the number of earlier layouts in it."""
    validation, test = output.validation, output.test
    if test:
        in_part, layout = _divide(layout, test)
        if in_part:
            return "test", layout
        validation = min(1.0, validation / (1.0 - test))
    in_part, rank = _divide(layout, validation)
    return "val" if in_part else "train", rank


def _divide(number: int, share: float) -> tuple[bool, int]:
    """Divide numbers from 0 by a share.

    Returns:
        True if the number is in the part of that share, and how many smaller numbers are in the same part.
    """

    def taken(count: int) -> int:
        """Return how many of the first numbers are in the smaller part, up to a constant."""
        return math.floor(1.0 + (count - 2) * min(share, 1.0 - share))

    smaller, before = taken(number + 1) > taken(number), taken(number) - taken(0)
    return smaller == (share <= 0.5), before if smaller else number - before


def is_empty(spec: SceneSpec, layout: int) -> bool:
    """Return True if a layout has no labelled objects. Such layouts are evenly spread over each split."""
    split, rank = _place_in_split(layout, spec.output)
    phase = _phase(spec.seed, split)
    return math.floor((rank + 1) * spec.empty + phase) > math.floor(rank * spec.empty + phase)


def draw_environment(spec: SceneSpec, layout: int) -> int:
    """Draw the index of the environment of a layout."""
    if not isinstance(spec.environment, tuple) or len(spec.environment) == 1:
        return 0
    weights = np.ones(len(spec.environment))
    if spec.hold_out.environments and split_of(layout, spec.output) != "test":
        weights = weights * [name not in spec.hold_out.environments for name in spec.environment]
    return weighted_choice(random_stream(spec.seed, "environment", layout), weights)[0]


@lru_cache
def _phase(seed: int, split: str) -> float:
    """Return the phase of the empty layouts of a split, in [0, 1)."""
    return float(random_stream(seed, f"empty layouts {split}").uniform())
