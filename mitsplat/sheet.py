"""Pictures to check labels by: labels drawn over images, a frame's layers side by side, a dataset's contact sheet."""

from __future__ import annotations

import colorsys
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.coco import image_file
from mitsplat.files import Record, write_file
from mitsplat.label import InstanceLabel, Labels

if TYPE_CHECKING:
    from mitsplat.frame import Frame

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


def layer_sheet(frame: Frame) -> Image:
    """A frame's picture, labels, ids, depth, light and highlight side by side, each with a caption, RGB."""
    known = frame.depth[frame.depth > 0]
    near, far = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    share = np.clip((frame.depth - near) / max(far - near, 1e-9), 0, 1)
    depth = cv2.applyColorMap(np.rint(255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    tiles = {
        "picture": frame.image,
        f"labels: {len(frame.labels.instances)} instances": draw_labels(frame.image, frame.labels),
        "ids by splats": _id_colours(frame.instance),
        f"depth: {near:.3g} to {far:.3g} m": np.where(frame.depth[..., None] > 0, depth, 0).astype(np.uint8),
        "light: black 0, grey 1 (as captured), white 2": _grey(frame.light / 2),
        "highlight: white 1, square root": _grey(np.sqrt(np.maximum(frame.layers["highlight"], 0))),
    }
    height, width = frame.image.shape[:2]
    sheet = np.full((2 * (height + _CAPTION) + _GAP, 3 * width + 2 * _GAP, 3), 32, dtype=np.uint8)
    for i, (caption, tile) in enumerate(tiles.items()):
        top, left = i // 3 * (height + _CAPTION + _GAP), i % 3 * (width + _GAP)
        sheet[top : top + height, left : left + width] = tile
        cv2.putText(sheet, caption, (left + 6, top + height + 17), _FONT, 0.5, (230, 230, 230), 1, cv2.LINE_AA)
    return sheet


def spread(total: int, count: int) -> set[int]:
    """Up to ``count`` positions, evenly spread over ``total``."""
    return {round(float(place)) for place in np.linspace(0, total - 1, min(count, total))}


class ContactSheet:
    """A picture of up to ``count`` frames, labels drawn, evenly spread over the ``total`` of a dataset in ``root``."""

    def __init__(self, root: Path, total: int, *, count: int = 16) -> None:
        self._root = root
        self._chosen = spread(total, count)
        self._heard = 0
        self._tiles: list[Image] = []

    def add(self, record: Record) -> None:
        """See the next frame.

        Raises:
            OSError: If its image cannot be read.
        """
        if self._heard in self._chosen:
            self._tiles.append(_tile(self._root, record))
        self._heard += 1

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
        write_file(path, lambda temporary: temporary.write_bytes(bytes(data)))


def _id_colours(ids: npt.NDArray[np.uint16]) -> Image:
    """Ids as the colours of as many classes, 0 as black, (H, W, 3)."""
    present, position = np.unique(ids, return_inverse=True)
    colours = np.array([class_colour(int(i)) if i else (0, 0, 0) for i in present], dtype=np.uint8)
    return np.asarray(colours[position].reshape(*ids.shape, 3))


def _grey(values: npt.NDArray[np.floating[Any]]) -> Image:
    return np.asarray(np.rint(255 * np.clip(values, 0, 1)), dtype=np.uint8)


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
