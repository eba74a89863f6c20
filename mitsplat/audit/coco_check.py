"""Audit of COCO annotations, panoptic segments and poses, frame by frame with the frames' own files.

Each check reads its file once, in parallel with the manifest and one image at a time, so memory use does not grow with
the number of images. Masks are decoded by pycocotools. Files of up to :data:`MAX_COCO_BYTES` are also opened by its
``COCO`` class.
"""

from __future__ import annotations

import contextlib
import io
import itertools
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO

from mitsplat.audit.dataset_check import (
    FRACTION_TOLERANCE,
    DatasetCheck,
    EntryCursor,
    Violation,
    Violations,
    are_objects,
    compare_keys,
    is_close,
    prefixed,
)
from mitsplat.audit.decoded_frame import DecodedFrame, DecodedInstance, bounds_of
from mitsplat.audit.picture_check import segment_picture
from mitsplat.images.masks import Box, decode_rle
from mitsplat.storage.files import JsonObject
from mitsplat.storage.json_stream import read_entries

MAX_COCO_BYTES = 32 << 20
"""Maximum size of a file that is also opened by pycocotools, which needs ten times as much memory."""
_MAX_LISTED = 65535
"""Maximum number of classes or categories that are read."""


class AnnotationFile:
    """Annotation file with ``images``, annotations by image, and categories.

    Args:
        root: Dataset folder.
        file: File, relative to the dataset.

    Attributes:
        counts: Numbers of the images and annotations that were read.
    """

    def __init__(self, root: Path, file: str) -> None:
        self.file, self._path = file, root / file
        self.counts = {"images": 0, "annotations": 0}
        self._categories: list[object] = []
        self._images = EntryCursor(file, self._read("images", "id"), "images")
        self._annotations = EntryCursor(file, self._read("annotations", "image_id"))

    def _read(self, name: str, index: str) -> Iterator[tuple[int, JsonObject]]:
        """Yield the elements of a list by frame index; store the categories while the annotations are read."""
        for key, value in read_entries(self._path, split_lists=True):
            if key == name:
                self.counts[name] += 1
                yield int(value[index]), value
            elif name == "images" and self.counts[name]:
                return  # the other cursor reads the rest
            elif name == "annotations" and key == "categories" and len(self._categories) <= _MAX_LISTED:
                self._categories.append(value)

    @property
    def is_broken(self) -> bool:
        """True if the file cannot be read further."""
        return self._images.broken or self._annotations.broken

    def annotations_of(self, frame: DecodedFrame) -> Generator[Violation, None, list[JsonObject]]:
        """Check the image of a frame and return the frame's annotations; the list is empty after a read error."""
        width, height = frame.size
        expected = {"id": frame.index, "file_name": frame.image_name, "width": width, "height": height}
        for image in (yield from self._images.entry_of(frame)) if not self.is_broken else ():
            yield from prefixed(self.file, f"image {frame.index}", compare_keys(image, expected))
        return (yield from self._annotations.entries_of(frame)) if not self.is_broken else []

    def finish(self, categories: list[JsonObject]) -> Violations:
        """Yield the violations in the remaining entries and in the categories."""
        for cursor in (self._images, self._annotations):
            if not self.is_broken:
                yield from cursor.finish()
        if self.is_broken:
            return
        if len(self._categories) != len(categories):
            yield self.file, f"categories: there are {len(self._categories)}, not {len(categories)}"
            return
        for number, (found, expected) in enumerate(zip(self._categories, categories, strict=True)):
            yield from prefixed(self.file, f"categories[{number}]", compare_keys(found, expected))


class InstancesCheck(DatasetCheck):
    """Check of ``instances_<split>.json``, ``polygons_<split>.json`` or ``amodal_<split>.json``."""

    def __init__(self, root: Path, content: JsonObject, name: str, split: str) -> None:
        self._split, self._content, self._amodal = split, content, name == "amodal"
        self._polygons = name == "polygons"
        self._annotations = AnnotationFile(root, f"annotations/{name}_{split}.json")
        self._path, self._last_id = root / self._annotations.file, 0

    def check(self, frame: DecodedFrame) -> Violations:
        """Compare the annotations of a frame with its masks."""
        if frame.split != self._split:
            return
        file, found = self._annotations.file, (yield from self._annotations.annotations_of(frame))
        if self._annotations.is_broken:
            return
        if len(found) != len(frame.instances):
            yield file, f"image {frame.index} has {len(found)} annotations for {len(frame.instances)} instances"
            return
        for label, entry in zip(frame.instances, found, strict=True):
            yield from prefixed(file, f"image {frame.index}, {label.name}", self._check(frame, label, entry))

    def _check(self, frame: DecodedFrame, label: DecodedInstance, entry: JsonObject) -> Iterator[str]:
        number = entry.get("id")
        if not isinstance(number, int) or number <= self._last_id:
            yield f"id {number} is not above those before it"
        else:
            self._last_id = number
        code = entry.get("segmentation")
        if self._polygons:
            code = _decode_polygons(frame, code)
        if code is None:
            yield "segmentation is no mask that pycocotools reads"
        else:
            yield from _check_segmentation(frame, label, code, amodal=self._amodal)
        if self._amodal:
            yield from _check_segmentation(frame, label, entry.get("visible_segmentation"), amodal=False)
        expected = {
            "category_id": label.class_index + 1,
            "bbox": coco_box(label.amodal_box if self._amodal else label.box),
            "area": label.amodal_area if self._amodal else label.area,
            "iscrowd": 0,
            "marks": label.entry["marks"],
        }
        if self._content["keypoints"][label.class_index]:
            points = label.entry["keypoints"]
            expected["keypoints"] = [value for point in points for value in point]
            expected["num_keypoints"] = sum(bool(visibility) for _, _, visibility in points)
        yield from compare_keys(entry, expected)
        fractions = {"visible_fraction": label.visible_fraction, "truncation": label.truncation}
        for key, fraction in fractions.items():
            if not is_close(entry.get(key), fraction, FRACTION_TOLERANCE):
                yield f"{key} is {entry.get(key)}, not {fraction:.6f}"

    def finish(self) -> Violations:
        """Check the remaining entries and the categories, and read the file with pycocotools."""
        points = self._content["keypoints"]
        categories = [
            {"id": number, "name": name} | ({"keypoints": points[number - 1]} if points[number - 1] else {})
            for number, name in enumerate(self._content["classes"], start=1)
        ]
        yield from self._annotations.finish(categories)
        if self._annotations.is_broken or self._path.stat().st_size > MAX_COCO_BYTES:
            return
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                coco = COCO(self._path)
                coco.info()
            counts = {"images": len(coco.imgs), "annotations": len(coco.anns)}
        except Exception as error:  # noqa: BLE001 - users of the file get the same error
            yield self._annotations.file, f"cannot be read by pycocotools ({type(error).__name__}: {error})"
        else:
            if counts != self._annotations.counts:
                yield self._annotations.file, f"has {self._annotations.counts}, but pycocotools reads {counts}"


class PanopticCheck(DatasetCheck):
    """Check of ``panoptic_<split>.json``, which is compared with the segment pictures."""

    def __init__(self, root: Path, content: JsonObject, split: str) -> None:
        self._split, self._content = split, content
        self._annotations = AnnotationFile(root, f"annotations/panoptic_{split}.json")

    def check(self, frame: DecodedFrame) -> Violations:
        """Compare the segments of a frame with its segment picture."""
        if frame.split != self._split:
            return
        file, found = self._annotations.file, (yield from self._annotations.annotations_of(frame))
        if len(found) == 1:
            yield from prefixed(file, f"image {frame.index}", self._check(frame, found[0]))
        elif not self._annotations.is_broken:
            yield file, f"image {frame.index} has {len(found)} entries"

    def _check(self, frame: DecodedFrame, entry: JsonObject) -> Iterator[str]:
        name = f"{frame.index:06d}.png"
        yield from compare_keys(entry, {"file_name": name})
        picture = frame.root / f"panoptic/{frame.split}/{name}"
        ids = segment_picture(frame, picture) if picture.is_file() else None
        if ids is None:
            return  # reported by the check of that file
        stated = entry.get("segments_info")
        if not are_objects(stated) or not all(isinstance(segment.get("id"), int) for segment in stated):
            yield "segments_info must be a list of segments with whole numbers as ids"
            return
        segments = {segment["id"]: segment for segment in stated}
        present = {int(number) for number in np.unique(ids)} - {0}
        if set(segments) != present or len(segments) != len(stated):
            yield f"its segments are {sorted(segments, key=str)}, those of its picture {sorted(present)}"
            return
        categories: dict[object, int] = {label.id: label.class_index + 1 for label in frame.instances}
        environment = len(self._content["classes"]) + 1
        for number, segment in segments.items():
            mask = ids == number
            expected = {
                "category_id": categories.get(number, environment),
                "bbox": coco_box(bounds_of(mask)),
                "area": int(np.count_nonzero(mask)),
                "iscrowd": 0,
            }
            yield from (f"segment {number}: {text}" for text in compare_keys(segment, expected))

    def finish(self) -> Violations:
        """Check the remaining entries and the categories."""
        classes = self._content["classes"]
        categories = [{"id": number, "name": name, "isthing": 1} for number, name in enumerate(classes, start=1)]
        categories.append({"id": len(classes) + 1, "name": "environment", "isthing": 0})
        yield from self._annotations.finish(categories)


class PosesCheck(DatasetCheck):
    """Check of ``poses_<split>.json``: cameras, and object poses in the camera and world frames."""

    def __init__(self, root: Path, content: JsonObject, split: str) -> None:
        self._split, self._content = split, content
        self._classes: list[object] = []
        file = f"annotations/poses_{split}.json"
        self._frames = EntryCursor(file, self._read(root / file))

    def _read(self, path: Path) -> Iterator[tuple[int, JsonObject]]:
        for key, value in read_entries(path, split_lists=True):
            if key == "frames":
                yield int(value["id"]), value
            elif key == "classes" and len(self._classes) <= len(self._content["classes"]):
                self._classes.append(value)

    def check(self, frame: DecodedFrame) -> Violations:
        """Compare an entry with the frame's poses and its camera, whose pose is inverted independently."""
        for entry in (yield from self._frames.entry_of(frame)) if frame.split == self._split else ():
            yield from prefixed(self._frames.file, f"frame {frame.index}", self._check(frame, entry))

    def _check(self, frame: DecodedFrame, entry: JsonObject) -> Iterator[str]:
        width, height = frame.size
        image = {"file_name": frame.image_name, "width": width, "height": height, "camera": frame.record["camera"]}
        yield from compare_keys(entry, image)
        found = entry.get("instances")
        if not are_objects(found) or len(found) != len(frame.instances):
            yield f"must have {len(frame.instances)} instances"
            return
        for label, instance in zip(frame.instances, found, strict=True):
            expected = {
                "id": label.id,
                "class": self._content["classes"][label.class_index],
                "object": label.entry["asset"],
                "asset": self._content["assets"][label.entry["asset"]],
            }
            yield from (f"{label.name}: {text}" for text in compare_keys(instance, expected))
            poses = {"world_from_object": label.pose, "camera_from_object": frame.camera_from_world @ label.pose}
            for key, pose in poses.items():
                if not is_close(instance.get(key), pose):
                    yield f"{label.name}: {key} differs from the manifest's poses"

    def finish(self) -> Violations:
        """Check the remaining entries and the classes."""
        yield from self._frames.finish()
        if not self._frames.broken and self._classes != self._content["classes"]:
            yield self._frames.file, f"classes are {self._classes[:20]}, not {self._content['classes'][:20]}"


def _decode_polygons(frame: DecodedFrame, polygons: object) -> object:
    """Return the run-length code of a union of polygons, as pycocotools fills them; None if they are invalid."""
    width, height = frame.size
    if not isinstance(polygons, list) or not polygons or not all(_is_polygon(one, frame.size) for one in polygons):
        return None
    code = coco_mask.merge(coco_mask.frPyObjects(polygons, height, width))
    return {"size": code["size"], "counts": code["counts"].decode("ascii")}


def _is_polygon(points: object, size: tuple[int, int]) -> bool:
    """Return True for a list of at least three points in the image; pycocotools may crash on other numbers."""
    if not isinstance(points, list) or not all(isinstance(value, int | float) for value in points):
        return False
    if len(points) < 6 or len(points) % 2:
        return False
    return all(0 <= value <= side for value, side in zip(points, itertools.cycle(size), strict=False))


def _check_segmentation(frame: DecodedFrame, label: DecodedInstance, code: object, *, amodal: bool) -> Iterator[str]:
    width, height = frame.size
    name = "segmentation" if amodal else "segmentation of visible pixels"
    if not isinstance(code, dict) or code.get("size") != [height, width] or not isinstance(code.get("counts"), str):
        yield f"{name} is not a run-length code of {width}x{height} px"
        return
    expected = frame.full_mask(label, amodal=amodal)
    try:
        mask = decode_rle(code).astype(bool)
        box = coco_mask.toBbox(code).tolist()
    except Exception as error:  # noqa: BLE001 - pycocotools raises various types
        yield f"{name} cannot be decoded by pycocotools ({error})"
        return
    if (mask != expected).any():
        iou = np.count_nonzero(mask & expected) / np.count_nonzero(mask | expected)
        yield f"{name} differs from its mask (IoU {iou:.4f})"
    elif box != coco_box(bounds_of(expected)):
        yield f"{name} has the box {box} in pycocotools"


def coco_box(box: Box) -> list[int]:
    """Convert bounds to COCO's x, y, width and height."""
    x0, y0, x1, y1 = box
    return [x0, y0, x1 - x0, y1 - y0]
