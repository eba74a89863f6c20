"""What stands before the object in a photo, which no mask of the object can tell from it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import KDTree

from mitsplat.arrays import Float64Array
from mitsplat.camera import Camera

_EDGE = 128
"""Longer edge of the object in the picture that shares are counted in [px]."""
_GAPS = (12, 40)
"""Bounds of how far points of a thing reach there, which is twice the usual way to the third nearest of them [px]."""


def hidden_share(camera: Camera, own: Float64Array, others: Sequence[Float64Array]) -> float:
    """Share of an object's outline that other things hide from a camera.

    The object's outline is the convex hull of its points in the image, also of one that is not convex: masks are looked
    for in there, and would take in what stands before a notch; and sparse points do not tell a notch from a plain side.
    Another thing is where its points lie close that are nearer to the camera than the middle of the object; it may
    reach around it.

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
        return np.asarray((pixels - low) * (_EDGE / size) + _EDGE / 2)

    edge = 2 * _EDGE
    outline = np.zeros((edge, edge), dtype=np.uint8)
    cv2.fillConvexPoly(outline, np.rint(cv2.convexHull(placed(pixels).astype(np.float32))).astype(np.int32), 1)
    hidden, middle = np.zeros(outline.shape, dtype=bool), float(np.median(depths))
    for points in others:
        pixels, depths = camera.project(points)
        near = placed(pixels[(depths > 0) & (depths < middle)])
        near = near[((near >= 0) & (near < edge)).all(axis=1)]
        if len(near) < 4:
            continue
        gap = round(float(np.clip(2 * np.median(KDTree(near).query(near, k=4)[0][:, -1]), *_GAPS)))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * gap + 1, 2 * gap + 1))
        x, y = near.astype(np.intp).T
        dots = np.zeros_like(outline)
        dots[y, x] = 1
        closed = cv2.morphologyEx(dots, cv2.MORPH_CLOSE, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        hidden |= np.asarray(closed > 0)
    return float(hidden[outline > 0].mean())
