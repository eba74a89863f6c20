"""A folder of labelled frames that survives whatever ends it.

In: a scene. Out: a dataset on disk, by any number of processes and machines, resumed or not, in shards or whole: the
same bytes. Scenes that can come to nothing are refused before work starts (:mod:`.prospects`).
"""

from __future__ import annotations

from mitsplat.dataset.dataset_folder import Shard
from mitsplat.dataset.folds import Fold, write_folds
from mitsplat.dataset.given_frames import write_frames
from mitsplat.dataset.remake import RemadeFrame, remake_frame
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import DatasetSummary, write_dataset

__all__ = [
    "DatasetSummary",
    "Fold",
    "RemadeFrame",
    "Shard",
    "merge_shards",
    "remake_frame",
    "write_dataset",
    "write_folds",
    "write_frames",
]
