"""Part of each photo that the fit of a single object needs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsplat.arrays import Int64Array
from mitsplat.capture.capture import Photo, Window

_MARGIN = 0.1
"""Margin on each side of the object, as a share of its largest size; splats in the margin must be invisible."""
_MAX_CROP_SHARE = 0.95
"""Share of a photo's longer edge from which cropping has no benefit."""


def object_windows(photos: Sequence[Photo]) -> list[Window | None]:
    """Return the window of each photo around the object in its mask, with a margin; None if the whole photo is needed.

    All windows have the same size if photos are large enough, because each size compiles its own kernels.
    """
    boxes = [_box(photo) for photo in photos]
    sizes = [box[1] - box[0] for box in boxes if box is not None]
    if not sizes:
        return [None] * len(photos)
    room = np.ceil((1 + 2 * _MARGIN) * np.max(sizes, axis=0)).astype(np.int64)
    return [None if box is None else _window(photo, box, room) for photo, box in zip(photos, boxes, strict=True)]


def _window(photo: Photo, box: Int64Array, room: Int64Array) -> Window | None:
    whole = np.array(photo.camera.size)
    size = np.minimum(room, whole)
    if size.max() >= _MAX_CROP_SHARE * whole.max():
        return None
    left, top = np.clip((box.sum(axis=0) - size) // 2, 0, whole - size).tolist()
    return left, top, int(size[0]), int(size[1])


def _box(photo: Photo) -> Int64Array | None:
    """Return the bounds of the object in a photo's mask [px]: least x and y, and exclusive ends, shape (2, 2)."""
    mask, _ = photo.read_mask()
    shown = np.argwhere(mask >= 0.5) if mask is not None else np.zeros((0, 2), dtype=np.int64)
    return np.stack([shown.min(axis=0)[::-1], shown.max(axis=0)[::-1] + 1]) if len(shown) else None
