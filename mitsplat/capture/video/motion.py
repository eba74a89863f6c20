"""How far the picture of a video has moved, frame by frame, and where it jumps."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mitsplat.arrays import ByteImage, Float32Array
from mitsplat.capture.video.shrink import shrink

_EDGE = 480
"""Longer edge at which motion is measured [px]."""
_CORNERS = 300
"""Most corners that are followed."""
_FEWEST = 12
"""Corners without which motion is not known."""
_SURVIVING = 0.3
"""Share of the corners that must be found again. Views of one thing keep most, other pictures hardly any."""
_RETURN = 1.0
"""Distance from where it began up to which a corner that was followed there and back counts as found [px]."""
_TICK = 0.01
"""Share of the picture's width from which it has moved on: well above what noise and compression do to a still one."""
_PATIENCE = 5
"""Frames in a row that may be blurred beyond recognition; after them the picture counts as another one."""


@dataclass(frozen=True)
class Moved:
    """Where in the motion of a video a frame is.

    Attributes:
        segment: Number of the stretch without a jump that it belongs to.
        path: How far the picture has moved up to it, in all segments together, as a share of its width.
        followed: Whether that was measured in this frame; a frame in which nothing is recognised is as far as the last.
    """

    segment: int
    path: float
    followed: bool


class MotionClock:
    """Adds up how far pictures move: the median length of the tracks of corners (Shi and Tomasi 1994; Bouguet 2000).

    Corners are followed from one picture, the anchor, until the picture has moved on from it; then that one is the
    anchor. So noise, and a hand that trembles about a place, add up to nothing.
    """

    def __init__(self) -> None:
        self._anchor: ByteImage | None = None
        self._corners: Float32Array = np.zeros((0, 1, 2), dtype=np.float32)
        self._segment, self._path, self._beyond, self._lost = 0, 0.0, 0.0, 0

    def add(self, grey: ByteImage) -> Moved:
        """Take the next picture, grey, shape (H, W)."""
        grey = shrink(grey, _EDGE)
        if (
            self._anchor is None or len(self._corners) < _FEWEST
        ):  # nothing to follow yet: the first that shows something
            self._take(grey)
            return Moved(self._segment, self._path, len(self._corners) >= _FEWEST)
        moves = _moves(self._anchor, grey, self._corners)
        if len(moves) < max(_FEWEST, _SURVIVING * len(self._corners)):
            self._lost += 1
            if self._lost <= _PATIENCE:
                return Moved(self._segment, self._path + self._beyond, followed=False)
            self._path += self._beyond
            self._segment += 1
            self._take(grey)
            return Moved(self._segment, self._path, len(self._corners) >= _FEWEST)
        self._lost = 0
        self._beyond = float(np.median(np.linalg.norm(moves, axis=1))) / grey.shape[1]
        moved = Moved(self._segment, self._path + self._beyond, followed=True)
        if self._beyond >= _TICK:
            self._path = moved.path
            self._take(grey)
        return moved

    def _take(self, grey: ByteImage) -> None:
        """Make a picture the anchor."""
        found = cv2.goodFeaturesToTrack(grey, _CORNERS, qualityLevel=0.01, minDistance=8)
        self._corners = np.zeros((0, 1, 2), dtype=np.float32) if found is None else np.asarray(found, dtype=np.float32)
        self._anchor, self._beyond, self._lost = grey, 0.0, 0


def _moves(before: ByteImage, after: ByteImage, corners: Float32Array) -> Float32Array:
    """Displacements [px] of the corners, shape (N, 1, 2), that are found again, shape (M, 2)."""
    window, levels = (21, 21), 4
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy(), winSize=window, maxLevel=levels)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, corners.copy(), winSize=window, maxLevel=levels)
    near = np.linalg.norm(back - corners, axis=2).ravel() < _RETURN
    good = near & (found.ravel() > 0) & (returned.ravel() > 0)
    return np.asarray((there - corners)[good, 0], dtype=np.float32)
