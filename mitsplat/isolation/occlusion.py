"""What stands before the object in a photo, which no mask of the object can tell from it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.camera import Camera

_EDGE = 128
"""Longer edge of the object in the picture that shares are counted in [px]."""
_GAP = 12
"""Points of a thing that are at most twice as far apart there have the thing between them [px]."""


def hidden_share(camera: Camera, own: Float64Array, others: Sequence[Float64Array]) -> float:
    """Share of an object's outline that other things hide from a camera.

    The object's outline is the convex hull of its points in the image. Another thing is where its points lie close
    that are nearer to the camera than the middle of the object; it may reach around it.

    Args:
        camera: From where.
        own: Points on the object, shape (N, 3).
        others: Points on each other thing, shape (M, 3).
    """
    pixels, depths = camera.project(own)
    if len(own) < 3 or (depths <= 0).any():
        return 0.0
    low, size = pixels.min(axis=0), float(np.ptp(pixels, axis=0).max())
    if size <= 0:
        return 0.0

    def placed(pixels: Float64Array) -> Float64Array:
        return np.asarray((pixels - low) * (_EDGE / size) + 2 * _GAP)

    edge = _EDGE + 4 * _GAP
    outline = np.zeros((edge, edge), dtype=np.uint8)
    cv2.fillConvexPoly(outline, np.rint(cv2.convexHull(placed(pixels).astype(np.float32))).astype(np.int32), 1)
    hidden, middle = np.zeros(outline.shape, dtype=bool), float(np.median(depths))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _GAP + 1, 2 * _GAP + 1))
    for points in others:
        pixels, depths = camera.project(points)
        near = placed(pixels[(depths > 0) & (depths < middle)])
        x, y = near[((near >= 0) & (near < edge)).all(axis=1)].astype(np.intp).T
        dots = np.zeros_like(outline)
        dots[y, x] = 1
        closed = cv2.morphologyEx(dots, cv2.MORPH_CLOSE, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        hidden |= np.asarray(closed > 0)
    return float(hidden[outline > 0].mean())
