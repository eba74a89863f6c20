"""Audit of COCO annotations, panoptic segments and poses, frame by frame with the frames' own files.

Every reader reads its file once, in parallel with the manifest and one image at a time, so memory use does not grow
with the number of images. Masks are decoded by pycocotools. Files of up to :data:`WHOLE` bytes are also opened by its
``COCO`` class.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO

from mitsplat.audit.read_back import Violations, segment_picture
from mitsplat.audit.truth import Box, TrueFrame, TrueInstance, bounds_of
from mitsplat.images.masks import decode_rle
from mitsplat.storage.json_stream import read_lists

WHOLE = 32 << 20
"""Maximum size of a file that is also opened by pycocotools, which needs ten times as much memory [bytes]."""

_FRACTION_TOLERANCE = 1e-5
"""Tolerance of fractions that are stored with six decimals."""
_RELATIVE_TOLERANCE = 1e-9
"""Relative tolerance of poses and intrinsics, which are stored with full precision."""


class Reader(Protocol):
    """Reader of files that describe all frames, in parallel with the frames."""

    def check(self, frame: TrueFrame) -> Violations:
        """Yield the violations in the entries of the next frame."""

    def finish(self) -> Violations:
        """Yield the violations in the remaining entries, after all frames were checked."""


class Cursor:
    """Position in the entries of a file, by frame index; a read error is reported once as a violation.

    Args:
        file: File, relative to the dataset.
        entries: Frame index and entry of each, by ascending index.
    """

    def __init__(self, file: str, entries: Iterator[tuple[int, Any]]) -> None:
        self.file = file
        self._entries = entries
        self._next: tuple[int, Any] | None = None
        self._error = ""
        self.broken = False
        self._advance()

    def _advance(self) -> None:
        last = -1 if self._next is None else self._next[0]
        self._next = None
        try:
            self._next = next(self._entries, None)
            if self._next is not None and self._next[0] < last:
                raise ValueError(f"frame {self._next[0]} follows frame {last}")
        except FileNotFoundError:
            self._error = "is missing"
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            self._error = f"cannot be read ({type(error).__name__}: {error})"
        if self._error:
            self._next = None

    def take(self, index: int) -> Iterator[Any]:
        """Yield the entries of a frame; skipped entries of other frames become violations, see :meth:`errors`."""
        while self._next is not None and self._next[0] <= index:
            found, entry = self._next
            self._advance()
            if found == index:
                yield entry
            else:
                self._error = self._error or (
                    f"has an entry of frame {found}, which the manifest does not have at this position"
                )

    def errors(self) -> Violations:
        """Yield the errors so far; after an error, further entries may be missed."""
        if self._error:
            self.broken = True
            yield self.file, self._error
            self._error = ""

    def finish(self) -> Violations:
        """Yield the remaining errors, and a violation if entries are left."""
        yield from self.errors()
        if self._next is not None and not self.broken:
            yield self.file, f"has an entry of frame {self._next[0]}, which the manifest does not have at this position"
            list(self._entries_left())

    def _entries_left(self) -> Iterator[Any]:
        while self._next is not None:
            yield self._next
            self._advance()


class AnnotationFile:
    """Annotation file with ``images``, entries by image, and categories or classes.

    Args:
        root: Dataset folder.
        file: File, relative to the dataset.
        entries: Name of the list of entries, and key of the frame index in each entry.
    """

    def __init__(self, root: Path, file: str, entries: tuple[str, str]) -> None:
        self.file, self._path = file, root / file
        self.rest: dict[str, list[Any]] = {}
        self.counts = dict.fromkeys(("images", entries[0]), 0)
        self.images = Cursor(file, self._read("images", "id", keep=False))
        self.entries = Cursor(file, self._read(*entries, keep=True))

    def _read(self, name: str, index: str, *, keep: bool) -> Iterator[tuple[int, Any]]:
        """Yield the elements of a list by frame index; with ``keep``, also store the other lists, which are short."""
        for key, value in read_lists(self._path):
            if key == name:
                self.counts[name] += 1
                yield int(value[index]), value
            elif keep and key not in self.counts and len(self.rest.setdefault(key, [])) <= 65535:
                self.rest[key].append(value)
            elif not keep and self.counts[name]:
                return  # the other cursor reads the rest

    @property
    def broken(self) -> bool:
        """True if the file cannot be read further."""
        return self.images.broken or self.entries.broken

    def finish(self) -> Violations:
        """Yield the violations in the remaining entries."""
        for cursor in (self.images, self.entries):
            if not self.broken:
                yield from cursor.finish()

    def entries_of(self, frame: TrueFrame) -> Generator[tuple[str, str], None, list[Any]]:
        """Check the image of a frame and return the frame's entries; the list is empty after a read error."""
        yield from self.check_image(frame)
        if self.broken:
            return []
        found = list(self.entries.take(frame.index))
        yield from self.entries.errors()
        return found

    def check_image(self, frame: TrueFrame) -> Violations:
        """Yield the violations in the frame's image entry."""
        if self.broken:
            return
        images = list(self.images.take(frame.index))
        yield from self.images.errors()
        if self.broken:
            return
        width, height = frame.size
        expected = {"id": frame.index, "file_name": frame.image_name, "width": width, "height": height}
        if len(images) != 1:
            yield self.file, f"image {frame.index} is listed {len(images)} times"
        elif wrong := differing(images[0], expected):
            yield self.file, f"image {frame.index}: {wrong}"


class InstancesReader:
    """Reader of ``instances_<split>.json`` or ``amodal_<split>.json``."""

    def __init__(self, root: Path, content: Mapping[str, Any], name: str, split: str) -> None:
        self._split, self._content, self._amodal = split, content, name == "amodal"
        self._of = AnnotationFile(root, f"annotations/{name}_{split}.json", ("annotations", "image_id"))
        self._path, self._last = root / self._of.file, 0

    def check(self, frame: TrueFrame) -> Violations:
        """Compare the annotations of a frame with its masks."""
        if frame.split != self._split:
            return
        found = yield from self._of.entries_of(frame)
        if self._of.broken:
            return
        if len(found) != len(frame.instances):
            counts = f"{len(found)} annotations for {len(frame.instances)} instances"
            yield self._of.file, f"image {frame.index} has {counts}"
            return
        for label, entry in zip(frame.instances, found, strict=True):
            for text in self._check(frame, label, entry):
                yield self._of.file, f"image {frame.index}, {label.name}: {text}"

    def _check(self, frame: TrueFrame, label: TrueInstance, entry: Mapping[str, Any]) -> Iterator[str]:
        number = entry.get("id")
        if not isinstance(number, int) or number <= self._last:
            yield f"id {number} is not above those before it"
        else:
            self._last = number
        yield from _check_segmentation(frame, label, entry.get("segmentation"), amodal=self._amodal)
        if self._amodal:
            yield from _check_segmentation(frame, label, entry.get("visible_segmentation"), amodal=False)
        expected: dict[str, Any] = {
            "category_id": label.kind + 1,
            "bbox": coco_box(label.amodal_box if self._amodal else label.box),
            "area": label.amodal_area if self._amodal else label.area,
            "iscrowd": 0,
            "marks": label.entry["marks"],
        }
        if self._content["keypoints"][label.kind]:
            points = label.entry["keypoints"]
            expected["keypoints"] = [value for point in points for value in point]
            expected["num_keypoints"] = sum(bool(visibility) for _, _, visibility in points)
        if wrong := differing(entry, expected):
            yield wrong
        shares = {
            "visible_fraction": label.area / label.amodal_area,
            "truncation": 1 - label.amodal_area / label.silhouette_area,
        }
        for key, share in shares.items():
            if not is_close(entry.get(key), share, _FRACTION_TOLERANCE):
                yield f"{key} is {entry.get(key)}, not {share:.6f}"

    def finish(self) -> Violations:
        """Check the remaining entries and the categories, and read the file with pycocotools."""
        yield from self._of.finish()
        if self._of.broken:
            return
        points = self._content["keypoints"]
        expected = [
            {"id": number, "name": name} | ({"keypoints": points[number - 1]} if points[number - 1] else {})
            for number, name in enumerate(self._content["classes"], start=1)
        ]
        yield from _check_categories(self._of, expected)
        if self._path.stat().st_size <= WHOLE:
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    coco = COCO(self._path)
                read = {"images": len(coco.imgs), "annotations": len(coco.anns)}
            except Exception as error:  # noqa: BLE001 - users of the file get the same error
                yield self._of.file, f"cannot be read by pycocotools ({type(error).__name__}: {error})"
            else:
                if read != self._of.counts:
                    yield self._of.file, f"has {self._of.counts}, but pycocotools reads {read}"


class PanopticReader:
    """Reader of ``panoptic_<split>.json``, which is compared with the segment pictures."""

    def __init__(self, root: Path, content: Mapping[str, Any], split: str) -> None:
        self._split, self._content = split, content
        self._of = AnnotationFile(root, f"annotations/panoptic_{split}.json", ("annotations", "image_id"))

    def check(self, frame: TrueFrame) -> Violations:
        """Compare the segments of a frame with its segment picture."""
        if frame.split != self._split:
            return
        found = yield from self._of.entries_of(frame)
        if self._of.broken:
            return
        if len(found) != 1:
            yield self._of.file, f"image {frame.index} has {len(found)} entries"
            return
        for text in self._check(frame, found[0]):
            yield self._of.file, f"image {frame.index}: {text}"

    def _check(self, frame: TrueFrame, entry: Mapping[str, Any]) -> Iterator[str]:
        name = f"{frame.index:06d}.png"
        if wrong := differing(entry, {"file_name": name}):
            yield wrong
        picture = frame.root / f"panoptic/{frame.split}/{name}"
        ids = segment_picture(frame, picture) if picture.is_file() else None
        if ids is None:
            return  # reported by the check of that file
        kinds = {label.id: label.kind + 1 for label in frame.instances}
        stuff = len(self._content["classes"]) + 1
        stated = entry.get("segments_info")
        if not isinstance(stated, list) or not are_objects(stated):
            yield "segments_info must be a list of segments"
            return
        segments = {segment.get("id"): segment for segment in stated}
        present = {int(number) for number in np.unique(ids)} - {0}
        if set(segments) != present or len(segments) != len(stated):
            yield f"its segments are {sorted(segments, key=str)}, those of its picture {sorted(present)}"
            return
        for number, segment in segments.items():
            mask = ids == number
            expected = {
                "category_id": kinds.get(number, stuff),
                "bbox": coco_box(bounds_of(mask)),
                "area": int(np.count_nonzero(mask)),
                "iscrowd": 0,
            }
            if wrong := differing(segment, expected):
                yield f"segment {number}: {wrong}"

    def finish(self) -> Violations:
        """Check the remaining entries and the categories."""
        yield from self._of.finish()
        if not self._of.broken:
            names = [*self._content["classes"], "environment"]
            things = [1] * len(self._content["classes"]) + [0]
            expected = [
                {"id": number, "name": name, "isthing": thing}
                for number, (name, thing) in enumerate(zip(names, things, strict=True), start=1)
            ]
            yield from _check_categories(self._of, expected)


class PosesReader:
    """Reader of ``poses_<split>.json``: cameras, and object poses in the camera and world frames."""

    def __init__(self, root: Path, content: Mapping[str, Any], split: str) -> None:
        self._split, self._content = split, content
        self.file = f"annotations/poses_{split}.json"
        self._classes: list[Any] = []
        self._frames = Cursor(self.file, self._read(root / self.file))

    def _read(self, path: Path) -> Iterator[tuple[int, Any]]:
        for key, value in read_lists(path):
            if key == "frames":
                yield int(value["id"]), value
            elif key == "classes" and len(self._classes) <= len(self._content["classes"]):
                self._classes.append(value)

    def check(self, frame: TrueFrame) -> Violations:
        """Compare an entry with the frame's poses and its camera, whose pose is inverted independently."""
        if frame.split != self._split or self._frames.broken:
            return
        found = list(self._frames.take(frame.index))
        yield from self._frames.errors()
        if self._frames.broken:
            return
        if len(found) != 1:
            yield self.file, f"frame {frame.index} is listed {len(found)} times"
            return
        for text in self._check(frame, found[0]):
            yield self.file, f"frame {frame.index}{text}"

    def _check(self, frame: TrueFrame, entry: Mapping[str, Any]) -> Iterator[str]:
        width, height = frame.size
        image = {"file_name": frame.image_name, "width": width, "height": height, "camera": frame.record["camera"]}
        if wrong := differing(entry, image):
            yield f": {wrong}"
        found = entry.get("instances")
        if not isinstance(found, list) or not are_objects(found) or len(found) != len(frame.instances):
            yield f" must have {len(frame.instances)} instances"
            return
        for label, instance in zip(frame.instances, found, strict=True):
            expected = {
                "id": label.id,
                "class": self._content["classes"][label.kind],
                "object": label.entry["asset"],
                "asset": self._content["assets"][label.entry["asset"]],
            }
            if wrong := differing(instance, expected):
                yield f", {label.name}: {wrong}"
            poses = {"world_from_object": label.pose, "camera_from_object": frame.camera_from_world @ label.pose}
            for key, pose in poses.items():
                if not is_close(instance.get(key), pose):
                    yield f", {label.name}: {key} differs from the manifest's poses"

    def finish(self) -> Violations:
        """Check the remaining entries and the classes."""
        if not self._frames.broken:
            yield from self._frames.finish()
        if not self._frames.broken and self._classes != self._content["classes"]:
            yield self.file, f"classes are {self._classes[:20]}, not {self._content['classes'][:20]}"


def _check_segmentation(frame: TrueFrame, label: TrueInstance, code: Any, *, amodal: bool) -> Iterator[str]:
    width, height = frame.size
    name = "segmentation" if amodal else "segmentation of visible pixels"
    if not isinstance(code, dict) or code.get("size") != [height, width] or not isinstance(code.get("counts"), str):
        yield f"{name} is not a run-length code of {width}x{height} px"
        return
    truth = frame.full_mask(label, amodal=amodal)
    try:
        mask = decode_rle(code).astype(bool)
        box = coco_mask.toBbox(code).tolist()
    except Exception as error:  # noqa: BLE001 - pycocotools raises various types
        yield f"{name} cannot be decoded by pycocotools ({error})"
        return
    if (mask != truth).any():
        iou = np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth)
        yield f"{name} differs from its mask (IoU {iou:.4f})"
    elif box != coco_box(bounds_of(truth)):
        yield f"{name} has the box {box} in pycocotools"


def _check_categories(of: AnnotationFile, expected: list[dict[str, Any]]) -> Violations:
    found = of.rest.get("categories", [])
    if len(found) != len(expected):
        yield of.file, f"categories: there are {len(found)}, not {len(expected)}"
        return
    for number, (one, other) in enumerate(zip(found, expected, strict=True)):
        if wrong := differing(one, other):
            yield of.file, f"categories[{number}]: {wrong}"


def coco_box(box: Box) -> list[int]:
    """Convert bounds to COCO's x, y, width and height."""
    x0, y0, x1, y1 = box
    return [x0, y0, x1 - x0, y1 - y0]


def is_close(found: Any, expected: npt.ArrayLike, tolerance: float = _RELATIVE_TOLERANCE) -> bool:
    """Return True if a number or list read from a file equals the expected values within a relative tolerance."""
    truth = np.asarray(expected, dtype=np.float64)
    try:
        values = np.array(found, dtype=np.float64)
    except (ValueError, TypeError):
        return False
    scale = max(1.0, float(np.abs(truth).max(initial=0)))
    return values.shape == truth.shape and bool(np.all(np.abs(values - truth) <= tolerance * scale))


def are_objects(found: Any) -> bool:
    """Return True if a value read from a file is a list of objects."""
    return isinstance(found, list) and all(isinstance(entry, dict) for entry in found)


def differing(found: Any, expected: Mapping[str, Any]) -> str:
    """Describe the first key with an unexpected value; return an empty string if there is none."""
    if not isinstance(found, dict):
        return f"must be an object (got {str(found)[:40]})"
    for key, value in expected.items():
        if found.get(key) != value:
            return f"{key} is {str(found.get(key))[:80]}, not {str(value)[:80]}"
    return ""
