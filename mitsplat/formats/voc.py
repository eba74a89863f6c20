"""Boxes in Pascal VOC format: one XML file per image, read by CVAT, FiftyOne and many old and new detectors.

::

    voc/Annotations/000003.xml, voc/JPEGImages/000003.jpg, voc/ImageSets/Main/train.txt, val.txt, voc/labelmap.txt

``labelmap.txt`` defines the classes for CVAT, which assumes the twenty classes of VOC otherwise. Pixels count from 1,
and boxes include their last pixel (VOC2012 development kit, ``VOCevaldet``). The flags follow the 2009 annotation
guidelines. An object is *truncated* if more than 15 % of it lies outside the box of its visible part. It is *occluded*
if more than 5 % of its part in that box is hidden. Both are exact here.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from mitsplat.formats.format import Catalogue, FrameFiles
from mitsplat.labels.labels import InstanceLabel, Labels
from mitsplat.storage.files import GrowingFile, Record

TRUNCATED, OCCLUDED = 0.15, 0.05
"""Fractions of an object above which its flags are set."""


def write(files: FrameFiles) -> None:
    """Write a frame's XML file, and add its picture under a second name."""
    files.add_image(f"voc/JPEGImages/{files.image_name}")
    files.add_bytes(f"voc/Annotations/{files.number}.xml", annotation(files.frame.labels, files.image_name).encode())


def annotation(labels: Labels, image: str) -> str:
    """Return the XML file of an image with the given name."""
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
    """Return the flags *truncated* and *occluded* of an instance."""
    x0, y0, x1, y1 = label.box
    left, top = label.amodal.box[:2]
    boxed = int(label.amodal.mask[y0 - top : y1 - top, x0 - left : x1 - left].sum())
    # Products are exact, whereas 1 - 95/100 is rounded to more than 0.05.
    beyond, hidden = label.silhouette_area - boxed, boxed - label.area
    return beyond > TRUNCATED * label.silhouette_area, hidden > OCCLUDED * boxed


class SetsWriter:
    """Writer of the image list of each split, and of the class list."""

    def __init__(self, root: Path, catalogue: Catalogue) -> None:
        self._files = {split: GrowingFile(root / f"voc/ImageSets/Main/{split}.txt") for split in catalogue.splits}
        self._classes = GrowingFile(root / "voc/labelmap.txt")
        names = ("background", *catalogue.class_names)
        self._classes.write("".join(["# label:color_rgb:parts:actions\n", *(f"{name}:::\n" for name in names)]))

    def add(self, record: Record) -> None:
        """Add a frame."""
        self._files[record["split"]].write(f"{record['index']:06d}\n")

    def commit(self) -> None:
        """Give the files their final names."""
        for file in (*self._files.values(), self._classes):
            file.commit()

    def discard(self) -> None:
        """Remove the files if they do not have their final names yet."""
        for file in (*self._files.values(), self._classes):
            file.discard()


def _add(parent: ElementTree.Element, name: str, value: object) -> None:
    child = ElementTree.SubElement(parent, name)
    if isinstance(value, dict):
        for key, inner in value.items():
            _add(child, key, inner)
    else:
        child.text = str(value)
