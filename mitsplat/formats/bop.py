"""BOP datasets (Benchmark for 6D Object Pose estimation), one scene for each layout.

::

    bop/camera.json                                  intrinsics, image size and depth scale of the first frame
    bop/models/obj_000001.ply, models_info.json      proxy meshes [mm]; object ids are positions among the assets + 1
    bop/<split>/000000/scene_camera.json, scene_gt.json, scene_gt_info.json
    bop/<split>/000000/rgb/000003.png, depth/000003.png, mask/000003_000000.png, mask_visib/000003_000000.png

Definitions are those of the BOP toolkit (``docs/bop_datasets_format.md``, ``scripts/calc_gt_info.py``): the silhouette
is counted up to one image beyond each border, boxes are (x, y, x_max - x_min, y_max - y_min), and pixel centres are
integers. There is one difference: visibility is known exactly, whereas the toolkit compares depths within 15 mm.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from mitsplat.errors import InputError
from mitsplat.formats.format import AnnotationWriter, Catalogue, FrameFiles
from mitsplat.formats.maps import encode_mask_png
from mitsplat.geometry.camera import Camera
from mitsplat.labels.labels import Labels
from mitsplat.storage.files import GrowingFile, JsonObject, Record, write_bytes, write_text
from mitsplat.storage.json_stream import EntriesFile

MILLIMETRES = 1000.0
_BATCH_FILES, _SYNC_THREADS = 768, 32
"""Number of finished files per batch, and number of threads that flush a batch to disk."""


def scene_folder(record: Record) -> str:
    """Return the folder of the frame's scene, relative to the dataset."""
    return f"bop/{record['split']}/{record['layout']:06d}"


def write(files: FrameFiles) -> None:
    """Write a frame's depth picture and masks, and add its image under a second name.

    Raises:
        InputError: If the camera of a frame made in Python has lens distortion.
    """
    if not files.frame.camera.is_pinhole:
        raise InputError(
            f"frame {files.frame.index}: bop must have a camera without lens distortion (got "
            f"{list(files.frame.camera.distortion)})"
        )
    scene = scene_folder(files.record)
    files.add_image(f"{scene}/rgb/{files.image_name}")
    files.add_depth(f"{scene}/depth/{files.number}.png")
    for folder, position, data in mask_pictures(files.frame.labels):
        files.add_bytes(f"{scene}/{folder}/{files.number}_{position:06d}.png", data)


def mask_pictures(labels: Labels) -> Iterable[tuple[str, int, bytes]]:
    """Yield (folder, position of the instance, PNG of 0 and 255) for every mask of a frame."""
    size = labels.width, labels.height
    for position, label in enumerate(labels.instances):
        yield "mask", position, encode_mask_png(label.amodal.mask, label.amodal.box, size)
        yield "mask_visib", position, encode_mask_png(label.mask, label.box, size)


class ScenesWriter(AnnotationWriter):
    """Writer of the annotations of all scenes and of the models; frames must be added by ascending layout.

    The files of scenes are flushed to disk in parallel, in batches of :data:`_BATCH_FILES`. A million images have
    300,000 such files, and flushing them one by one would take longer than all other work.
    """

    def __init__(self, root: Path, catalogue: Catalogue) -> None:
        super().__init__()
        self._root = root
        meshes = enumerate(catalogue.meshes)
        self._meshes = {position + 1: mesh for position, mesh in meshes if position not in catalogue.distractors}
        self._folder, self._layout = "", -1
        self._camera: JsonObject | None = None
        self._scene_files: dict[str, EntriesFile] = {}
        self._completed: list[GrowingFile] = []

    def add(self, record: Record) -> None:
        """Add a frame."""
        folder = scene_folder(record)
        if folder != self._folder:
            if record["layout"] <= self._layout:
                raise ValueError(
                    f"frames must be added by ascending layout (got {record['layout']} after {self._layout})"
                )
            self._end_scene()
            if len(self._completed) >= _BATCH_FILES:
                self._finish_batch()
            self._folder, self._layout = folder, record["layout"]
            self._scene_files = {
                part: EntriesFile(self._root / folder / f"scene_{part}.json") for part in ("camera", "gt", "gt_info")
            }
        index, camera = str(record["index"]), Camera.from_json(record["camera"])
        if self._camera is None:
            self._camera = dataset_camera(record, camera)
        self._scene_files["camera"].append(index, camera_entry(record, camera))
        self._scene_files["gt"].append(index, pose_entries(record, camera))
        self._scene_files["gt_info"].append(index, info_entries(record))

    def _end_scene(self) -> None:
        self._completed += (file.end() for file in self._scene_files.values())
        self._scene_files = {}

    def _finish_batch(self) -> None:
        with ThreadPoolExecutor(_SYNC_THREADS) as pool:
            list(pool.map(GrowingFile.sync, self._completed))
        for file in self._completed:
            file.rename()
        self._completed = []

    def commit(self) -> None:
        """Give the files of the last scenes their final names, and write the models."""
        self._end_scene()
        self._finish_batch()
        write_models(self._root, self._meshes)
        if self._camera is not None:
            write_text(self._root / "bop/camera.json", json.dumps(self._camera, indent=1))

    def discard(self) -> None:
        """Remove the files that do not have their final name yet."""
        files: tuple[EntriesFile | GrowingFile, ...] = (*self._scene_files.values(), *self._completed)
        for file in files:
            file.discard()


def write_models(root: Path, meshes: Mapping[int, trimesh.Trimesh]) -> None:
    """Write the objects' meshes by object id, with their bounds and diameters."""
    info = {}
    for number, mesh in meshes.items():
        scaled = mesh.copy()
        scaled.apply_scale(MILLIMETRES)
        corners = scaled.vertices[ConvexHull(scaled.vertices).vertices]
        info[str(number)] = {
            "diameter": float(pdist(corners).max()),
            **{f"min_{axis}": float(value) for axis, value in zip("xyz", scaled.bounds[0], strict=True)},
            **{f"size_{axis}": float(value) for axis, value in zip("xyz", scaled.extents, strict=True)},
        }
        data = trimesh.exchange.ply.export_ply(scaled, encoding="ascii", vertex_normal=True)
        write_bytes(root / f"bop/models/obj_{number:06d}.ply", data)
    write_text(root / "bop/models/models_info.json", json.dumps(info, indent=1))


def dataset_camera(record: Record, camera: Camera) -> JsonObject:
    """Return the content of ``camera.json``, which describes the camera of a dataset by that of one frame."""
    return {
        **{"cx": camera.cx - 0.5, "cy": camera.cy - 0.5, "fx": camera.fx, "fy": camera.fy},
        **{"width": camera.width, "height": camera.height, "depth_scale": record["depth_scale"]},
    }


def camera_entry(record: Record, camera: Camera) -> JsonObject:
    """Return the frame's entry in ``scene_camera.json``."""
    intrinsics = camera.intrinsics
    intrinsics[:2, 2] -= 0.5
    pose = camera.camera_from_world
    return {
        "cam_K": intrinsics.ravel().tolist(),
        "depth_scale": record["depth_scale"],
        "cam_R_w2c": pose[:3, :3].ravel().tolist(),
        "cam_t_w2c": (MILLIMETRES * pose[:3, 3]).tolist(),
    }


def pose_entries(record: Record, camera: Camera) -> list[JsonObject]:
    """Return the frame's entry in ``scene_gt.json``."""
    entries = []
    for label in record["labels"]["instances"]:
        pose = camera.camera_from_world @ np.array(label["world_from_object"])
        rotation, translation = pose[:3, :3].ravel().tolist(), (MILLIMETRES * pose[:3, 3]).tolist()
        entries.append({"cam_R_m2c": rotation, "cam_t_m2c": translation, "obj_id": label["asset"] + 1})
    return entries


def info_entries(record: Record) -> list[JsonObject]:
    """Return the frame's entry in ``scene_gt_info.json``."""

    def box(bounds: Sequence[int]) -> list[int]:
        x0, y0, x1, y1 = bounds
        return [x0, y0, x1 - 1 - x0, y1 - 1 - y0]

    return [
        {
            "bbox_obj": box(label["silhouette_box"]),
            "bbox_visib": box(label["box"]),
            "px_count_all": label["silhouette_area"],
            "px_count_valid": label["depth_area"],
            "px_count_visib": label["area"],
            "visib_fract": label["area"] / label["silhouette_area"],
        }
        for label in record["labels"]["instances"]
    ]
