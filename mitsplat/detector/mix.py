"""Image plan of a training: the images of each step."""

from __future__ import annotations

import zlib

import numpy as np

from mitsplat.arrays import Int64Array
from mitsplat.errors import InputError


def plan_images(rendered: int, real: int, *, share: float, steps: int, batch: int, seed: int) -> Int64Array:
    """Return the image indices of all steps, shape (steps, batch): rendered images from 0, then real images.

    Real images are distributed evenly: of the first n images, floor(n * share) are real. Each kind is shuffled again
    after all of its images were used, so no image is used twice before every other one was used once.

    Args:
        rendered: Number of rendered images.
        real: Number of real images; ``share`` is ignored if this is 0.
        share: Share of real images, in (0, 1).
        steps: Number of steps.
        batch: Images per step.
        seed: Seed of the order.

    Raises:
        InputError: If the share is out of range.
    """
    if real and not 0 < share < 1:
        raise InputError(f"the share of real images must lie between 0 and 1 (got {share:g})")
    taken = np.floor(np.arange(steps * batch + 1) * (share if real else 0.0) + 1e-9)
    is_real = np.diff(taken) > 0
    order = np.empty(steps * batch, dtype=np.int64)
    order[~is_real] = _shuffled_indices(rendered, int(np.count_nonzero(~is_real)), seed, "rendered")
    order[is_real] = rendered + _shuffled_indices(real, int(np.count_nonzero(is_real)), seed, "real")
    return order.reshape(steps, batch)


def _shuffled_indices(total: int, count: int, seed: int, purpose: str) -> Int64Array:
    """Return ``count`` indices below ``total``; the counts of any two indices differ by at most one."""
    rng = np.random.default_rng([seed, zlib.crc32(purpose.encode())])
    rounds = [rng.permutation(total) for _ in range(-(-count // total))] if count else []
    return np.concatenate([np.empty(0, dtype=np.int64), *rounds])[:count]
