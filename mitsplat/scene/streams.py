"""Random numbers by purpose: adding one never shifts another, and any worker may draw any of them in any order."""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt


def random_stream(seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    """Random numbers for one purpose in one frame, layout or attempt, independent of those for every other.

    Args:
        seed: Of the scene.
        purpose: What they decide.
        numbers: Which of several: the index of the frame or layout, and of what is drawn again for it.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(purpose.encode()), *numbers]))


def weighted_choice(rng: np.random.Generator, weights: npt.ArrayLike, count: int = 1) -> list[int]:
    """Positions of ``count`` members of a pool, drawn by weights relative to each other, shape (N,)."""
    shares = np.asarray(weights, dtype=np.float64)
    found: list[int] = rng.choice(len(shares), count, p=shares / shares.sum()).tolist()
    return found
