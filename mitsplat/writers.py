"""Files of a dataset: those of one frame, and those that describe all of them, by format.

Every format derives from the frame's labels in memory, or from their record in the manifest. By their names in a scene
file's ``output.formats``:

``yolo``, ``yolo-detect``, ``yolo-obb``, ``yolo-pose``
    See :mod:`mitsplat.yolo`.
``coco``, ``amodal``, ``panoptic``, ``poses``
    See :mod:`mitsplat.coco`.
``voc``
    See :mod:`mitsplat.voc`.
``bop``
    See :mod:`mitsplat.bop`; for cameras without lens distortion.
``colmap``
    See :mod:`mitsplat.colmap`.
``depth``, ``normals``, ``instances``, ``semantic``, ``flow``
    ``<format>/<split>/NNNNNN.png`` (``.flo``), see :mod:`mitsplat.maps`; a depth picture's unit is ``depth_scale``
    millimetres of the frame's line in the manifest.
``exr``
    ``layers/<split>/NNNNNN.exr``: linear R, G, B; A (opacity); Z (depth along the camera's axis [m], 0 = nothing);
    instance and proxy_instance (ids); normal.X/Y/Z (world); light.R/G/B; and the frame's further layers by name.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat import bop, coco, maps, voc
from mitsplat.colmap import write_colmap
from mitsplat.errors import InputError
from mitsplat.files import SPLITS, Record, link_file, write_file, write_text
from mitsplat.spec import FORMATS, Output, SceneSpec
from mitsplat.yolo import TASKS, data_yaml, yolo_lines

if TYPE_CHECKING:
    import trimesh

    from mitsplat.frame import Frame
    from mitsplat.scene import Scene

__all__ = ["FOLDERS", "FORMATS", "Catalogue", "encode_image", "write_collection", "write_frame"]


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
        "camera": {
            "width": frame.camera.width,
            "height": frame.camera.height,
            "intrinsics": frame.camera.intrinsics.tolist(),
            "distortion": list(frame.camera.distortion),
            "lens": frame.camera.lens,
            "aperture_radius": frame.camera.aperture_radius,
            "focus_distance": frame.camera.focus_distance,
            "near": frame.camera.near,
            "world_from_camera": frame.camera.world_from_camera.tolist(),
        },
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


def write_collection(root: Path, records: Iterable[Record], catalogue: Catalogue, formats: Iterable[str]) -> None:
    """Write what describes a whole dataset, from the ``records`` of its frames, which are iterated several times."""
    formats = set(formats)
    classes, points = catalogue.class_names, catalogue.keypoint_names
    splits = {record["split"] for record in records}
    for task in formats & set(TASKS):
        text = data_yaml(classes, splits, points if task == "yolo-pose" else None)
        write_text(root / f"{TASKS[task].folder}data.yaml", text)
    describe: dict[str, tuple[str, Callable[[Iterable[Record]], dict[str, Any]]]] = {
        "coco": ("instances", lambda chosen: coco.instances_json(chosen, classes, points, amodal=False)),
        "amodal": ("amodal", lambda chosen: coco.instances_json(chosen, classes, points, amodal=True)),
        "panoptic": ("panoptic", lambda chosen: coco.panoptic_json(chosen, classes)),
        "poses": ("poses", lambda chosen: coco.poses_json(chosen, classes, catalogue.assets)),
    }
    for format, (name, describe_split) in describe.items():
        if format in formats:
            for split in SPLITS:
                content = describe_split(record for record in records if record["split"] == split)
                write_text(root / f"annotations/{name}_{split}.json", json.dumps(content))
    if "voc" in formats:
        voc.write_description(root, records, classes)
    if "bop" in formats:
        bop.write_scenes(root, records)
        bop.write_models(root, catalogue.meshes)
    if "colmap" in formats:
        write_colmap(root, records)
