"""Alignment of a reconstruction: metric scale, vertical direction and origin.

In: cameras and points of structure from motion, and the photographs. Out: the similarity to the asset frame, with the
evidence that it rests on: a board, tags, a known distance, the table plane or the attitudes of the cameras.
"""

from __future__ import annotations

from mitsplat.capture.alignment.metric_frame import MetricFrame, find_metric_frame

__all__ = ["MetricFrame", "find_metric_frame"]
