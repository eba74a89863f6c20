"""Contact sheet: one picture of a dataset's frames with their labels drawn."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import ByteImage, evenly_spaced
from mitsplat.formats.coco import image_file
from mitsplat.images.picture_files import read_picture_inside
from mitsplat.labels.labels import Labels
from mitsplat.labels.overlay import draw_labels
from mitsplat.storage.files import Record, write_bytes

_TILES, _COLUMNS = 16, 4
_TILE_WIDTH = 480
_CAPTION = 24
_GAP = 6


class ContactSheet:
    """Picture of up to :data:`_TILES` labelled frames, evenly spread over the ``total`` frames of the dataset."""

    def __init__(self, root: Path, total: int) -> None:
        self._root = root
        self._selected = set(evenly_spaced(total, _TILES))
        self._count = 0
        self._tiles: list[ByteImage] = []

    def add(self, record: Record) -> None:
        """Count the next frame, and add a tile for it if its position was selected.

        Raises:
            OSError: If its image cannot be read.
        """
        if self._count in self._selected:
            self._tiles.append(_tile(self._root, record))
        self._count += 1

    def write(self, path: Path) -> None:
        """Write the picture as JPEG."""
        tiles = self._tiles
        height, width = max(tile.shape[0] for tile in tiles) + _GAP, _TILE_WIDTH + _GAP
        columns = min(_COLUMNS, len(tiles))
        sheet = np.full((-(-len(tiles) // columns) * height, columns * width - _GAP, 3), 32, dtype=np.uint8)
        for i, tile in enumerate(tiles):
            top, left = i // columns * height, i % columns * width
            sheet[top : top + tile.shape[0], left : left + _TILE_WIDTH] = tile
        _, data = cv2.imencode(".jpg", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])
        write_bytes(path, bytes(data))


def _tile(root: Path, record: Record) -> ByteImage:
    """Return the picture of a frame with its labels and a caption, RGB (H, W, 3)."""
    image = read_picture_inside(root, image_file(record))
    if image is None:
        raise OSError(f"{root / image_file(record)} cannot be read as an image")
    rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    drawn = draw_labels(rgb, Labels.from_json(record["labels"]))
    height = max(1, round(drawn.shape[0] * _TILE_WIDTH / drawn.shape[1]))
    shrink = cv2.INTER_AREA if drawn.shape[1] > _TILE_WIDTH else cv2.INTER_LINEAR
    tile = np.full((height + _CAPTION, _TILE_WIDTH, 3), 32, dtype=np.uint8)
    tile[:height] = cv2.resize(drawn, (_TILE_WIDTH, height), interpolation=shrink)
    caption = f"{record['index']:06d}  {record['split']}  {len(record['labels']['instances'])} instances"
    cv2.putText(tile, caption, (6, height + 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (230, 230, 230), 1, cv2.LINE_AA)
    return tile
