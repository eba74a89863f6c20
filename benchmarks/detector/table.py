"""Results of the arms of the detector experiment, as a table of the documentation."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.detector.experiment import read_arms

REFERENCE = "synthetic"
"""Arm that others are compared with."""
REDRAWS = 50
"""Draws of seeds for each draw of scenes."""


def experiment_table(results: Mapping[str, Mapping[str, Any]], plan: str = "arms", *arms: str) -> str:
    """Return the precision of all recorded arms of a plan, or of some arms in their order, with 95 % intervals.

    Intervals are percentiles of a bootstrap over scenes of photographs, with equal draws in every arm, and over seeds,
    with separate draws for each arm. An arm of one seed has only the variation of scenes. The plan names the arm that
    each arm is compared with.
    """
    seeds, draws = _by_arm(results, plan, *arms), precision_draws(results, plan)
    entries = read_arms(Path(f"{plan}.yaml"))["arms"]
    lines = [
        "| learnt from | seeds | mAP50-95 | 95 % | mAP50 | compared with | less by, 95 % |",
        "| --- | ---: | ---: | --- | ---: | --- | --- |",
    ]
    for arm in arms or seeds:
        strict, loose = (_mean(seeds[arm], key) for key in ("map50_95", "map50"))
        reference, compared = entries[arm].get("beside", REFERENCE), "– | –"
        others = entries[arm].get("other_scenes", False)
        known = reference in seeds and (others or _of_same_scenes(seeds[arm], seeds[reference]))
        if arm != reference and known:
            compared = f"`{reference}` | {_interval(draws[reference] - draws[arm])}"
        count = len(seeds[arm])
        lines.append(f"| `{arm}` | {count} | {strict:.3f} | {_interval(draws[arm])} | {loose:.3f} | {compared} |")
    return "\n".join(lines)


def precision_draws(results: Mapping[str, Mapping[str, Any]], plan: str = "arms", *arms: str) -> dict[str, np.ndarray]:
    """Return the precision of all or some arms over draws of seeds and of scenes: shape (REDRAWS, draws).

    Each arm draws its own seeds, so that its values do not depend on other recorded arms.
    """
    return {
        arm: _redrawn(np.array([one["samples"][0] for one in found]), np.random.default_rng(list(arm.encode())))
        for arm, found in _by_arm(results, plan, *arms).items()
        if not arms or arm in arms
    }


def mean_precision(results: Mapping[str, Mapping[str, Any]], plan: str, arm: str, figure: str = "map50_95") -> float:
    """Return the mean of a figure over the seeds of an arm.

    Raises:
        KeyError: If there is none.
    """
    return _mean(_by_arm(results, plan, arm)[arm], figure)


def precision_interval(results: Mapping[str, Mapping[str, Any]], plan: str, arm: str) -> str:
    """Return the 95 % interval of the mean precision of an arm.

    Raises:
        KeyError: If it has no result.
    """
    return _interval(precision_draws(results, plan, arm)[arm])


def gain_cells(results: Mapping[str, Mapping[str, Any]], plan: str, arm: str, baseline: str) -> str:
    """Return the gain of an arm over a baseline and its 95 % interval, as two cells of a table.

    Raises:
        KeyError: If one of them has no result.
    """
    gain = mean_precision(results, plan, arm) - mean_precision(results, plan, baseline)
    draws = precision_draws(results, plan, arm, baseline)
    low, high = np.percentile(draws[arm] - draws[baseline], [2.5, 97.5])
    return f"{gain:+.3f} | {low:+.3f} to {high:+.3f}".replace("-", "−")


def _mean(seeds: Sequence[Mapping[str, Any]], key: str) -> float:
    return float(np.mean([one[key][0] for one in seeds]))


def _by_arm(results: Mapping[str, Mapping[str, Any]], plan: str, *wanted: str) -> dict[str, list[Mapping[str, Any]]]:
    """Return the figures of every seed of the arms of a plan; the given arms must be among them."""
    seeds: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for name in sorted(results):
        if found := re.fullmatch(rf"detector\.experiment-(\w+)-\d+{'' if plan == 'arms' else f'-plan_{plan}'}", name):
            seeds[found[1]].append(results[name]["figures"])
    if missing := [arm for arm in wanted if arm not in seeds]:
        raise KeyError(f"no result of {missing[0]} in {plan}.yaml")
    return dict(seeds)


def _of_same_scenes(*arms: Sequence[Mapping[str, Any]]) -> bool:
    """Return True if arms were trained on scenes of one description, or on none."""
    stated = {tuple(one.get("scenes", [None])) for arm in arms for one in arm}
    return len(stated - {("", "")}) <= 1


def _redrawn(samples: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return means over seeds drawn with replacement, of samples (seeds, draws of scenes): shape (REDRAWS, draws)."""
    drawn = rng.integers(len(samples), size=(REDRAWS, len(samples)))
    means: np.ndarray = samples[drawn].mean(axis=1)
    return means


def _interval(values: np.ndarray) -> str:
    low, high = np.percentile(values, [2.5, 97.5])
    return f"{low:.3f} to {high:.3f}".replace("-", "−")
