"""Files of a dataset: those of one frame, and those that describe all of them, by format.

Every format derives from the frame's labels in memory, or from their record in the manifest. By their names in a scene
file's ``output.formats``:

``yolo``, ``yolo-detect``, ``yolo-obb``, ``yolo-pose``
    See :mod:`mitsplat.formats.yolo`.
``coco``, ``amodal``, ``panoptic``, ``poses``
    See :mod:`mitsplat.formats.coco`.
``voc``
    See :mod:`mitsplat.formats.voc`.
``bop``
    See :mod:`mitsplat.formats.bop`; for cameras without lens distortion.
``colmap``
    See :mod:`mitsplat.formats.colmap`.
``depth``, ``normals``, ``instances``, ``semantic``, ``flow``
    ``<format>/<split>/NNNNNN.png`` (``.flo``), see :mod:`mitsplat.formats.maps`; a depth picture's unit is
    ``depth_scale`` millimetres of the frame's line in the manifest.
``exr``
    ``layers/<split>/NNNNNN.exr``: linear R, G, B; A (opacity); Z (depth along the camera's axis [m], 0 = nothing);
    instance and proxy_instance (ids); normal.X/Y/Z (world); light.R/G/B; and the frame's further layers by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.errors import InputError
from mitsplat.files import SPLITS, Record, link_file, write_file, write_text
from mitsplat.formats import bop, coco, maps, voc
from mitsplat.formats.colmap import ModelWriter
from mitsplat.formats.yolo import TASKS, data_yaml, yolo_lines
from mitsplat.json_stream import ListsFile
from mitsplat.scene.spec import FORMATS, Output, SceneSpec

if TYPE_CHECKING:
    import trimesh

    from mitsplat.frames.frame import Frame
    from mitsplat.scene.scene import Scene

__all__ = ["FOLDERS", "FORMATS", "Catalogue", "CollectionWriter", "encode_image", "write_collection", "write_frame"]


FOLDERS = {
    **{task: f"{entry.folder}labels/" for task, entry in TASKS.items()},
    **{name: f"{name}/" for name in ("bop", "depth", "instances", "normals", "panoptic", "semantic")},
    "voc": "voc/Annotations/",
    "exr": "layers/",
}
"""Where every frame has a file, by format."""


@dataclass(frozen=True, eq=False)
class Catalogue:
    """What the labels of a scene refer to.

    Attributes:
        class_names: By class index.
        keypoint_names: Keypoints of every class.
        assets: Names, by position among the scene's assets.
        meshes: Their proxy meshes [m].
    """

    class_names: Sequence[str]
    keypoint_names: Sequence[Sequence[str]]
    assets: Sequence[str]
    meshes: Sequence[trimesh.Trimesh]

    @classmethod
    def of(cls, scene: Scene) -> Catalogue:
        """The catalogue of a scene, checked against the formats that it asks for.

        Raises:
            InputError: If assets of one class name different keypoints, or a format cannot show what the scene has.
        """
        points: dict[str, tuple[str, tuple[str, ...]]] = {}
        for asset in scene.assets:
            names = tuple(asset.keypoints)
            other, known = points.setdefault(asset.class_name, (asset.name, names))
            if known != names:
                raise InputError(
                    f"{scene.path}: assets of class {asset.class_name!r} must name the same keypoints "
                    f"(got {list(known)} in {other} and {list(names)} in {asset.name})"
                )
        keypoint_names = tuple(points[name][1] if name in points else () for name in scene.class_names)
        formats = scene.spec.output.formats
        if "yolo-pose" in formats and not any(keypoint_names):
            raise InputError(f"{scene.path}: output.formats: yolo-pose needs an asset with keypoints (got none)")
        if "bop" in formats and any(scene.spec.camera.intrinsics.distortion):
            raise InputError(
                f"{scene.path}: output.formats: bop must have a camera without lens distortion "
                f"(got {list(scene.spec.camera.intrinsics.distortion)})"
            )
        meshes = [asset.mesh for asset in scene.assets if asset.mesh is not None]
        return cls(scene.class_names, keypoint_names, [asset.name for asset in scene.assets], meshes)

    @property
    def num_keypoints(self) -> int:
        """Keypoints of the class that has most."""
        return max(map(len, self.keypoint_names), default=0)


def write_frame(frame: Frame, root: Path, spec: SceneSpec, catalogue: Catalogue) -> Record:
    """Write the files of one frame below ``root`` and describe it, its files included, as a line of the manifest."""
    plan, labels, output = frame.plan, frame.labels, spec.output
    formats = set(output.formats)
    ids = frame.instance if spec.labels.source == "splats" else frame.proxy_instance
    environment = coco.environment_segment(labels, ids) if "panoptic" in formats else None
    scale = maps.depth_scale(frame.depth) if formats & {"bop", "depth"} else None
    record: Record = {
        "index": frame.index,
        "layout": plan.layout,
        "view": plan.view,
        "split": plan.split,
        "seed": plan.seed,
        "files": {},
        "draws": dict(frame.draws),
        "lights": [light.model_dump(mode="json") for light in plan.lights],
        "camera": frame.camera.to_json(),
        "labels": labels.to_json(),
        "rest": frame.layout.to_json()["certificate"],
        **({"environment": environment} if environment is not None else {}),
        **({"depth_scale": scale} if scale is not None else {}),
    }
    name = f"{plan.split}/{frame.index:06d}"
    image = f"images/{name}.{output.image}"

    def add(file: str, write: Callable[[Path], object]) -> None:
        record["files"][file] = write_file(root / file, write)

    def add_png(file: str, picture: npt.NDArray[Any]) -> None:
        add(file, lambda path: path.write_bytes(maps.encode_png(picture)))

    add(image, lambda path: path.write_bytes(encode_image(frame.image, output)))
    for task in (format for format in output.formats if format in TASKS):
        folder, text = TASKS[task].folder, yolo_lines(labels, task, catalogue.num_keypoints)
        if folder:
            add(folder + image, lambda path: link_file(root / image, path))
        add(f"{folder}labels/{name}.txt", lambda path, text=text: path.write_text(text))  # type: ignore[misc]
    if "voc" in formats:
        number = f"{frame.index:06d}"
        add(f"voc/JPEGImages/{number}.{output.image}", lambda path: link_file(root / image, path))
        text = voc.annotation(labels, f"{number}.{output.image}")
        add(f"voc/Annotations/{number}.xml", lambda path: path.write_bytes(text.encode()))
    if formats & {"instances", "panoptic"}:
        labelled = maps.instance_picture(labels)
        if "instances" in formats:
            add_png(f"instances/{name}.png", labelled)
        if "panoptic" in formats:
            add_png(f"panoptic/{name}.png", coco.panoptic_image(labelled, ids, environment))
    if "semantic" in formats:
        add_png(f"semantic/{name}.png", maps.semantic_picture(labels, ids, catalogue.class_names))
    if formats & {"bop", "depth"}:
        depth = maps.depth_picture(frame.depth)
        if "depth" in formats:
            add_png(f"depth/{name}.png", depth)
        if "bop" in formats:
            scene = bop.scene_folder(record)
            add(f"{scene}/rgb/{frame.index:06d}.{output.image}", lambda path: link_file(root / image, path))
            add_png(f"{scene}/depth/{frame.index:06d}.png", depth)
            for folder, position, data in bop.mask_pictures(labels):
                file = f"{scene}/{folder}/{frame.index:06d}_{position:06d}.png"
                add(file, lambda path, data=data: path.write_bytes(data))  # type: ignore[misc]
    if "normals" in formats:
        add_png(f"normals/{name}.png", maps.normal_picture(frame.normal))
    if "flow" in formats and plan.next_camera is not None:
        flow = maps.optical_flow(frame.depth, frame.camera, plan.next_camera)
        add(f"flow/{name}.flo", lambda path: maps.write_flow(path, flow))
    if "exr" in formats:
        add(f"layers/{name}.exr", lambda path: maps.write_exr(path, frame))
    return record


def encode_image(image: npt.NDArray[np.uint8], output: Output) -> bytes:
    """An RGB image (H, W, 3) as PNG or JPEG."""
    if output.image == "png":
        return maps.encode_png(image)
    options = [cv2.IMWRITE_JPEG_QUALITY, output.jpeg_quality]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise OSError(f"OpenCV could not encode an image of shape {image.shape} as jpg")
    return bytes(data)


class Describer(Protocol):
    """Writes files that describe a whole dataset, frame by frame; they get their names when they are kept."""

    def add(self, record: Record) -> None:
        """Describe a frame; frames come by ascending index."""

    def keep(self) -> None:
        """End the files, and give them their names."""

    def discard(self) -> None:
        """Remove what was not kept."""


class _OfSplit(Protocol):
    file: ListsFile

    def add(self, record: Record) -> None: ...


class _Annotations:
    """A file of annotations for each split."""

    def __init__(self, root: Path, name: str, make: Callable[[Path], _OfSplit]) -> None:
        self._writers = {split: make(root / f"annotations/{name}_{split}.json") for split in SPLITS}

    def add(self, record: Record) -> None:
        self._writers[record["split"]].add(record)

    def keep(self) -> None:
        for writer in self._writers.values():
            writer.file.keep()

    def discard(self) -> None:
        for writer in self._writers.values():
            writer.file.discard()


class _Descriptions:
    """Ultralytics' descriptions of all tasks."""

    def __init__(self, root: Path, tasks: Iterable[str], catalogue: Catalogue) -> None:
        self._root, self._tasks, self._catalogue = root, list(tasks), catalogue
        self._splits: set[str] = set()

    def add(self, record: Record) -> None:
        self._splits.add(record["split"])

    def keep(self) -> None:
        for task in self._tasks:
            points = self._catalogue.keypoint_names if task == "yolo-pose" else None
            text = data_yaml(self._catalogue.class_names, self._splits, points)
            write_text(self._root / f"{TASKS[task].folder}data.yaml", text)

    def discard(self) -> None:
        """There is nothing that was not kept."""


class CollectionWriter:
    """Writes what describes a whole dataset, from the records of its frames by ascending index.

    Nothing is kept in memory but the frame at hand, and no file gets its name before all frames were added, but for
    BOP's scenes, each of which is whole with its last frame.
    """

    def __init__(self, root: Path, catalogue: Catalogue, formats: Iterable[str]) -> None:
        self._root, self._catalogue, self._formats = root, catalogue, set(formats)
        self._describers: list[Describer] = []

    def __enter__(self) -> CollectionWriter:
        root, classes, points = self._root, self._catalogue.class_names, self._catalogue.keypoint_names
        make: dict[str, Callable[[], Describer]] = {
            "coco": lambda: _Annotations(
                root, "instances", lambda path: coco.InstancesWriter(path, classes, points, amodal=False)
            ),
            "amodal": lambda: _Annotations(
                root, "amodal", lambda path: coco.InstancesWriter(path, classes, points, amodal=True)
            ),
            "panoptic": lambda: _Annotations(root, "panoptic", lambda path: coco.PanopticWriter(path, classes)),
            "poses": lambda: _Annotations(
                root, "poses", lambda path: coco.PosesWriter(path, classes, self._catalogue.assets)
            ),
            "voc": lambda: voc.SetsWriter(root, classes),
            "bop": lambda: bop.ScenesWriter(root),
            "colmap": lambda: ModelWriter(root),
        }
        self._describers.append(_Descriptions(root, self._formats & set(TASKS), self._catalogue))
        self._describers += (make[name]() for name in make if name in self._formats)
        return self

    def __exit__(self, *error: object) -> None:
        for describer in self._describers:
            describer.discard()

    def add(self, record: Record) -> None:
        """Describe a frame."""
        for describer in self._describers:
            describer.add(record)

    def keep(self) -> None:
        """Give the files their names."""
        for describer in self._describers:
            describer.keep()
        if "bop" in self._formats:
            bop.write_models(self._root, self._catalogue.meshes)


def write_collection(root: Path, records: Iterable[Record], catalogue: Catalogue, formats: Iterable[str]) -> None:
    """Write what describes a whole dataset, from the ``records`` of its frames by ascending index."""
    with CollectionWriter(root, catalogue, formats) as collection:
        for record in records:
            collection.add(record)
        collection.keep()
