"""Audit of Label Studio tasks, with brush strokes in the run-length code of ``@thi.ng/rle-pack``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mitsplat.arrays import BoolArray
from mitsplat.audit.read_back import Violations
from mitsplat.audit.truth import TrueFrame
from mitsplat.storage.files import read_json


def check_task(frame: TrueFrame, path: Path) -> Iterator[str]:
    """Yield the violations in a frame's task."""
    try:
        task = read_json(path)
        image, regions = task["data"]["image"], task["annotations"][0]["result"]
        strokes = {region["id"]: decode_brush(region["value"]["rle"], frame.size) for region in regions}
    except (ValueError, KeyError, TypeError, IndexError) as error:
        yield f"cannot be read ({type(error).__name__}: {error})"
        return
    if image != f"/data/local-files/?d=images/{frame.split}/{frame.image_name}":
        yield f"its picture is {image}"
    if list(strokes) != [f"instance-{label.id}" for label in frame.instances]:
        yield f"has the regions {', '.join(strokes)[:80]}, not the frame's instances"
        return
    for label, region in zip(frame.instances, regions, strict=True):
        if region["value"].get("brushlabels") != [frame.content["classes"][label.kind]]:
            yield f"{label.name}: class is {region['value'].get('brushlabels')}"
        if [region.get("original_width"), region.get("original_height")] != list(frame.size):
            yield f"{label.name}: its region is of another size than the picture"
        wrong = np.count_nonzero(strokes[region["id"]] != frame.full_mask(label))
        if wrong:
            yield f"{label.name}: {wrong} pixels differ from its mask"


def decode_brush(code: list[int], size: tuple[int, int]) -> BoolArray:
    """Return the pixels (H, W) that a stroke sets in an image of this width and height.

    Raises:
        ValueError: If the list is no stroke of this size.
    """
    bits = "".join(f"{byte:08b}" for byte in code)
    at = 0

    def take(count: int) -> int:
        nonlocal at
        at += count
        if at > len(bits):
            raise ValueError("a stroke ends too early")
        return int(bits[at - count : at], 2)

    total, width = take(32), take(5) + 1
    sizes = [take(4) + 1 for _ in range(4)]
    if total != 4 * size[0] * size[1]:
        raise ValueError(f"a stroke has {total} values for an image of {size[0]}x{size[1]} px")
    values = np.empty(total, dtype=np.int64)
    done = 0
    while done < total:
        is_repeated = take(1)
        count = min(take(sizes[take(2)]) + 1, total - done)
        values[done : done + count] = take(width) if is_repeated else [take(width) for _ in range(count)]
        done += count
    alpha: BoolArray = values.reshape(size[1], size[0], 4)[..., 3] > 0
    return alpha


class ConfigReader:
    """Reader of ``config.xml``, which defines the classes for Label Studio."""

    def __init__(self, root: Path, content: Mapping[str, Any]) -> None:
        self._root, self._classes = root, content["classes"]

    def check(self, frame: TrueFrame) -> Violations:
        """Do nothing; the file contains no frames."""
        yield from ()

    def finish(self) -> Violations:
        """Check that its labels are the dataset's classes."""
        file = "label-studio/config.xml"
        try:
            tree = ElementTree.parse(self._root / file)
        except FileNotFoundError:
            yield file, "is missing"
        except (OSError, ElementTree.ParseError) as error:
            yield file, f"cannot be read ({error})"
        else:
            if [label.get("value") for label in tree.iter("Label")] != self._classes:
                yield file, "does not name the dataset's classes"
