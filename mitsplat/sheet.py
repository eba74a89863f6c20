"""Pictures to check labels by: masks, boxes and class names drawn over images, and a contact sheet of a dataset."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.coco import image_file
from mitsplat.files import Record, write_file
from mitsplat.label import InstanceLabel, Labels

Image = npt.NDArray[np.uint8]

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_COLUMNS = 4
_TILE_WIDTH = 480
_CAPTION = 24
_GAP = 6


def class_colour(class_index: int) -> tuple[int, int, int]:
    """Colour of a class, RGB in [0, 255]: hues apart by the golden ratio, so that neighbours differ."""
    hue = (0.11 + class_index * (math.sqrt(5) - 1) / 2) % 1
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.85, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_labels(image: Image, labels: Labels, *, opacity: float = 0.45) -> Image:
    """The RGB image (H, W, 3) with the instances' masks tinted, outlined, boxed and named by class."""
    drawn = image.copy()
    unit = max(1.0, image.shape[1] / 640)
    for label in labels.instances:
        x0, y0, x1, y1 = label.box
        view = drawn[y0:y1, x0:x1]
        colour = np.array(class_colour(label.class_index))
        view[label.mask] = np.rint((1 - opacity) * view[label.mask] + opacity * colour)
    for label in labels.instances:
        _draw_edges(drawn, label, unit)
    for label in labels.instances:  # names last, so that nothing covers them
        _draw_name(drawn, label, unit)
    return drawn


def contact_sheet(root: Path, records: Collection[Record], path: Path, *, count: int = 16) -> None:
    """Write a JPEG of up to ``count`` frames, evenly spread over the ``records`` below ``root``, labels drawn.

    Raises:
        OSError: If an image cannot be read.
    """
    chosen = np.unique(np.linspace(0, len(records) - 1, min(count, len(records))).round().astype(int))
    tiles = [_tile(root, record) for i, record in enumerate(records) if i in chosen]
    height, width = max(tile.shape[0] for tile in tiles) + _GAP, _TILE_WIDTH + _GAP
    columns = min(_COLUMNS, len(tiles))
    sheet = np.full((-(-len(tiles) // columns) * height, columns * width - _GAP, 3), 32, dtype=np.uint8)
    for i, tile in enumerate(tiles):
        top, left = i // columns * height, i % columns * width
        sheet[top : top + tile.shape[0], left : left + _TILE_WIDTH] = tile
    _, data = cv2.imencode(".jpg", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])
    write_file(path, lambda temporary: temporary.write_bytes(bytes(data)))


def _tile(root: Path, record: Record) -> Image:
    file = root / image_file(record)
    image = cv2.imread(str(file))
    if image is None:
        raise OSError(f"{file} cannot be read as an image")
    rgb = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    drawn = draw_labels(rgb, Labels.from_json(record["labels"]))
    height = max(1, round(drawn.shape[0] * _TILE_WIDTH / drawn.shape[1]))
    shrink = cv2.INTER_AREA if drawn.shape[1] > _TILE_WIDTH else cv2.INTER_LINEAR
    tile = np.full((height + _CAPTION, _TILE_WIDTH, 3), 32, dtype=np.uint8)
    tile[:height] = cv2.resize(drawn, (_TILE_WIDTH, height), interpolation=shrink)
    caption = f"{record['index']:06d}  {record['split']}  {len(record['labels']['instances'])} instances"
    cv2.putText(tile, caption, (6, height + 17), _FONT, 0.5, (230, 230, 230), 1, cv2.LINE_AA)
    return tile


def _draw_edges(image: Image, label: InstanceLabel, unit: float) -> None:
    x0, y0, x1, y1 = label.box
    colour = class_colour(label.class_index)
    contours, _ = cv2.findContours(label.mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, colour, max(1, round(unit / 2)), offset=(x0, y0))
    cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), colour, max(1, round(unit)))


def _draw_name(image: Image, label: InstanceLabel, unit: float) -> None:
    x0, y0 = label.box[:2]
    scale, thickness = 0.42 * unit, max(1, round(unit))
    (width, height), baseline = cv2.getTextSize(label.class_name, _FONT, scale, thickness)
    left = max(0, min(x0, image.shape[1] - width - 2))
    bottom = max(y0, height + baseline)
    colour = class_colour(label.class_index)
    corner = (left + width + 2, bottom)
    cv2.rectangle(image, (left, bottom - height - baseline), corner, colour, cv2.FILLED)
    ink = (0, 0, 0) if np.dot(colour, (0.299, 0.587, 0.114)) > 128 else (255, 255, 255)  # by Rec. 601 luma
    origin = (left + 1, bottom - baseline // 2 - 1)
    cv2.putText(image, label.class_name, origin, _FONT, scale, ink, thickness, cv2.LINE_AA)
