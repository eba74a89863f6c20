"""Files of a dataset by format: files of one frame, and files that describe all frames.

A format is one entry of :data:`TABLE`. Its files are written from the frame's labels in memory, or from their record in
the manifest. Names of formats in a scene file's ``output.formats``:

``yolo``, ``yolo-detect``, ``yolo-obb``, ``yolo-pose``
    See :mod:`mitsplat.formats.yolo`.
``coco``, ``amodal``, ``panoptic``, ``poses``
    See :mod:`mitsplat.formats.coco`.
``bop``
    See :mod:`mitsplat.formats.bop`; for cameras without lens distortion.
``colmap``
    See :mod:`mitsplat.formats.colmap`.
``depth``, ``depth-sensor``, ``normals``, ``instances``, ``semantic``, ``flow``
    ``<format>/<split>/NNNNNN.png`` (``.flo``), see :mod:`mitsplat.formats.maps`. The unit of a depth picture is
    ``depth_scale`` (``depth_sensor_scale``) in the frame's line of the manifest [mm].
``exr``
    ``layers/<split>/NNNNNN.exr``: linear R, G, B; A (opacity); Z (depth along the camera's axis [m], 0 = no surface);
    instance and proxy_instance (ids); normal.X/Y/Z (world); light.R/G/B; and the frame's further layers by name.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.formats import bop, coco, map_files, maps, yolo
from mitsplat.formats.colmap import ModelWriter
from mitsplat.formats.format import AnnotationWriter, Catalogue, Format, FrameFiles
from mitsplat.scene.planning.contents import draw_regions
from mitsplat.scene.planning.layout_surroundings import draw_surroundings
from mitsplat.scene.spec.scene_spec import FORMATS, Output, SceneSpec
from mitsplat.scene.splits import is_empty
from mitsplat.storage.files import Record

if TYPE_CHECKING:
    from mitsplat.frames.frame import Frame

__all__ = ["FORMATS", "TABLE", "Catalogue", "CollectionWriter", "encode_image", "write_frame"]

TABLE = {
    **{task: yolo.format_of(task) for task in yolo.TASKS},
    "instances": Format(("instances",), map_files.write_instances),
    "coco": Format(("annotations",), create_writer=coco.instances_writer),
    "amodal": Format(("annotations",), create_writer=partial(coco.instances_writer, amodal=True)),
    "panoptic": Format(("panoptic", "annotations"), coco.write_panoptic, coco.panoptic_writer),
    "poses": Format(("annotations",), create_writer=coco.poses_writer),
    "semantic": Format(("semantic",), map_files.write_semantic),
    "depth": Format(("depth",), map_files.write_depth),
    "depth-sensor": Format(("depth-sensor",), map_files.write_depth_sensor),
    "bop": Format(("bop",), bop.write, bop.ScenesWriter),
    "colmap": Format(("colmap",), create_writer=ModelWriter),
    "normals": Format(("normals",), map_files.write_normals),
    "flow": Format(("flow",), map_files.write_flow),
    "exr": Format(("layers",), map_files.write_exr),
}
"""Formats in the order in which they are written."""


def write_frame(frame: Frame, root: Path, spec: SceneSpec, catalogue: Catalogue, *, given: bool = False) -> Record:
    """Write the files of one frame below ``root``, and return its manifest record, which lists the files.

    If the layout was ``given`` by the caller, the record contains no values that are drawn together with a layout.
    """
    plan, output = frame.plan, spec.output
    ids = frame.instance if spec.labels.source == "splats" else frame.layers.proxy_instance
    if distractors := [instance.id for instance in frame.layout.instances if instance.class_index is None]:
        ids = np.where(np.isin(ids, distractors), ids.dtype.type(0), ids)
    record: Record = {
        "index": frame.index,
        "layout": plan.layout,
        "view": plan.view,
        "split": plan.split,
        "seed": plan.seed,
        "files": {},
        "draws": dict(frame.plan.draws),
        "lights": [light.model_dump(mode="json") for light in plan.lights],
        "camera": frame.camera.to_json(),
        "labels": frame.labels.to_json(),
        "rest": frame.layout.certificate.to_json(),
    }
    if catalogue.drawn:
        record["objects"] = [{"id": one.id, **catalogue.drawn[one.asset]} for one in frame.layout.instances]
        if spec.regions and not given:
            regions = draw_regions(spec, plan.layout)
            for drawn in record["objects"]:
                drawn["region"] = spec.region_names[regions[drawn["id"] - 1]]
    if frame.layout.left_out:
        record["left_out"] = [
            {"id": one.id, "asset": one.asset, "name": catalogue.assets[one.asset], "reason": one.reason}
            for one in frame.layout.left_out
        ]
    if plan.viewpoint:
        record["viewpoint"] = dict(plan.viewpoint)
    if plan.belt is not None and not given:
        record["conveyor"] = {"time": plan.belt.time}
    if place := draw_surroundings(spec, frame.index, frame.layout.index).to_json(spec):
        record["place"] = place
    if any(entry.appearance for entry in spec.objects):
        record["appearance"] = [one.to_json() for one in frame.appearances.values()]
    if spec.empty and not given:
        record["empty"] = is_empty(spec, plan.layout)
    if frame.order_error is not None:
        record["order_error"] = {name: round(value, 6) for name, value in frame.order_error.items()}
    image = f"images/{plan.split}/{frame.index:06d}.{output.image}"
    files = FrameFiles(root, frame, catalogue, record, image, ids)
    files.add_bytes(image, encode_image(frame.image, output))
    for name, format in TABLE.items():
        if name in output.formats and format.write is not None:
            format.write(files)
    return record


def encode_image(image: npt.NDArray[np.uint8], output: Output) -> bytes:
    """Encode an RGB image (H, W, 3) as PNG or JPEG."""
    if output.image == "png":
        return maps.encode_png(image)
    options = [cv2.IMWRITE_JPEG_QUALITY, 95]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise OSError(f"OpenCV could not encode an image of shape {image.shape} as jpg")
    return bytes(data)


class CollectionWriter:
    """Writer of the files that describe a whole dataset, from the records of its frames by ascending index.

    Only the current frame is held in memory. No file gets its final name before all frames were added, except the files
    of BOP scenes, which are complete after their last frame.
    """

    def __init__(self, root: Path, catalogue: Catalogue, formats: Iterable[str]) -> None:
        self._root, self._catalogue, self._formats = root, catalogue, set(formats)
        self._writers: list[AnnotationWriter] = []

    def __enter__(self) -> CollectionWriter:
        for name, format in TABLE.items():
            if name in self._formats and format.create_writer is not None:
                self._writers.append(format.create_writer(self._root, self._catalogue))
        return self

    def __exit__(self, *error: object) -> None:
        for writer in self._writers:
            writer.discard()

    def add(self, record: Record) -> None:
        """Add a frame."""
        for writer in self._writers:
            writer.add(record)

    def commit(self) -> None:
        """Give the files their final names."""
        for writer in self._writers:
            writer.commit()
