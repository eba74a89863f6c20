"""Split, emptiness and environment of a layout, decided by the seed and the index of the layout."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.streams import random_stream, weighted_choice

if TYPE_CHECKING:
    pass


Split = Literal["train", "val", "test"]


def split_of(layout: int, validation: float, test: float = 0.0) -> Split:
    """Split of a layout, the same however many follow it: the second layout is the first of the smaller split.

    Of n layouts, floor(1 + (n - 2) share) belong to the smaller of two splits. With a test split, the layouts are first
    parted into that and the others, and these likewise into training and validation.
    """
    return _place_in_split(layout, validation, test)[0]


def _place_in_split(layout: int, validation: float, test: float) -> tuple[Split, int]:
    """Split of a layout, and how many earlier ones are in it."""
    if test:
        apart, layout = _parted(layout, test)
        if apart:
            return "test", layout
        validation = min(1.0, validation / (1.0 - test))
    apart, rank = _parted(layout, validation)
    return "val" if apart else "train", rank


def _parted(number: int, share: float) -> tuple[bool, int]:
    """Whether a number from 0 is among the share that is taken of all, and how many smaller ones are on its side."""

    def taken(count: int) -> int:
        """How many of the first numbers are on the smaller side, but for a constant."""
        return math.floor(1.0 + (count - 2) * min(share, 1.0 - share))

    smaller, before = taken(number + 1) > taken(number), taken(number) - taken(0)
    return smaller == (share <= 0.5), before if smaller else number - before


def is_empty(spec: SceneSpec, layout: int) -> bool:
    """Whether nothing that is labelled lies in a layout: evenly spread over the layouts of each split."""
    if not spec.empty:
        return False
    split, rank = _place_in_split(layout, spec.output.validation, spec.output.test)
    phase = _phase(spec.seed, split)
    return math.floor((rank + 1) * spec.empty + phase) > math.floor(rank * spec.empty + phase)


def draw_environment(spec: SceneSpec, layout: int) -> int:
    """Which of the environments a layout has."""
    if not isinstance(spec.environment, tuple) or len(spec.environment) == 1:
        return 0
    weights = np.array(spec.environment_weights or np.ones(len(spec.environment)))
    if spec.hold_out.environments and split_of(layout, spec.output.validation, spec.output.test) != "test":
        weights = weights * [name not in spec.hold_out.environments for name in spec.environment]
    return weighted_choice(random_stream(spec.seed, "environment", layout), weights)[0]


@lru_cache
def _phase(seed: int, split: str) -> float:
    """Where in its turn a split begins with empty layouts, in [0, 1)."""
    return float(random_stream(seed, f"empty layouts {split}").uniform())
