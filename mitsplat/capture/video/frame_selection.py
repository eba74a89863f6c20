"""Selection of video frames by image motion and sharpness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.capture.video.motion import MotionPosition

STEP = 0.05
"""Image motion between chosen frames, as a fraction of the image width.

It corresponds to ten degrees around an object that stands on its board and fills half of the image.
"""

_CENTRAL_SHARE = 0.5
"""Central fraction of a step that is searched first, so that frames are evenly spaced."""

_MIN_RELATIVE_SHARPNESS = 0.5
"""Minimum sharpness of the best central frame relative to the best frame of the step; otherwise the latter is taken."""


@dataclass(frozen=True)
class FrameMeasure:
    """Measurements of a frame before the selection.

    Attributes:
        index: Frame number in the video, from 0.
        time: Display time [s].
        moved: Position in the motion of the video.
        sharpness: Result of :func:`mitsplat.capture.video.sharpness.sharpness`.
    """

    index: int
    time: float
    moved: MotionPosition
    sharpness: float


@dataclass(frozen=True)
class Choice:
    """Chosen frames.

    Attributes:
        frames: Frames in the order of the video.
        cuts: Times of discontinuities [s].
        moved: Total image motion as a fraction of the image width, without discontinuities.
    """

    frames: tuple[FrameMeasure, ...]
    cuts: tuple[float, ...]
    moved: float


def choose(measures: list[FrameMeasure], most: int) -> Choice:
    """Choose the sharpest frame of each step of motion.

    Each continuous segment is divided into equal steps of at most :data:`STEP`, or of longer steps if there would be
    more than ``most`` frames. Sharpness is compared only within a step. Its frames show nearly the same view, so that
    blur determines the sharpness and not texture. Each segment gives at least one frame. So the result exceeds ``most``
    only for a video with at least as many discontinuities.
    """
    usable = [measure for measure in measures if measure.moved.tracked]
    numbers = sorted({measure.moved.segment for measure in usable})
    segments = [[measure for measure in usable if measure.moved.segment == number] for number in numbers]
    paths = [np.maximum.accumulate([measure.moved.path for measure in segment]) for segment in segments]
    lengths = [float(path[-1] - path[0]) for path in paths]
    spare = max(1, most - len(segments))
    step = max(STEP, sum(lengths) / spare)
    chosen = []
    for segment, path, length in zip(segments, paths, lengths, strict=True):
        count = 1 + int(length / step)
        sharp = np.array([measure.sharpness for measure in segment])
        chosen += [
            segment[place]
            for place in _sharpest_frames(np.asarray((path - path[0]) / max(length, 1e-12)), sharp, count)
        ]
    return Choice(tuple(chosen), tuple(segment[0].time for segment in segments[1:]), sum(lengths))


def _sharpest_frames(share: Float64Array, sharp: Float64Array, count: int) -> list[int]:
    """Return the indices of the sharpest frame of each of ``count`` equal steps; empty steps have none.

    Args:
        share: Fraction of the motion before each frame, 0 to 1, not decreasing, shape (N,).
        sharp: Sharpness of the frames, shape (N,).
        count: Number of steps.
    """
    places: Int64Array = np.minimum((share * count).astype(np.int64), count - 1)
    central = np.abs(share * count - places - 0.5) <= _CENTRAL_SHARE / 2
    chosen = []
    for number in np.unique(places):
        inside = np.flatnonzero(places == number)
        best = inside[np.argmax(sharp[inside])]
        middle = inside[central[inside]]
        if count > 1 and len(middle):
            nearest = middle[np.argmax(sharp[middle])]
            best = nearest if sharp[nearest] >= _MIN_RELATIVE_SHARPNESS * sharp[best] else best
        chosen.append(int(best))
    return chosen
