"""Dataset folders: writing, resuming, sharding, merging, splitting and re-rendering of single frames.

In: a scene. Out: a folder of labelled frames on disk. The bytes are the same for any number of processes, machines,
shards and resumed runs. Scenes that would produce no labels are refused before work starts (:mod:`.preflight`).
"""

from __future__ import annotations

from mitsplat.dataset.folds import Fold, write_folds
from mitsplat.dataset.python_frames import write_frames
from mitsplat.dataset.rerender import RerenderedFrame, rerender_frame
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import DatasetSummary, write_dataset

__all__ = [
    "DatasetSummary",
    "Fold",
    "RerenderedFrame",
    "Shard",
    "merge_shards",
    "rerender_frame",
    "write_dataset",
    "write_folds",
    "write_frames",
]
