"""Removal of Gaussians that are no part of an imported object or place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mitsplat.arrays import BoolArray
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.reconstruct.segment_splats import find_floaters, long_needles, visible_area

_MIN_OPACITY = 1 / 255
"""Opacity below which a Gaussian is invisible in every picture."""
_MAX_SCALE = 0.2
"""Standard deviation above which a Gaussian of an object counts as haze, as a fraction of the longest extent."""
OUTLIERS = 0.005
"""Fraction of the Gaussians at either end of an axis that is ignored for the size of an object."""


class Cleaner:
    """Remaining Gaussians of a file, and the reasons for the removal of the others."""

    def __init__(self, path: Path, splats: Splats) -> None:
        self._path, self._all, self._remaining = path, splats, np.ones(len(splats), dtype=bool)
        self.removed: dict[str, int] = {}

    def crop(self, box: Sequence[float]) -> None:
        """Remove what lies outside of a box: lower corner, upper corner."""
        low, high = np.reshape(box, (2, 3))
        outside = np.asarray(((self._all.means < low) | (self._all.means > high)).any(axis=1))
        span = ", ".join(f"{axis} {a:.3g} to {b:.3g}" for axis, a, b in zip("xyz", *self._all.bounds, strict=True))
        self.remove("outside of the box", outside, f"crop keeps nothing: the file has {span}")

    @property
    def splats(self) -> Splats:
        """Remaining Gaussians."""
        return self._all.select(self._remaining)

    def removed_splats(self) -> Splats:
        """Return the removed Gaussians."""
        return self._all.select(~self._remaining)

    def remove(self, reason: str, which: BoolArray, otherwise: str) -> None:
        """Remove remaining Gaussians by a mask (N,), and raise the error ``otherwise`` if none would remain."""
        self.removed[reason] = self.removed.get(reason, 0) + int(which.sum())
        self._remaining[np.flatnonzero(self._remaining)[which]] = False
        if not self._remaining.any():
            raise InputError(f"{self._path}: {otherwise}")

    def remove_floaters(self, kind: str) -> None:
        """Remove Gaussians that are invisible, too large to be part of an object, or connected to no large part."""
        self.remove("invisible", self.splats.opacities < _MIN_OPACITY, "all Gaussians are invisible")
        if kind == "object":
            splats = self.splats
            size = _extent(splats)
            haze = (splats.scales.max(axis=1) > _MAX_SCALE * size) | long_needles(splats, size)
            self.remove("haze and needles", haze, "all Gaussians are haze or needles: is it an environment?")
        splats = self.splats
        floating = np.zeros(len(splats), dtype=bool)
        floating[find_floaters(splats, visible_area(splats))] = True
        self.remove("floaters", floating, "the Gaussians do not touch each other")


def _extent(splats: Splats) -> float:
    """Return the longest extent of the Gaussians without outliers."""
    return float(np.ptp(np.quantile(splats.means, (OUTLIERS, 1 - OUTLIERS), axis=0), axis=0).max())
