"""Image motion of a video frame by frame, and its discontinuities."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mitsplat.arrays import ByteImage, Float32Array
from mitsplat.capture.video.sharpness import shrink

_EDGE = 480
"""Longer edge of the images in which motion is measured [px]."""
_MAX_CORNERS = 300
"""Maximum number of tracked corners."""
_MIN_CORNERS = 12
"""Minimum number of corners for a motion measurement."""
_MIN_SURVIVING = 0.3
"""Minimum fraction of corners that must be found again; views of one scene keep most, other images hardly any."""
_MAX_RETURN_ERROR = 1.0
"""Maximum distance between a corner and its position after forward and backward tracking [px]."""
_ANCHOR_MOTION = 0.01
"""Motion after which the anchor is replaced, as a fraction of the image width; well above noise and compression."""
_MAX_LOST_FRAMES = 5
"""Maximum number of consecutive unrecognisable frames; after them, a new segment starts."""


@dataclass(frozen=True)
class MotionPosition:
    """Position of a frame in the motion of a video.

    Attributes:
        segment: Index of the continuous segment.
        path: Accumulated image motion over all segments, as a fraction of the image width.
        tracked: True if motion was measured in this frame; otherwise ``path`` is that of the frame before.
    """

    segment: int
    path: float
    tracked: bool


class MotionClock:
    """Accumulator of image motion: the median length of corner tracks (Shi and Tomasi 1994; Bouguet 2000).

    Corners are tracked from one image, the anchor, until the motion since then exceeds ``_ANCHOR_MOTION``. The current
    image then becomes the anchor. So noise and a trembling hand add no motion.
    """

    def __init__(self) -> None:
        self._anchor: ByteImage | None = None
        self._corners: Float32Array = np.zeros((0, 1, 2), dtype=np.float32)
        self._segment, self._path, self._beyond, self._lost = 0, 0.0, 0.0, 0

    def add(self, grey: ByteImage) -> MotionPosition:
        """Add the next image, grey, shape (H, W), and return its position in the motion."""
        grey = shrink(grey, _EDGE)
        if self._anchor is None or len(self._corners) < _MIN_CORNERS:  # use the first image with corners
            self._set_anchor(grey)
            return MotionPosition(self._segment, self._path, len(self._corners) >= _MIN_CORNERS)
        moves = _track_corners(self._anchor, grey, self._corners)
        if len(moves) < max(_MIN_CORNERS, _MIN_SURVIVING * len(self._corners)):
            self._lost += 1
            if self._lost <= _MAX_LOST_FRAMES:
                return MotionPosition(self._segment, self._path + self._beyond, tracked=False)
            self._path += self._beyond
            self._segment += 1
            self._set_anchor(grey)
            return MotionPosition(self._segment, self._path, len(self._corners) >= _MIN_CORNERS)
        self._lost = 0
        self._beyond = float(np.median(np.linalg.norm(moves, axis=1))) / grey.shape[1]
        moved = MotionPosition(self._segment, self._path + self._beyond, tracked=True)
        if self._beyond >= _ANCHOR_MOTION:
            self._path = moved.path
            self._set_anchor(grey)
        return moved

    def _set_anchor(self, grey: ByteImage) -> None:
        """Make an image the anchor."""
        found = cv2.goodFeaturesToTrack(grey, _MAX_CORNERS, qualityLevel=0.01, minDistance=8)
        self._corners = np.zeros((0, 1, 2), dtype=np.float32) if found is None else np.asarray(found, dtype=np.float32)
        self._anchor, self._beyond, self._lost = grey, 0.0, 0


def _track_corners(before: ByteImage, after: ByteImage, corners: Float32Array) -> Float32Array:
    """Return the displacements [px], shape (M, 2), of the corners (N, 1, 2) that are found again."""
    window, levels = (21, 21), 4
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy(), winSize=window, maxLevel=levels)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, corners.copy(), winSize=window, maxLevel=levels)
    near = np.linalg.norm(back - corners, axis=2).ravel() < _MAX_RETURN_ERROR
    good = near & (found.ravel() > 0) & (returned.ravel() > 0)
    return np.asarray((there - corners)[good, 0], dtype=np.float32)
