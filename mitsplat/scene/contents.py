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
from mitsplat.files import SPLITS
from mitsplat.scene.streams import random_stream, weighted_choice
from mitsplat.scene.walls import stated_pose
from mitsplat.spec.spec import SceneSpec

if TYPE_CHECKING:
    from mitsplat.scene.scene import Scene


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


def draw_regions(spec: SceneSpec, layout: int) -> tuple[int, ...]:
    """Which of the regions each object of a layout starts in, drawn by floor area among those of its entry."""
    areas = np.array([np.prod(np.subtract(region.max, region.min)[:2]) for region, _ in spec.all_regions])
    found: list[int] = []
    for position, (entry, count) in enumerate(zip(spec.objects, _counts(spec, layout), strict=True)):
        among = list(spec.regions_of(entry))
        rng = random_stream(spec.seed, f"object region {position}", layout)
        found += [among[i] for i in weighted_choice(rng, areas[among], count)]
    return tuple(found)


def _counts(spec: SceneSpec, layout: int) -> list[int]:
    """How many objects of each entry a layout has."""
    counts = random_stream(spec.seed, "object counts", layout)
    drawn = [(len(entry.poses), int(counts.integers(*entry.count, endpoint=True))) for entry in spec.objects]
    empty, held_out = is_empty(spec, layout), _held_out(spec, layout)
    return [
        0 if (empty and entry.label) or held_out.issuperset(entry.names) else given or count
        for entry, (given, count) in zip(spec.objects, drawn, strict=True)
    ]


def _held_out(spec: SceneSpec, layout: int) -> frozenset[str]:
    """Names of assets that a layout must not have, because they are for the test split alone."""
    if not spec.hold_out.assets or split_of(layout, spec.output.validation, spec.output.test) == "test":
        return frozenset()
    return frozenset(spec.hold_out.assets)


def _draw_entry(scene: Scene, position: int, layout: int, count: int) -> list[int]:
    """Assets of the objects of one entry."""
    spec, entry, pool = scene.spec, scene.spec.objects[position], scene.pools[position]
    if len(pool) == 1:
        return [pool[0]] * count
    if not count:
        return []
    held_out = _held_out(spec, layout)
    allowed = [name not in held_out for name in entry.names]
    weights = np.repeat(np.multiply(entry.weights or np.ones(len(allowed)), allowed), len(entry.scales))
    rng = random_stream(spec.seed, f"object pool {position}", layout)
    if not entry.balance:
        return [pool[i] for i in weighted_choice(rng, weights, count)]
    members = defaultdict[str, list[int]](list)
    for i, asset in enumerate(pool):
        if weights[i]:
            members[scene.assets[asset].class_name].append(i)
    names = sorted(members)
    drawn = []
    for kind in _dealt(spec, position, layout, count, len(names)):
        among = members[names[kind]]
        drawn.append(pool[among[weighted_choice(rng, weights[among])[0]]])
    return drawn


def _dealt(spec: SceneSpec, position: int, layout: int, count: int, kinds: int) -> list[int]:
    """Classes of a layout's objects, from decks of one card for each class that are dealt out to a split's layouts."""
    split = split_of(layout, spec.output.validation, spec.output.test)
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
    totals = dict.fromkeys(SPLITS, 0)
    before = np.zeros(layouts, dtype=np.int64)
    for layout in range(layouts):
        split = split_of(layout, spec.output.validation, spec.output.test)
        before[layout] = totals[split]
        totals[split] += _counts(spec, layout)[position]
    return before
