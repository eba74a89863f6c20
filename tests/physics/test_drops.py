"""Shares of resting poses of dropped parts, with bounds that a correct share violates with a probability of 1 %."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, chisquare

from benchmarks.physics.drops import BATCH, Batch, drop_batch, make_part, solid_angles


def upward(part: str, drops: int, *, restitution: float = 0.5, stepper: str = "mujoco"):
    """Drop a part and return the upward components of its axes, shape (N, 3)."""
    batches = [Batch(part, stepper, restitution, number) for number in range(drops // BATCH)]
    return np.concatenate([drop_batch(batch)[1] for batch in batches])


@pytest.mark.parametrize("part", ["brass_fitting", "hex_bolt", "l_bracket", "proximity_sensor", "relay_box"])
def test_the_mesh_of_a_part_at_rest_touches_the_table(part):
    """The convex pieces of these parts differ from their meshes by up to a millimetre, but not in their hull."""
    heights = drop_batch(Batch(part, "mujoco", 0.5, 0))[2]
    assert len(heights) == BATCH
    assert np.abs(heights).max() < 1e-4


def on_edge(part: str, drops: int, **options):
    return int((np.abs(upward(part, drops, **options) @ make_part(part).axis) < 0.3).sum())


def test_coins_that_rebound_rest_on_edge_more_rarely_than_the_formula_without_rebounds():
    """For coins that do not rebound it is h / sqrt(h^2 + d^2), which is an upper bound here; h/d is 0.35.

    The formula is that of Yong and Mahadevan (2011), "Probability, geometry, and dynamics in the toss of a thick coin".
    """
    assert on_edge("coin 0.35", 60) <= binom.ppf(0.01, 60, 0.35 / np.hypot(0.35, 1))


@pytest.mark.parametrize("ratio", [0.35, 1.0])
def test_solid_angles_of_a_coin_equal_the_formula_without_rebounds(ratio):
    flat, edge = solid_angles(make_part(f"coin {ratio:g}"))
    assert edge == pytest.approx(ratio / np.hypot(ratio, 1), abs=1e-3)
    assert flat == pytest.approx(1 - edge, abs=1e-9)


@pytest.mark.extended
@pytest.mark.parametrize(("part", "share"), [("washer", 0.005), ("bearing_6204", 0.05), ("bearing_6206", 0.05)])
def test_few_round_parts_rest_on_edge(part, share):
    assert on_edge(part, 400) <= binom.ppf(0.99, 400, share)


@pytest.mark.extended
@pytest.mark.parametrize("stepper", ["mujoco", "warp"])
def test_cubes_rest_on_each_face_equally_often(stepper):
    up = upward("cube", 200, stepper=stepper)
    faces = np.argmax(np.concatenate([up, -up], axis=1), axis=1)
    assert np.abs(up).max(axis=1).min() > 0.999
    assert chisquare(np.bincount(faces, minlength=6)).pvalue > 0.01
