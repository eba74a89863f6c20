"""One annotation of a COCO file to a labelled object, with checks of its box and segmentation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask

from mitsplat.arrays import Float64Array
from mitsplat.detector.labelled_sets.labelled_set import LabelledObject, ascii_rle, clip_points
from mitsplat.errors import InputError
from mitsplat.images.masks import decode_rle
from mitsplat.storage.files import JsonObject

_BOX_TOLERANCE = 2.0
"""Largest difference of a box from the bounds of its segmentation at which both are the same [px]."""
_MAX_RUN_BITS = 64
"""Largest number of bits of a run length; longer ones would take a time with the square of their length to read."""
_MAX_BEYOND = 0.25
"""Largest distance by which a segmentation leaves its box, as a share of the sides of the box."""


def read_annotation(annotation: JsonObject, class_index: int, size: tuple[int, int], path: Path) -> LabelledObject:
    """Return the labelled object of an annotation in an image of this width and height [px].

    Raises:
        InputError: If the box or the segmentation is malformed or outside the image, or both disagree. The error names
            the file ``path`` and the annotation.
    """
    place = f"{path}: annotation {annotation.get('id')}"
    try:
        x, y, w, h = (float(value) for value in annotation["bbox"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{place}: bbox must be x, y, width, height (got {annotation.get('bbox')})") from error
    corners = clip_points(np.array([[x, y], [x + w, y + h]]), size, f"{place}: bbox")
    (x0, y0), (x1, y1) = corners.tolist()
    if not (x1 > x0 and y1 > y0):
        raise InputError(f"{place}: bbox must have a width and a height (got {annotation['bbox']})")
    rle = None
    if annotation.get("segmentation"):
        try:
            rle = _read_segmentation(annotation["segmentation"], size, place)
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, IndexError, ArithmeticError) as error:
            raise InputError(f"{place}: segmentation must be polygons or run lengths ({error})") from error
        _check_box_of_mask(np.array([x, y, w, h]), corners, rle, place)
    else:
        _check_box_alone(annotation, np.array([x, y, w, h]), place)
    crowd = annotation.get("iscrowd") or 0
    if crowd not in (0, 1):
        raise InputError(f"{place}: iscrowd must be 0 or 1 (got {crowd!r})")
    return LabelledObject(class_index, (x0, y0, x1, y1), None, None if rle is None else ascii_rle(rle), bool(crowd))


def _read_segmentation(given: Any, size: tuple[int, int], place: str) -> JsonObject:
    """Return polygons, or compressed or plain run lengths, as COCO's compressed run-length code.

    Raises:
        InputError: If the polygons leave the image, the run lengths are of another size, or no pixel is covered. Other
            malformed values raise the errors of pycocotools and Python.
    """
    width, height = size
    if isinstance(given, list):
        if not all(isinstance(part, list) for part in given):
            raise InputError(f"{place}: segmentation must be a list of polygons (got a list of numbers)")
        for part in given:
            if len(part) < 6 or len(part) % 2:
                raise InputError(
                    f"{place}: segmentation must be polygons of 3 points or more (got {len(part)} numbers)"
                )
            clip_points(np.array(part, dtype=np.float64).reshape(-1, 2), size, f"{place}: segmentation")
        rle = coco_mask.merge(coco_mask.frPyObjects(given, height, width))
    elif list(given["size"]) != [height, width]:
        raise InputError(f"{place}: segmentation must be of {height} x {width} px (got {given['size']})")
    else:
        lengths = given["counts"] if isinstance(given["counts"], list) else _run_lengths(str(given["counts"]))
        if sum(lengths) != height * width or min(lengths) < 0:  # decoding would invent the missing pixels
            raise InputError(
                f"{place}: run lengths must be of {height} x {width} px, {height * width} (got {sum(lengths)})"
            )
        rle = coco_mask.frPyObjects({"size": [height, width], "counts": lengths}, height, width)
    if not decode_rle(rle).any():
        raise InputError(f"{place}: segmentation must cover a pixel")
    return dict(rle)


def _check_box_of_mask(box: Float64Array, corners: Float64Array, rle: JsonObject, place: str) -> None:
    """Check that a box as x, y, width, height, whose clipped corners are given, encloses its mask.

    Raises:
        InputError: If it does not. If the box fits the mask in another form than COCO's, the error names this form.
    """
    x, y, w, h = coco_mask.toBbox(rle).tolist()
    span, got = f"spans [{x:g}, {y:g}, {w:g}, {h:g}]", f"[{', '.join(f'{value:g}' for value in box)}]"
    forms = {
        "": (x, y, w, h),
        "its two corners": (x, y, x + w, y + h),
        "its centre and size": (x + w / 2, y + h / 2, w, h),
    }
    form = next((name for name, other in forms.items() if np.abs(box - other).max() <= _BOX_TOLERANCE), "")
    if form:
        raise InputError(
            f"{place}: bbox must be x, y, width, height, not {form} (got {got} for a segmentation that {span})"
        )
    (x0, y0), (x1, y1) = corners.tolist()
    beyond = max((x0 - x) / (x1 - x0), (x + w - x1) / (x1 - x0), (y0 - y) / (y1 - y0), (y + h - y1) / (y1 - y0))
    outside = max(x0 - x, x + w - x1, y0 - y, y + h - y1)
    if outside > _BOX_TOLERANCE and beyond > _MAX_BEYOND:
        raise InputError(
            f"{place}: bbox must enclose its segmentation, which {span} (got {got}): are run lengths stored by rows, "
            "or is the box that of another object?"
        )


def _check_box_alone(annotation: JsonObject, box: Float64Array, place: str) -> None:
    """Check the rotation and the area that an annotation without segmentation states for its box.

    Raises:
        InputError: If the box is rotated, or if its area is that of its two corners.
    """
    attributes, area, (x, y, w, h) = annotation.get("attributes"), annotation.get("area"), box.tolist()
    if isinstance(attributes, dict) and (turn := attributes.get("rotation")):
        raise InputError(f"{place}: bbox must not be rotated (got rotation {turn}): export masks or polygons")
    own, corners = (isinstance(area, int | float) and abs(a - area) <= 0.02 * area for a in (w * h, (w - x) * (h - y)))
    if corners and not own:
        raise InputError(
            f"{place}: bbox must be x, y, width, height, not its two corners (got {annotation['bbox']}, area {area})"
        )


def is_fraction(box: object) -> bool:
    """Return True if a box has no value above 1."""
    return (
        isinstance(box, list) and len(box) == 4 and all(isinstance(value, int | float) and value <= 1 for value in box)
    )


def _run_lengths(code: str) -> list[int]:
    """Return the run lengths of COCO's compressed mask code.

    Each character has five value bits. From the third run on, the code stores the difference to the run two before.
    """
    lengths: list[int] = []
    value = shift = 0
    for letter in code:
        bits = ord(letter) - 48
        value |= (bits & 31) << shift
        shift += 5
        if shift > _MAX_RUN_BITS:
            raise ValueError("a run length has too many characters")
        if not bits & 32:
            value -= (bits & 16) << (shift - 4)
            lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
            value = shift = 0
    return lengths
