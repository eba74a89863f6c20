"""Boxes as in Pascal VOC: one XML file per image, read by CVAT, FiftyOne and detectors of every age.

::

    voc/Annotations/000003.xml, voc/JPEGImages/000003.jpg, voc/ImageSets/Main/train.txt, val.txt, voc/labelmap.txt

``labelmap.txt`` names the classes to CVAT, which knows VOC's own twenty otherwise. Pixels count from 1, and boxes
include their last (VOC2012 development kit, ``VOCevaldet``). The flags follow the 2009 annotation guidelines: an object
is *truncated* if more than 15 % of it lies outside the box of what is visible, *occluded* if more than 5 % of what lies
in that box is hidden. Both are exact here.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from mitsplat.files import SPLITS, Record, write_text
from mitsplat.label import InstanceLabel, Labels

TRUNCATED, OCCLUDED = 0.15, 0.05
"""Shares of an object above which its flags are set."""


def annotation(labels: Labels, image: str) -> str:
    """The XML file of an image by that name."""
    root = ElementTree.Element("annotation")
    size = {"width": labels.width, "height": labels.height, "depth": 3}
    for name, value in {"folder": "JPEGImages", "filename": image, "size": size, "segmented": 0}.items():
        _add(root, name, value)
    for label in labels.instances:
        x0, y0, x1, y1 = label.box
        truncated, occluded = flags(label)
        entry = {
            "name": label.class_name,
            "pose": "Unspecified",
            "truncated": int(truncated),
            "difficult": 0,
            "occluded": int(occluded),
            "bndbox": {"xmin": x0 + 1, "ymin": y0 + 1, "xmax": x1, "ymax": y1},
        }
        _add(root, "object", entry)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def flags(label: InstanceLabel) -> tuple[bool, bool]:
    """Whether an instance is truncated, and whether it is occluded."""
    x0, y0, x1, y1 = label.box
    left, top = label.amodal.box[:2]
    boxed = int(label.amodal.mask[y0 - top : y1 - top, x0 - left : x1 - left].sum())
    return 1 - boxed / label.silhouette_area > TRUNCATED, 1 - label.area / boxed > OCCLUDED


def write_description(root: Path, records: Iterable[Record], class_names: Iterable[str]) -> None:
    """Write which images belong to which split, and what classes there are."""
    names: dict[str, list[str]] = {split: [] for split in SPLITS}
    for record in records:
        names[record["split"]].append(f"{record['index']:06d}\n")
    for split, lines in names.items():
        write_text(root / f"voc/ImageSets/Main/{split}.txt", "".join(lines))
    lines = ["# label:color_rgb:parts:actions\n", *(f"{name}:::\n" for name in ("background", *class_names))]
    write_text(root / "voc/labelmap.txt", "".join(lines))


def _add(parent: ElementTree.Element, name: str, value: object) -> None:
    child = ElementTree.SubElement(parent, name)
    if isinstance(value, dict):
        for key, inner in value.items():
            _add(child, key, inner)
    else:
        child.text = str(value)
