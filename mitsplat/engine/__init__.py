"""Frames made by processes, on this machine or on a Ray cluster.

In: a function that makes a frame, and the frames of every layout. Out: what it returns, as it is finished. Processes
that die are replaced and their frames made again; the arrays of a scene exist once in memory, however many processes
read them. Nothing here knows what a frame is.
"""

from __future__ import annotations

from mitsplat.engine.pool import FrameError, LostWorkersError, MakeFrame, affordable_workers, run_frames
from mitsplat.engine.ray import Cluster
from mitsplat.engine.resources import WorkerMemory, unused_memory

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
