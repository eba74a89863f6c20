"""Plan of the images used at each training step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsplat.detector.mix import plan_images
from mitsplat.errors import InputError


@given(
    rendered=st.integers(1, 40),
    real=st.integers(0, 12),
    share=st.floats(0.01, 0.99),
    steps=st.integers(1, 60),
    batch=st.integers(1, 9),
    seed=st.integers(0, 5),
)
def test_shares_are_even_and_every_image_is_taken_in_turn(
    rendered: int, real: int, share: float, steps: int, batch: int, seed: int
) -> None:
    plan = plan_images(rendered, real, share=share, steps=steps, batch=batch, seed=seed)
    assert plan.shape == (steps, batch) and plan.min() >= 0 and plan.max() < rendered + real
    order = plan.ravel()
    taken = np.cumsum(order >= rendered)
    wanted = np.arange(1, order.size + 1) * (share if real else 0.0)
    assert (np.abs(taken - wanted) < 1 + 1e-6).all() and (taken <= wanted + 1e-6).all()
    for first, count in ((0, rendered), (rendered, real)):
        own = order[(order >= first) & (order < first + count)]
        if own.size:
            often = np.bincount(own - first, minlength=count)
            assert often.max() - often.min() <= 1


def test_the_seed_determines_the_order() -> None:
    plans = [plan_images(30, 5, share=0.1, steps=10, batch=4, seed=seed) for seed in (0, 0, 1)]
    assert np.array_equal(plans[0], plans[1]) and not np.array_equal(plans[0], plans[2])
    assert np.count_nonzero(plans[0] >= 30) == 4


def test_the_number_of_steps_does_not_depend_on_the_number_of_images() -> None:
    assert {plan_images(count, 0, share=0.5, steps=7, batch=3, seed=0).shape for count in (1, 10, 1000)} == {(7, 3)}


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, 1.5])
def test_a_share_that_omits_one_kind_is_refused(share: float) -> None:
    with pytest.raises(InputError, match="must lie between 0 and 1"):
        plan_images(3, 2, share=share, steps=1, batch=1, seed=0)
