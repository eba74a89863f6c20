"""Parallel frame generation in worker processes, on this machine or on a Ray cluster.

Input: a function that makes a frame, and the frames of every layout. Output: the function's return values, in order of
completion. The frame of a process that dies is made again. A new process starts only if no other is left, or if a
machine joins the cluster, because most processes die of exhausted memory. All processes of a machine share one copy of
a scene's arrays. This package does not depend on the type of a frame.
"""

from __future__ import annotations

from mitsplat.engine.answers import FrameError, LostWorkersError
from mitsplat.engine.pool import affordable_workers, run_frames
from mitsplat.engine.ray import Cluster
from mitsplat.engine.resources import WorkerMemory, unused_memory
from mitsplat.engine.worker_processes import MakeFrame

__all__ = [
    "Cluster",
    "FrameError",
    "LostWorkersError",
    "MakeFrame",
    "WorkerMemory",
    "affordable_workers",
    "run_frames",
    "unused_memory",
]
