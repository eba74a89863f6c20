"""Occlusion of the object by other objects in a photo."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import disc, fill_hull

_EDGE = 128
"""Longer edge of the object in the picture in which fractions are counted [px]."""
_GAPS = (12, 40)
"""Bounds of the gap between points of an object in that picture [px].

The gap is twice the median distance to the third nearest point.
"""


def occluded_part(camera: Camera, own: Float64Array, others: Sequence[Float64Array]) -> tuple[float, float, BoolArray]:
    """Estimate the part of an object that other objects occlude from a camera.

    The outline of the object is the convex hull of its points in the image, even for an object that is not convex. The
    first reason is that masks are searched in the hull and would include an object in front of a notch. The second is
    that sparse points cannot separate a notch from a plain surface.

    Another object occludes the image where its points are dense and nearer to the camera than the middle of the object.
    It may surround the object. Plain surfaces have no points, so the object may cover the whole hull of its points and
    half a gap beyond.

    Args:
        camera: Camera of the photo.
        own: Points on the object, shape (N, 3).
        others: Points on each other object, shape (M, 3).

    Returns:
        The occluded fraction of the outline, the possibly occluded fraction, and the possibly occluded pixels, shape
        (H, W).
    """
    pixels, depths = camera.project(own)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]  # the lens shows no points beyond the fold of its distortion
    size = float(np.ptp(pixels, axis=0).max()) if len(pixels) >= 3 and (depths > 0).all() else 0.0
    if size <= 0:
        return 0.0, 0.0, np.zeros((camera.height, camera.width), dtype=bool)
    step, low = _EDGE / size, pixels.min(axis=0)

    def placed(pixels: Float64Array) -> Float64Array:
        return np.asarray((pixels - low) * step + _EDGE / 2)

    edge = 2 * _EDGE
    outline, hidden, possible = (np.zeros((edge, edge), dtype=np.uint8) for _ in range(3))
    fill_hull(outline, placed(pixels))
    middle = float(np.median(depths))
    for points in others:
        pixels, depths = camera.project(points)
        near = placed(pixels[depths < middle])
        near = near[((near >= 0) & (near < edge)).all(axis=1)]  # points behind the camera have no pixel
        if len(near) < 4:
            continue
        gap = round(float(np.clip(2 * np.median(KDTree(near).query(near, k=4)[0][:, -1]), *_GAPS)))
        x, y = near.astype(np.intp).T
        dots = np.zeros_like(outline)
        dots[y, x] = 1
        closed = cv2.morphologyEx(dots, cv2.MORPH_CLOSE, disc(gap), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        hidden |= closed > 0
        between = np.zeros_like(outline)
        fill_hull(between, near)
        possible |= cv2.dilate(between, disc(gap // 2)) > 0
    # Pixel centres are at +0.5 here, and at integers in OpenCV.
    x, y = step * (0.5 - low) + _EDGE / 2 - 0.5
    back = np.array([[step, 0, x], [0, step, y]])
    seen = cv2.warpAffine(possible, back, camera.size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    occluded, possibly_occluded = (float(part[outline > 0].mean()) for part in (hidden, possible))
    return occluded, possibly_occluded, np.asarray(seen > 0)
