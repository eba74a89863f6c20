"""What stands before the object in a photo, where nobody knows what is behind it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.camera import Camera

_EDGE = 128
"""Longer edge of the object in the picture that shares are counted in [px]."""
_GAPS = (12, 40)
"""Bounds of how far points of a thing reach there, which is twice the usual way to the third nearest of them [px]."""


def hidden_part(camera: Camera, own: Float64Array, others: Sequence[Float64Array]) -> tuple[float, float, BoolArray]:
    """What other things hide of an object from a camera.

    The object's outline is the convex hull of its points in the image, also of one that is not convex: masks are looked
    for in there, and would take in what stands before a notch; and sparse points do not tell a notch from a plain side.
    Another thing is where its points lie close that are nearer to the camera than the middle of the object; it may
    reach around it. As plain sides have no points, it may be anywhere between these, and half such a gap beyond.

    Args:
        camera: From where.
        own: Points on the object, shape (N, 3).
        others: Points on each other thing, shape (M, 3).

    Returns:
        The share of the outline that things hide, the share that they may hide, and the pixels where they may be, shape
        (H, W).
    """
    pixels, depths = camera.project(own)
    size = float(np.ptp(pixels, axis=0).max()) if len(own) >= 3 and (depths > 0).all() else 0.0
    if size <= 0:
        return 0.0, 0.0, np.zeros((camera.height, camera.width), dtype=bool)
    step, low = _EDGE / size, pixels.min(axis=0)

    def placed(pixels: Float64Array) -> Float64Array:
        return np.asarray((pixels - low) * step + _EDGE / 2)

    edge = 2 * _EDGE
    outline, hidden, possible = (np.zeros((edge, edge), dtype=np.uint8) for _ in range(3))
    _fill_hull(outline, placed(pixels))
    middle = float(np.median(depths))
    for points in others:
        pixels, depths = camera.project(points)
        near = placed(pixels[(depths > 0) & (depths < middle)])
        near = near[((near >= 0) & (near < edge)).all(axis=1)]
        if len(near) < 4:
            continue
        gap = round(float(np.clip(2 * np.median(KDTree(near).query(near, k=4)[0][:, -1]), *_GAPS)))
        x, y = near.astype(np.intp).T
        dots = np.zeros_like(outline)
        dots[y, x] = 1
        closed = cv2.morphologyEx(dots, cv2.MORPH_CLOSE, _disc(gap), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        hidden |= closed > 0
        between = np.zeros_like(outline)
        _fill_hull(between, near)
        possible |= cv2.dilate(between, _disc(gap // 2)) > 0
    # Pixels have their middles at +0.5 here, and at whole numbers in OpenCV.
    x, y = step * (0.5 - low) + _EDGE / 2 - 0.5
    back = np.array([[step, 0, x], [0, step, y]])
    seen = cv2.warpAffine(possible, back, (camera.width, camera.height), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    hides, may_hide = (float(part[outline > 0].mean()) for part in (hidden, possible))
    return hides, may_hide, np.asarray(seen > 0)


def _fill_hull(picture: npt.NDArray[np.uint8], pixels: Float64Array) -> None:
    """Set a picture to 1 in the convex hull of pixels (N, 2)."""
    cv2.fillConvexPoly(picture, np.rint(cv2.convexHull(pixels.astype(np.float32))).astype(np.int32), 1)


def _disc(radius: int) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), dtype=np.uint8)
