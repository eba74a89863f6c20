"""Job of the tests of shared arrays. Workers import this module, which imports no test so that they start fast."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mitsplat.asset import Asset
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.storage.cache import cache_folder


@dataclass(frozen=True)
class Describe:
    """Job that describes its arrays from within a worker."""

    splats: Splats
    asset: Asset
    empty: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    text: str = "as it was"

    def __call__(self, index, note, /):
        total = total_of(self.splats)
        try:
            self.splats.means.flags.writeable = True
        except ValueError as error:
            refusal = str(error)
        self.asset.mesh.copy().apply_scale(2.0)
        rows = Path("/proc/self/smaps").read_text().split("\n")
        starts = [i for i, row in enumerate(rows) if str(cache_folder()) in row]
        mapped = [rows[i].split()[1] for i in starts]
        resident = sum(int(row.split()[1]) for i in starts for row in rows[i : i + 5] if row.startswith("Rss:")) / 1024
        return os.getpid(), total, refusal, mapped, resident, (self.empty.shape, self.text)


def arrays_of(splats: Splats) -> list[np.ndarray]:
    return [getattr(splats, name) for name in SplatArrays._fields]


def total_of(splats: Splats) -> float:
    return float(sum(array.sum(dtype=np.float64) for array in arrays_of(splats)))
