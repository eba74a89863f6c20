"""Overlay of labels on their image."""

from __future__ import annotations

import colorsys
import math

import cv2
import numpy as np

from mitsplat.arrays import ByteImage
from mitsplat.labels.labels import InstanceLabel, Labels

_FONT = cv2.FONT_HERSHEY_SIMPLEX
OPACITY = 0.45
"""Opacity of drawn masks."""


def class_colour(class_index: int) -> tuple[int, int, int]:
    """Return the colour of a class, RGB in [0, 255]; hues are spaced by the golden ratio, so that neighbours differ."""
    hue = (0.11 + class_index * (math.sqrt(5) - 1) / 2) % 1
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.85, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_labels(image: ByteImage, labels: Labels) -> ByteImage:
    """Return an RGB image (H, W, 3) with the masks, outlines, boxes and class names of its instances."""
    drawn = image.copy()
    unit = max(1.0, image.shape[1] / 640)
    for label in labels.instances:
        x0, y0, x1, y1 = label.box
        view = drawn[y0:y1, x0:x1]
        colour = np.array(class_colour(label.class_index))
        view[label.mask] = np.rint((1 - OPACITY) * view[label.mask] + OPACITY * colour)
    for label in labels.instances:
        _draw_edges(drawn, label, unit)
    for label in labels.instances:  # names last, so that nothing covers them
        _draw_name(drawn, label, unit)
    return drawn


def _draw_edges(image: ByteImage, label: InstanceLabel, unit: float) -> None:
    """Draw the outline and the box of a label into an image; ``unit`` is the width of a line [px]."""
    x0, y0, x1, y1 = label.box
    colour = class_colour(label.class_index)
    contours, _ = cv2.findContours(label.mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, colour, max(1, round(unit / 2)), offset=(x0, y0))
    cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), colour, max(1, round(unit)))


def _draw_name(image: ByteImage, label: InstanceLabel, unit: float) -> None:
    """Draw the class name of a label above its box into an image; ``unit`` is the width of a line [px]."""
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
