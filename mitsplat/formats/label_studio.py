"""Tasks for Label Studio, where people inspect and correct labels; masks are exact brush strokes.

::

    label-studio/config.xml                 labelling interface, to be pasted into the settings of a project
    label-studio/<split>/000003.json        task: the picture, and a region for every instance

Label Studio serves pictures from its own machine if it is started with
``LABEL_STUDIO_LOCAL_FILES_SERVING_ENABLED=true`` and ``LABEL_STUDIO_LOCAL_FILES_DOCUMENT_ROOT`` set to the dataset's
folder. The tasks name the pictures relative to that folder.

A brush stroke is an RGBA picture of the image's size in the run-length code of ``@thi.ng/rle-pack``, as a list of bytes
(``label_studio_sdk.converter.brush``). The header has 32 bits for the number of values, 5 bits for the bits per value
minus 1, and four times 4 bits for the bits per count minus 1. Each following block has one bit that marks a repeated
value, two bits that select one of the four count sizes, the count minus 1, and the value.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mitsplat.arrays import BoolArray
from mitsplat.formats.format import Catalogue, FrameFiles
from mitsplat.labels.labels import InstanceLabel
from mitsplat.storage.files import Record, write_text

_COUNT_BITS = (3, 4, 8, 16)
"""Bits of counts, as in Label Studio's own encoder."""
_CHANNELS = 4


def write(files: FrameFiles) -> None:
    """Write a frame's task."""
    size = files.frame.labels.width, files.frame.labels.height
    regions = [region(label, size) for label in files.frame.labels.instances]
    task = {
        "data": {"image": f"/data/local-files/?d={files.image}", "frame": files.frame.index},
        "annotations": [{"result": regions}],
    }
    files.add_bytes(f"label-studio/{files.name}.json", json.dumps(task).encode())


def region(label: InstanceLabel, size: tuple[int, int]) -> dict[str, Any]:
    """Return the region of an instance in an image of this width and height; its id contains the instance id."""
    width, height = size
    mask = np.zeros((height, width), dtype=bool)
    x0, y0, x1, y1 = label.box
    mask[y0:y1, x0:x1] = label.mask
    return {
        "id": f"instance-{label.id}",
        "type": "brushlabels",
        "from_name": "label",
        "to_name": "image",
        "original_width": width,
        "original_height": height,
        "image_rotation": 0,
        "value": {"format": "rle", "rle": encode_brush(mask), "brushlabels": [label.class_name]},
    }


def encode_brush(mask: BoolArray) -> list[int]:
    """Encode a mask (H, W) as the bytes of a brush stroke."""
    values = mask.ravel()
    starts = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1])
    counts = np.diff(np.append(starts, values.size)) * _CHANNELS
    most = 1 << _COUNT_BITS[-1]
    bits = [f"{values.size * _CHANNELS:032b}", f"{8 - 1:05b}", *(f"{size - 1:04b}" for size in _COUNT_BITS)]
    for count, is_set in zip(counts.tolist(), values[starts].tolist(), strict=True):
        for left in range(count, 0, -most):
            repeated = min(left, most) - 1
            which, size = next((i, size) for i, size in enumerate(_COUNT_BITS) if repeated < 1 << size)
            bits.append(f"1{which:02b}{repeated:0{size}b}{255 * is_set:08b}")
    code: list[int] = np.packbits(np.frombuffer("".join(bits).encode(), dtype=np.uint8) - ord("0")).tolist()
    return code


class ConfigWriter:
    """Writer of ``config.xml``."""

    def __init__(self, root: Path, catalogue: Catalogue) -> None:
        self._path, self._class_names = root / "label-studio/config.xml", catalogue.class_names

    def add(self, record: Record) -> None:
        """Do nothing; the interface is the same for every frame."""

    def commit(self) -> None:
        """Write the file."""
        view = ElementTree.Element("View")
        ElementTree.SubElement(view, "Image", name="image", value="$image", zoom="true")
        labels = ElementTree.SubElement(view, "BrushLabels", name="label", toName="image")
        for name in self._class_names:
            ElementTree.SubElement(labels, "Label", value=name)
        ElementTree.indent(view)
        write_text(self._path, ElementTree.tostring(view, encoding="unicode") + "\n")

    def discard(self) -> None:
        """Do nothing; the file is written only by ``keep``."""
