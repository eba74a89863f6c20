"""What a layout holds, before anything says where it lies: its split, whether it is empty, and which objects are drawn.

The seed and the layout's index decide it: any worker may ask for any layout in any order.
"""

from __future__ import annotations

import math
from collections import defaultdict
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.scene.spec import SceneSpec
from mitsplat.scene.streams import random_stream
from mitsplat.scene.walls import stated_pose

if TYPE_CHECKING:
    from mitsplat.scene.scene import Scene


def split_of(layout: int, validation: float) -> Literal["train", "val"]:
    """Split of a layout, the same however many follow it: the second layout is the first of the smaller split.

    Among the first n layouts, floor(1 + (n - 2) share) belong to the smaller split.
    """
    after, before = _in_smaller_split(layout + 1, validation), _in_smaller_split(layout, validation)
    return "val" if (after > before) == (validation <= 0.5) else "train"


def _in_smaller_split(layouts: int, validation: float) -> int:
    """How many of the first layouts are in the smaller split, but for a constant."""
    return math.floor(1.0 + (layouts - 2) * min(validation, 1.0 - validation))


def is_empty(spec: SceneSpec, layout: int) -> bool:
    """Whether nothing that is labelled lies in a layout: evenly spread over the layouts of each split."""
    if not spec.empty:
        return False
    split = split_of(layout, spec.output.validation)
    smaller = _in_smaller_split(layout, spec.output.validation) - _in_smaller_split(0, spec.output.validation)
    rank = smaller if (split == "val") == (spec.output.validation <= 0.5) else layout - smaller
    phase = _phase(spec.seed, split)
    return math.floor((rank + 1) * spec.empty + phase) > math.floor(rank * spec.empty + phase)


@lru_cache
def _phase(seed: int, split: str) -> float:
    """Where in its turn a split begins with empty layouts, in [0, 1)."""
    return float(random_stream(seed, f"empty layouts {split}").uniform())


def draw_objects(scene: Scene, layout: int) -> tuple[tuple[int, ...], tuple[Float64Array | None, ...]]:
    """Which of the scene's assets each object of a layout is of, and the pose that the file gives it, if any."""
    assets: list[int] = []
    given: list[Float64Array | None] = []
    for position, (entry, count) in enumerate(zip(scene.spec.objects, _counts(scene.spec, layout), strict=True)):
        poses: list[Float64Array | None] = [stated_pose(pose) for pose in entry.poses]
        drawn = _draw_entry(scene, position, layout, count)
        assets += drawn
        given += (poses or [None] * count)[: len(drawn)]
    return tuple(assets), tuple(given)


def _counts(spec: SceneSpec, layout: int) -> list[int]:
    """How many objects of each entry a layout has."""
    counts = random_stream(spec.seed, "object counts", layout)
    drawn = [(len(entry.poses), int(counts.integers(*entry.count, endpoint=True))) for entry in spec.objects]
    empty = is_empty(spec, layout)
    return [
        0 if empty and entry.label else given or count
        for entry, (given, count) in zip(spec.objects, drawn, strict=True)
    ]


def _draw_entry(scene: Scene, position: int, layout: int, count: int) -> list[int]:
    """Assets of the objects of one entry."""
    spec, entry, pool = scene.spec, scene.spec.objects[position], scene.pools[position]
    if len(pool) == 1:
        return [pool[0]] * count
    weights = np.repeat(entry.weights or np.ones(len(pool) // len(entry.scales)), len(entry.scales))
    rng = random_stream(spec.seed, f"object pool {position}", layout)
    if not entry.balance:
        return [pool[i] for i in rng.choice(len(pool), count, p=weights / weights.sum())]
    members = defaultdict[str, list[int]](list)
    for i, asset in enumerate(pool):
        members[scene.assets[asset].class_name].append(i)
    names = sorted(members)
    drawn = []
    for kind in _dealt(spec, position, layout, count, len(names)):
        among = members[names[kind]]
        shares = weights[among] / weights[among].sum()
        drawn.append(pool[among[int(rng.choice(len(among), p=shares))]])
    return drawn


def _dealt(spec: SceneSpec, position: int, layout: int, count: int, kinds: int) -> list[int]:
    """Classes of a layout's objects, from decks of one card for each class that are dealt out to a split's layouts."""
    split = split_of(layout, spec.output.validation)
    known = max(layout + 1, min(1 << layout.bit_length(), spec.output.layouts))
    first = int(_dealt_before(spec, position, known)[layout])
    decks = {
        deck: random_stream(spec.seed, f"deck {position} {split}", deck).permutation(kinds)
        for deck in range(first // kinds, (first + count) // kinds + 1)
    }
    return [int(decks[card // kinds][card % kinds]) for card in range(first, first + count)]


@lru_cache(maxsize=8)
def _dealt_before(spec: SceneSpec, position: int, layouts: int) -> Int64Array:
    """How many objects of an entry the earlier layouts of its split have, for each of the first layouts."""
    totals = {"train": 0, "val": 0}
    before = np.zeros(layouts, dtype=np.int64)
    for layout in range(layouts):
        split = split_of(layout, spec.output.validation)
        before[layout] = totals[split]
        totals[split] += _counts(spec, layout)[position]
    return before
