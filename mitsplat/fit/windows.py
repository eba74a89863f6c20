"""The part of each photo that a fit of an object alone needs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsplat.arrays import Int64Array
from mitsplat.capture.capture import Photo, Window

_MARGIN = 0.1
"""Room on each side of the object where it is largest, as a share of its size there: there splats must be invisible."""
_WHOLE = 0.95
"""Share of a photo's longer edge from which a part of it is no gain."""


def object_windows(photos: Sequence[Photo]) -> list[Window | None]:
    """Where the masks of photos show the object, with room around it; None where all of a photo is needed.

    All are of one size as far as photos are, because each size takes kernels of its own.
    """
    boxes = [_box(photo) for photo in photos]
    sizes = [box[1] - box[0] for box in boxes if box is not None]
    if not sizes:
        return [None] * len(photos)
    room = np.ceil((1 + 2 * _MARGIN) * np.max(sizes, axis=0)).astype(np.int64)
    return [None if box is None else _window(photo, box, room) for photo, box in zip(photos, boxes, strict=True)]


def _window(photo: Photo, box: Int64Array, room: Int64Array) -> Window | None:
    whole = np.array([photo.camera.width, photo.camera.height])
    size = np.minimum(room, whole)
    if size.max() >= _WHOLE * whole.max():
        return None
    left, top = np.clip((box.sum(axis=0) - size) // 2, 0, whole - size).tolist()
    return left, top, int(size[0]), int(size[1])


def _box(photo: Photo) -> Int64Array | None:
    """Least x and y of what the mask of a photo shows, and those where it ends [px], shape (2, 2)."""
    mask = photo.alpha()
    shown = np.argwhere(mask >= 0.5) if mask is not None else np.zeros((0, 2), dtype=np.int64)
    return np.stack([shown.min(axis=0)[::-1], shown.max(axis=0)[::-1] + 1]) if len(shown) else None
