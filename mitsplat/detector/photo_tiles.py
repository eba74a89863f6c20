"""Tiles of photographs that match the object size of a detector's later input.

A photograph scaled to the training size shows objects smaller than the same photograph at a larger prediction size.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import BoolArray
from mitsplat.detector.labelled_sets.labelled_set import LabelledObject, LabelledSet
from mitsplat.detector.labelled_sets.pictures import MIN_SIDE, read_upright
from mitsplat.errors import InputError
from mitsplat.images.masks import Silhouette, decode_rle
from mitsplat.labels.polygons import outline

MIN_VISIBLE_SHARE = 0.15
"""Least visible share of an object, relative to the whole photograph, for a label in a tile."""
_MIN_OVERLAP = 1 / 3
"""Least overlap of tiles as a share of their sides; an object up to this size is whole in at least one tile."""
_JPEG_OPTIONS = (cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
"""JPEG quality similar to that of cameras, which preserves the noise."""


def cut_photographs(photographs: LabelledSet, real_size: int, size: int, folder: Path) -> LabelledSet:
    """Cut photographs to overlapping tiles.

    A tile at ``size`` shows objects as large as a whole photograph at ``real_size``.

    Args:
        photographs: Labelled photographs.
        real_size: Longer side of a whole photograph [px], larger than ``size``.
        size: Longer side to which a tile is scaled [px].
        folder: Output folder of the tiles, which are JPEG files.

    Raises:
        InputError: If a photograph cannot be read, or its tiles are too small.
        OSError: If a tile cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    samples = []
    for number, sample in enumerate(photographs.samples):
        picture = read_upright(sample.path)
        width, height = (max(round(side * size / real_size), 1) for side in (sample.width, sample.height))
        if min(width, height) < MIN_SIDE:
            raise InputError(
                f"{sample.path}: tiles must have sides of at least {MIN_SIDE} px (got {width} x {height}): use "
                f"a --real-size nearer to --size, {size}"
            )
        masks = [
            np.asarray(decode_rle(one.encode_mask(sample.width, sample.height)), dtype=bool) if one.has_mask else None
            for one in sample.instances
        ]
        for top in _tile_starts(sample.height, height):
            for left in _tile_starts(sample.width, width):
                path = folder / f"{number:05d}_{top}_{left}.jpg"
                _, data = cv2.imencode(".jpg", picture[top : top + height, left : left + width], _JPEG_OPTIONS)
                path.write_bytes(data.tobytes())  # cv2.imwrite reports no full disk
                found = (
                    _crop_object(instance, mask, left, top, width, height)
                    for instance, mask in zip(sample.instances, masks, strict=True)
                )
                instances = tuple(instance for instance in found if instance is not None)
                samples.append(replace(sample, path=path, width=width, height=height, instances=instances))
    return replace(photographs, samples=tuple(samples))


def _tile_starts(side: int, tile: int) -> list[int]:
    """Return the tile positions along a side; the first and the last tile touch its ends."""
    step = (1 - _MIN_OVERLAP) * tile
    return [round(start) for start in np.linspace(0, side - tile, int(np.ceil((side - tile) / step)) + 1)]


def _crop_object(
    instance: LabelledObject, mask: BoolArray | None, left: int, top: int, width: int, height: int
) -> LabelledObject | None:
    """Return the part of a labelled object in a tile, or None if too little of it is visible."""
    if mask is not None:
        seen = mask[top : top + height, left : left + width]
        if seen.sum() < max(MIN_VISIBLE_SHARE * mask.sum(), 1):
            return None
        box = Silhouette.cropped(seen, 0, 0).box
        return LabelledObject(instance.class_index, box, outline(seen), crowd=instance.crowd)
    low, high = np.reshape(instance.box, (2, 2))
    inside = np.clip([low, high], (left, top), (left + width, top + height))
    if (inside[1] - inside[0]).prod() < MIN_VISIBLE_SHARE * (high - low).prod():
        return None
    (x0, y0), (x1, y1) = (inside - (left, top)).tolist()
    return LabelledObject(instance.class_index, (x0, y0, x1, y1), crowd=instance.crowd)
