"""COCO annotations from the records of a dataset's frames; image ids are frame indices, category ids class indices + 1.

``annotations/instances_<split>.json``
    Boxes, areas and run-length masks of the visible pixels, with the keypoints of assets that define some.
``annotations/polygons_<split>.json``
    The same with polygons along the edges of pixels (:func:`mitsplat.labels.polygons.pixel_polygons`) instead of
    run lengths, for tools that read only polygons.
``annotations/amodal_<split>.json``
    The same instances with their full silhouettes, hidden pixels included. ``visible_segmentation`` is the visible
    part.
``annotations/panoptic_<split>.json`` and ``panoptic/<split>/NNNNNN.png``
    Segment of every pixel, id = R + 256 G + 256² B. The environment is a stuff segment. Pixels of instances without a
    label are void (id 0).
``annotations/poses_<split>.json``
    Cameras, and the rigid transforms of the instances [m]. ``object`` is the position of an instance's entry among the
    scene's ``objects``, starting at 0, because names of assets need not be unique.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsplat.formats.format import AnnotationWriter, Catalogue, FrameFiles
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import decode_rle
from mitsplat.labels.labels import UNLABELLED, Labels
from mitsplat.labels.polygons import pixel_polygons
from mitsplat.storage.files import JsonObject, Record
from mitsplat.storage.json_stream import ListsFile

ENVIRONMENT = "environment"
"""Name of the panoptic category of pixels without an instance."""


INFO: JsonObject = {"description": "Rendered by mitsplat", "version": "1.0", "contributor": "mitsplat", "url": ""}
"""COCO's ``info``, without dates, so that equal datasets have equal bytes."""

_HEAD: JsonObject = {"info": INFO, "licenses": []}
"""Entries of all COCO files; ``COCO.info()`` of pycocotools and other readers need them."""


def annotations_of(
    record: Record, keypoint_names: Sequence[Sequence[str]], *, first: int, amodal: bool, polygons: bool = False
) -> Iterator[JsonObject]:
    """Yield the visible or amodal annotations of a frame's instances, with ids from ``first`` on.

    With ``polygons``, the segmentations of visible pixels are polygons.
    """
    width, height = record["labels"]["size"]
    for number, label in enumerate(record["labels"]["instances"], start=first):
        visible = {"size": [height, width], "counts": label["rle"]}
        x0, y0, x1, y1 = label["amodal_box" if amodal else "box"]
        annotation = {
            "id": number,
            "image_id": record["index"],
            "category_id": label["class_index"] + 1,
            "bbox": [x0, y0, x1 - x0, y1 - y0],
            "area": label["amodal_area" if amodal else "area"],
            "iscrowd": 0,
            "segmentation": {"size": [height, width], "counts": label["amodal_rle"]} if amodal else visible,
            "visible_fraction": label["visible_fraction"],
            "truncation": label["truncation"],
            "marks": label["marks"],
        }
        if amodal:
            annotation["visible_segmentation"] = visible
        if polygons:
            outlines = pixel_polygons(decode_rle(visible)[y0:y1, x0:x1].astype(bool))
            annotation["segmentation"] = [np.add(outline, (x0, y0)).ravel().tolist() for outline in outlines]
        if keypoint_names[label["class_index"]]:
            annotation["keypoints"] = [value for point in label["keypoints"] for value in point]
            annotation["num_keypoints"] = sum(point[2] > UNLABELLED for point in label["keypoints"])
        yield annotation


def panoptic_annotation(record: Record, num_classes: int) -> JsonObject:
    """Return the segments of a frame, for the picture of :func:`panoptic_image`."""
    segments = [
        {
            "id": label["id"],
            "category_id": label["class_index"] + 1,
            "area": label["area"],
            "bbox": [*label["box"][:2], label["box"][2] - label["box"][0], label["box"][3] - label["box"][1]],
            "iscrowd": 0,
        }
        for label in record["labels"]["instances"]
    ]
    if "environment" in record:
        area, (x0, y0, x1, y1) = record["environment"]["area"], record["environment"]["box"]
        box = [x0, y0, x1 - x0, y1 - y0]
        segments.append(
            {"id": record["environment"]["id"], "category_id": num_classes + 1, "area": area, "bbox": box, "iscrowd": 0}
        )
    return {"image_id": record["index"], "file_name": f"{record['index']:06d}.png", "segments_info": segments}


def pose_entry(record: Record, assets: Sequence[str]) -> JsonObject:
    """Return the camera and the 6-DoF poses of a frame."""
    camera_from_world = Camera.from_json(record["camera"]).camera_from_world
    return {
        **_image(record),
        "camera": record["camera"],
        "instances": [
            {
                "id": label["id"],
                "class": label["class"],
                "object": label["asset"],
                "asset": assets[label["asset"]],
                "camera_from_object": (camera_from_world @ np.array(label["world_from_object"])).tolist(),
                "world_from_object": label["world_from_object"],
            }
            for label in record["labels"]["instances"]
        ],
    }


def create_instances_file(path: Path, class_names: Sequence[str], keypoint_names: Sequence[Sequence[str]]) -> ListsFile:
    """Create ``instances_<split>.json``, ``polygons_<split>.json`` or ``amodal_<split>.json`` without frames."""
    categories = _categories(class_names, keypoint_names)
    return ListsFile(path, ("images", "annotations"), before=_HEAD, after={"categories": categories})


def append_instances(
    file: ListsFile,
    record: Record,
    keypoint_names: Sequence[Sequence[str]],
    *,
    amodal: bool = False,
    polygons: bool = False,
    folders: bool = False,
) -> None:
    """Append a frame to a file of :func:`create_instances_file`.

    Image names have no folder part by default, because the file belongs to one split. With ``folders``, image names are
    relative to ``images/``.
    """
    name = {"file_name": image_file(record).removeprefix("images/")} if folders else {}
    file.append("images", _image(record) | name)
    first = file.count("annotations") + 1
    for annotation in annotations_of(record, keypoint_names, first=first, amodal=amodal, polygons=polygons):
        file.append("annotations", annotation)


class SplitsWriter(AnnotationWriter):
    """Writer of one annotation file for each split.

    Args:
        root: Dataset folder.
        name: Name of the files before the split.
        splits: Names of the splits.
        create: Function that creates a file.
        append: Function that appends a frame to a file.
    """

    def __init__(
        self,
        root: Path,
        name: str,
        splits: Iterable[str],
        create: Callable[[Path], ListsFile],
        append: Callable[[ListsFile, Record], None],
    ) -> None:
        self._by_split = {split: create(root / f"annotations/{name}_{split}.json") for split in splits}
        self._append = append
        super().__init__(self._by_split.values())

    def add(self, record: Record) -> None:
        """Add a frame."""
        self._append(self._by_split[record["split"]], record)


def instances_writer(root: Path, catalogue: Catalogue, *, amodal: bool = False, polygons: bool = False) -> SplitsWriter:
    """Create the writer of ``instances_<split>.json``, ``amodal_<split>.json`` or ``polygons_<split>.json``."""
    classes, keypoints = catalogue.class_names, catalogue.keypoint_names
    return SplitsWriter(
        root,
        "amodal" if amodal else "polygons" if polygons else "instances",
        catalogue.splits,
        partial(create_instances_file, class_names=classes, keypoint_names=keypoints),
        partial(append_instances, keypoint_names=keypoints, amodal=amodal, polygons=polygons),
    )


def panoptic_writer(root: Path, catalogue: Catalogue) -> SplitsWriter:
    """Create the writer of ``panoptic_<split>.json``."""
    count = len(catalogue.class_names)
    categories = [category | {"isthing": 1} for category in _categories(catalogue.class_names, [()] * count)]
    categories.append({"id": count + 1, "name": ENVIRONMENT, "supercategory": ENVIRONMENT, "isthing": 0})

    def append(file: ListsFile, record: Record) -> None:
        file.append("images", _image(record))
        file.append("annotations", panoptic_annotation(record, count))

    create = partial(ListsFile, lists=("images", "annotations"), before=_HEAD, after={"categories": categories})
    return SplitsWriter(root, "panoptic", catalogue.splits, create, append)


def poses_writer(root: Path, catalogue: Catalogue) -> SplitsWriter:
    """Create the writer of ``poses_<split>.json``."""

    def append(file: ListsFile, record: Record) -> None:
        file.append("frames", pose_entry(record, catalogue.assets))

    create = partial(ListsFile, lists=("frames",), before={"classes": list(catalogue.class_names)})
    return SplitsWriter(root, "poses", catalogue.splits, create, append)


def write_panoptic(files: FrameFiles) -> None:
    """Write a frame's segment picture, and add the environment segment to its record."""
    environment = environment_segment(files.frame.labels, files.ids)
    if environment is not None:
        files.record["environment"] = environment
    picture = panoptic_image(files.labelled, files.ids, environment)
    files.add_png(f"panoptic/{files.name}.png", picture)


def environment_segment(labels: Labels, ids: npt.NDArray[np.integer]) -> JsonObject | None:
    """Return id, area and box of the pixels where an id map (H, W) is 0, or None if there are none.

    The id is that of a panoptic segment. It is 1 above those of all labelled instances, because 0 is void, so that an
    instance without a label or a distractor can have the same id in other maps.
    """
    ys, xs = np.nonzero(ids == 0)
    if not len(ys):
        return None
    number = max([0, *(label.id for label in labels.instances)]) + 1
    box = [int(xs.min()), int(ys.min()), int(xs.max()) + 1, int(ys.max()) + 1]
    return {"id": number, "area": len(ys), "box": box}


def panoptic_image(
    labelled: npt.NDArray[np.uint16], ids: npt.NDArray[np.integer], environment: JsonObject | None
) -> npt.NDArray[np.uint8]:
    """Return the RGB picture of segment ids, shape (H, W, 3), from the labelled ids and all ids, shape (H, W)."""
    segments = labelled.astype(np.uint32)
    if environment is not None:
        segments[ids == 0] = environment["id"]
    return np.stack([segments & 255, segments >> 8 & 255, segments >> 16], axis=-1).astype(np.uint8)


def image_file(record: Record) -> str:
    """Return the frame's image file, relative to the dataset."""
    return str(next(file for file in record["files"] if file.startswith("images/")))


def _image(record: Record) -> JsonObject:
    width, height = record["labels"]["size"]
    return {"id": record["index"], "file_name": Path(image_file(record)).name, "width": width, "height": height}


def _categories(class_names: Sequence[str], keypoint_names: Sequence[Sequence[str]]) -> list[JsonObject]:
    return [
        {"id": i, "name": name, "supercategory": "object"}
        | ({"keypoints": list(points), "skeleton": []} if points else {})
        for i, (name, points) in enumerate(zip(class_names, keypoint_names, strict=True), start=1)
    ]
