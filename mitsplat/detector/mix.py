"""Which images a training takes at each of its steps."""

from __future__ import annotations

import zlib

import numpy as np

from mitsplat.arrays import Int64Array
from mitsplat.errors import InputError


def plan_images(rendered: int, real: int, *, share: float, steps: int, batch: int, seed: int) -> Int64Array:
    """Indices of the images of every step, shape (steps, batch): rendered ones from 0, then real ones.

    Real images are spread as evenly as can be: of the first n images taken, floor(n share) are real. Either kind is
    shuffled anew each time that all of it was taken, so that none is taken twice before another one was taken once.

    Args:
        rendered: How many images are rendered.
        real: How many are real; if none, ``share`` has no meaning.
        share: Of real ones among those taken, in (0, 1).
        steps: How many.
        batch: Images of a step.
        seed: Decides the order.

    Raises:
        InputError: If the share is out of range.
    """
    if real and not 0 < share < 1:
        raise InputError(f"the share of real images must lie between 0 and 1 (got {share:g})")
    taken = np.floor(np.arange(steps * batch + 1) * (share if real else 0.0) + 1e-9)
    is_real = np.diff(taken) > 0
    order = np.empty(steps * batch, dtype=np.int64)
    order[~is_real] = _shuffled(rendered, int(np.count_nonzero(~is_real)), seed, "rendered")
    order[is_real] = rendered + _shuffled(real, int(np.count_nonzero(is_real)), seed, "real")
    return order.reshape(steps, batch)


def _shuffled(total: int, count: int, seed: int, purpose: str) -> Int64Array:
    """``count`` indices below ``total``, each as often as any other but for once."""
    rng = np.random.default_rng([seed, zlib.crc32(purpose.encode())])
    rounds = [rng.permutation(total) for _ in range(-(-count // total))] if count else []
    return np.concatenate([np.empty(0, dtype=np.int64), *rounds])[:count]
