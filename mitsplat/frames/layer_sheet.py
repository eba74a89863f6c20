"""Contact sheet of a frame's layers for visual inspection."""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import ByteImage, FloatingArray
from mitsplat.frames.frame import Frame
from mitsplat.labels.overlay import class_colour, draw_labels

LayerName = Literal["picture", "labels", "ids", "depth", "light", "highlight"]
LAYERS: tuple[LayerName, ...] = get_args(LayerName)

_CAPTION = 24
_GAP = 6


def layer_sheet(frame: Frame) -> ByteImage:
    """Draw a frame's picture, labels, ids, depth, light and highlight in a captioned grid, RGB (H, W, 3)."""
    tiles = [draw_layer(frame, name) for name in LAYERS]
    height, width = frame.image.shape[:2]
    sheet = np.full((2 * (height + _CAPTION) + _GAP, 3 * width + 2 * _GAP, 3), 32, dtype=np.uint8)
    for number, (caption, tile) in enumerate(tiles):
        top, left = number // 3 * (height + _CAPTION + _GAP), number % 3 * (width + _GAP)
        sheet[top : top + height, left : left + width] = tile
        place, font, colour = (left + 6, top + height + 17), cv2.FONT_HERSHEY_SIMPLEX, (230, 230, 230)
        cv2.putText(sheet, caption, place, font, 0.5, colour, 1, cv2.LINE_AA)
    return sheet


def draw_layer(frame: Frame, name: LayerName) -> tuple[str, ByteImage]:
    """Draw one of :data:`LAYERS`; return its caption and an RGB picture (H, W, 3)."""
    if name == "picture":
        return name, frame.image
    if name == "labels":
        return f"labels: {len(frame.labels.instances)} instances", draw_labels(frame.image, frame.labels)
    if name == "ids":
        return "ids by splats", _id_colours(frame.instance)
    if name == "light":
        return "light: black 0, grey 1 (colour unchanged), white 2", _grey(frame.layers.light / 2)
    if name == "highlight":
        return "highlight: white 1, square root", _grey(np.sqrt(np.maximum(frame.layers.highlight, 0)))
    known = frame.depth[frame.depth > 0]
    near, far = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    share = np.clip((frame.depth - near) / max(far - near, 1e-9), 0, 1)
    depth = cv2.applyColorMap(np.rint(255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return f"depth: {near:.3g} to {far:.3g} m", np.where(frame.depth[..., None] > 0, depth, 0).astype(np.uint8)


def _id_colours(ids: npt.NDArray[np.uint16]) -> ByteImage:
    """Map ids to class colours and 0 to black, (H, W, 3)."""
    present, position = np.unique(ids, return_inverse=True)
    colours = np.array([class_colour(int(i)) if i else (0, 0, 0) for i in present], dtype=np.uint8)
    return np.asarray(colours[position].reshape(*ids.shape, 3))


def _grey(values: FloatingArray) -> ByteImage:
    return np.asarray(np.rint(255 * np.clip(values, 0, 1)), dtype=np.uint8)
