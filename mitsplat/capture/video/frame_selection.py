"""Which frames of a video to take, by how far its picture has moved and how sharp it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.capture.video.motion import Moved

STEP = 0.05
"""How far the picture moves from one frame to the next, as a share of its width: ten degrees around a thing that stands
on its board and fills half of the picture."""

_MIDDLE = 0.5
"""Share of a step, about its middle, in which its frame is looked for first, so that frames lie evenly."""

_DULL = 0.5
"""Sharpness of the best frame there, as a share of the step's best, below which that one is taken."""


@dataclass(frozen=True)
class FrameMeasure:
    """What is known of a frame before any is chosen.

    Attributes:
        index: Its number in the video, from 0.
        time: When it is shown [s].
        moved: Where in the motion of the video it is.
        sharpness: As :func:`mitsplat.capture.video.sharpness.sharpness`.
    """

    index: int
    time: float
    moved: Moved
    sharpness: float


@dataclass(frozen=True)
class Choice:
    """Frames to take.

    Attributes:
        frames: In the order of the video.
        cuts: Times at which the picture jumps [s].
        moved: How far the picture moves in all, as a share of its width; jumps do not count.
    """

    frames: tuple[FrameMeasure, ...]
    cuts: tuple[float, ...]
    moved: float


def choose(measures: list[FrameMeasure], most: int) -> Choice:
    """The sharpest frame of each step of the motion.

    Each stretch without jumps is divided into equal steps of at most :data:`STEP`, or of longer ones where there would
    be more than ``most``. Sharpness is compared within a step alone: its frames show nearly the same, so that blur
    decides and not texture. Every stretch gives a frame at least: more than ``most`` come only of a video that jumps as
    often.
    """
    usable = [measure for measure in measures if measure.moved.followed]
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
            segment[place] for place in _sharpest(np.asarray((path - path[0]) / max(length, 1e-12)), sharp, count)
        ]
    return Choice(tuple(chosen), tuple(segment[0].time for segment in segments[1:]), sum(lengths))


def _sharpest(share: Float64Array, sharp: Float64Array, count: int) -> list[int]:
    """Places of the sharpest frame of each of ``count`` equal steps; those that no frame lies in have none.

    Args:
        share: How much of the motion has been before each frame, 0 to 1, not falling, shape (N,).
        sharp: Their sharpness, shape (N,).
        count: Number of steps.
    """
    places: Int64Array = np.minimum((share * count).astype(np.int64), count - 1)
    central = np.abs(share * count - places - 0.5) <= _MIDDLE / 2
    chosen = []
    for number in np.unique(places):
        inside = np.flatnonzero(places == number)
        best = inside[np.argmax(sharp[inside])]
        middle = inside[central[inside]]
        if count > 1 and len(middle):
            nearest = middle[np.argmax(sharp[middle])]
            best = nearest if sharp[nearest] >= _DULL * sharp[best] else best
        chosen.append(int(best))
    return chosen
