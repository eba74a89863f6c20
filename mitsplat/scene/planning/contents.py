"""Contents of a layout: the drawn objects, the regions in which they start, and their arrangements.

The seed and the index of the layout determine the contents. Any worker can therefore draw any layout in any order.
"""

from __future__ import annotations

from collections import defaultdict
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.splits import is_empty, split_of
from mitsplat.scene.streams import random_stream, weighted_choice
from mitsplat.scene.walls import pose_matrix
from mitsplat.storage.files import SPLITS

if TYPE_CHECKING:
    from mitsplat.scene.scene import Scene


def draw_objects(scene: Scene, layout: int) -> tuple[tuple[int, ...], tuple[Float64Array | None, ...]]:
    """Return the index of the asset of each object of a layout, and its pose (4, 4) in the scene file, or None."""
    assets: list[int] = []
    given: list[Float64Array | None] = []
    for position, (entry, count) in enumerate(zip(scene.spec.objects, _counts(scene.spec, layout), strict=True)):
        poses: list[Float64Array | None] = [pose_matrix(pose) for pose in entry.poses]
        drawn = _draw_entry(scene, position, layout, count)
        assets += drawn
        given += (poses or [None] * count)[: len(drawn)]
    return tuple(assets), tuple(given)


def draw_regions(spec: SceneSpec, layout: int) -> tuple[int, ...]:
    """Return the index of the start region of each object, drawn by floor area among the regions of its entry."""
    areas = np.array([np.prod(np.subtract(region.max, region.min)[:2]) for region, _ in spec.all_regions])
    found: list[int] = []
    for position, (entry, count) in enumerate(zip(spec.objects, _counts(spec, layout), strict=True)):
        candidates = list(spec.regions_of(entry))
        rng = random_stream(spec.seed, f"object region {position}", layout)
        found += [candidates[i] for i in weighted_choice(rng, areas[candidates], count)]
    return tuple(found)


def draw_arrangements(spec: SceneSpec, layout: int) -> tuple[Arrangement, ...]:
    """Return the arrangement of each region in a layout.

    The arrangements of a region are dealt in rounds. Each round is a random permutation of its list.
    """
    drawn = []
    for number, (_, arrangements) in enumerate(spec.all_regions):
        turn, place = divmod(layout, len(arrangements))
        order = random_stream(spec.seed, f"arrangement of region {number}", turn).permutation(len(arrangements))
        drawn.append(arrangements[order[place]])
    return tuple(drawn)


def _counts(spec: SceneSpec, layout: int) -> list[int]:
    """Return the number of objects of each entry in a layout."""
    counts = random_stream(spec.seed, "object counts", layout)
    drawn = [(len(entry.poses), int(counts.integers(*entry.count, endpoint=True))) for entry in spec.objects]
    empty, held_out = is_empty(spec, layout), _held_out(spec, layout)
    return [
        0 if (empty and entry.label) or held_out.issuperset(entry.names) else given or count
        for entry, (given, count) in zip(spec.objects, drawn, strict=True)
    ]


def _held_out(spec: SceneSpec, layout: int) -> frozenset[str]:
    """Return the names of the assets that a layout must not contain because only the test split may."""
    if not spec.hold_out.assets or split_of(layout, spec.output) == "test":
        return frozenset()
    return frozenset(spec.hold_out.assets)


def _draw_entry(scene: Scene, position: int, layout: int, count: int) -> list[int]:
    """Return the asset indices of the objects of one entry."""
    spec, entry, pool = scene.spec, scene.spec.objects[position], scene.pools[position]
    if len(pool) == 1:
        return [pool[0]] * count
    if not count:
        return []
    held_out = _held_out(spec, layout)
    allowed = [name not in held_out for name in entry.names]
    weights = np.repeat(np.asarray(allowed, dtype=np.float64), len(entry.scales))
    rng = random_stream(spec.seed, f"object pool {position}", layout)
    if not entry.balance:
        return [pool[i] for i in weighted_choice(rng, weights, count)]
    members = defaultdict[str, list[int]](list)
    for i, asset in enumerate(pool):
        if weights[i]:
            members[scene.assets[asset].class_name].append(i)
    names = sorted(members)
    drawn = []
    for class_number in _balanced_classes(spec, position, layout, count, len(names)):
        candidates = members[names[class_number]]
        drawn.append(pool[candidates[weighted_choice(rng, weights[candidates])[0]]])
    return drawn


def _balanced_classes(spec: SceneSpec, position: int, layout: int, count: int, num_classes: int) -> list[int]:
    """Return the class of each object of a balanced entry in a layout.

    The classes of a split form a sequence of random permutations. The layouts of the split take consecutive parts of
    it.
    """
    split = split_of(layout, spec.output)
    num_layouts = max(layout + 1, min(1 << layout.bit_length(), spec.output.layouts))
    first = int(_objects_before(spec, position, num_layouts)[layout])
    permutations = {
        turn: random_stream(spec.seed, f"deck {position} {split}", turn).permutation(num_classes)
        for turn in range(first // num_classes, (first + count) // num_classes + 1)
    }
    return [int(permutations[rank // num_classes][rank % num_classes]) for rank in range(first, first + count)]


@lru_cache(maxsize=8)
def _objects_before(spec: SceneSpec, position: int, layouts: int) -> Int64Array:
    """Return, for each of the first layouts, the number of objects of an entry in the earlier layouts of its split."""
    totals = dict.fromkeys(SPLITS, 0)
    before = np.zeros(layouts, dtype=np.int64)
    for layout in range(layouts):
        split = split_of(layout, spec.output)
        before[layout] = totals[split]
        totals[split] += _counts(spec, layout)[position]
    return before
