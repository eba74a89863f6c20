"""Independent random streams, one per purpose.

A new stream does not change the values of other streams. Any worker can use any stream in any order.
"""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt


def random_stream(seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    """Return the random generator for one purpose in one frame, layout or attempt. It is independent of all others.

    Args:
        seed: Seed of the scene, or of one frame's plan.
        purpose: Name of the value that is drawn.
        numbers: Index of the frame or layout, and of the attempt if values are drawn repeatedly.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(purpose.encode()), *numbers]))


def weighted_choice(rng: np.random.Generator, weights: npt.ArrayLike, count: int = 1) -> list[int]:
    """Draw ``count`` indices of members of a pool, with probabilities in proportion to their weights, shape (N,)."""
    shares = np.asarray(weights, dtype=np.float64)
    found: list[int] = rng.choice(len(shares), count, p=shares / shares.sum()).tolist()
    return found
