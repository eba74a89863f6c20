"""Files of a dataset by format: files of one frame, and files that describe all frames.

A format is one entry of :data:`TABLE`. Its files are written from the frame's labels in memory, or from their record in
the manifest. Names of formats in a scene file's ``output.formats``:

``yolo``, ``yolo-detect``, ``yolo-obb``, ``yolo-pose``
    See :mod:`mitsplat.formats.yolo`.
``coco``, ``coco-polygons``, ``amodal``, ``panoptic``, ``poses``
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

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mitsplat.formats import bop, coco, map_files, maps, yolo
from mitsplat.formats.colmap import ModelWriter
from mitsplat.formats.format import Catalogue, Format, FrameFiles
from mitsplat.scene.planning.contents import draw_arrangements, draw_regions
from mitsplat.scene.planning.layout_surroundings import draw_surroundings
from mitsplat.scene.spec.scene_spec import FORMATS, SceneSpec
from mitsplat.scene.splits import is_empty
from mitsplat.storage.files import Record

if TYPE_CHECKING:
    from mitsplat.frames.frame import Frame

__all__ = ["FORMATS", "TABLE", "Catalogue", "CollectionWriter", "write_frame"]

TABLE = {
    **{task: yolo.format_of(task) for task in yolo.TASKS},
    "instances": Format(("instances",), map_files.write_instances),
    "coco": Format(("annotations",), create_writer=coco.instances_writer),
    "coco-polygons": Format(("annotations",), create_writer=partial(coco.instances_writer, polygons=True)),
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


def write_frame(
    frame: Frame, root: Path, spec: SceneSpec, catalogue: Catalogue, *, original: Frame | None = None
) -> Record:
    """Write the files of one frame below ``root``, and return its manifest record, which lists the files.

    If ``frame`` is the numbered copy of an ``original`` that the caller rendered, the surroundings are those of the
    original, and the record contains no values that are drawn together with a layout.
    """
    custom_layout = original is not None
    rendered = original or frame
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
    if catalogue.drawn_objects:
        record["objects"] = [{"id": one.id, **catalogue.drawn_objects[one.asset]} for one in frame.layout.instances]
        if spec.regions and not custom_layout:
            regions = draw_regions(spec, plan.layout)
            for drawn in record["objects"]:
                drawn["region"] = spec.region_names[regions[drawn["id"] - 1]]
    if not custom_layout and any(len(arrangements) > 1 for _, arrangements in spec.all_regions):
        record["arrangement"] = dict(zip(spec.region_names, draw_arrangements(spec, plan.layout), strict=True))
    if frame.layout.left_out:
        record["left_out"] = [
            {"id": one.id, "asset": one.asset, "name": catalogue.assets[one.asset], "reason": one.reason}
            for one in frame.layout.left_out
        ]
    if plan.viewpoint:
        record["viewpoint"] = dict(plan.viewpoint)
    if plan.belt is not None and not custom_layout:
        record["conveyor"] = {"time": plan.belt.time}
    if place := draw_surroundings(spec, rendered.index, rendered.layout.index).to_json(spec):
        record["place"] = place
    if any(entry.appearance for entry in spec.objects):
        record["appearance"] = [one.to_json() for one in frame.appearances.values()]
    if spec.empty and not custom_layout:
        record["empty"] = is_empty(spec, plan.layout)
    if frame.order_error is not None:
        record["order_error"] = {name: round(value, 6) for name, value in frame.order_error.items()}
    image = f"images/{plan.split}/{frame.index:06d}.{output.image}"
    files = FrameFiles(root, frame, catalogue, record, image, ids)
    data = maps.encode_png(frame.image) if output.image == "png" else maps.encode_jpg(frame.image)
    files.add_bytes(image, data)
    for name, format in TABLE.items():
        if name in output.formats and format.write is not None:
            format.write(files)
    return record


class CollectionWriter:
    """Writer of the files that describe a whole dataset, from the records of its frames by ascending index.

    Only the current frame is held in memory. No file gets its final name before all frames were added, except the files
    of BOP scenes, which are complete after their last frame.
    """

    def __init__(self, root: Path, catalogue: Catalogue, formats: Collection[str]) -> None:
        selected = [format for name, format in TABLE.items() if name in formats]
        self._writers = [format.create_writer(root, catalogue) for format in selected if format.create_writer]

    def __enter__(self) -> CollectionWriter:
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
