"""Files that a dataset must have, derived independently from its formats, and files that belong to no frame."""

from __future__ import annotations

import hashlib
import os
import re
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mitsplat.audit.read_back import Violations
from mitsplat.storage.files import Record, splits_of

YOLO_FOLDERS = {"yolo": "", "yolo-detect": "yolo-detect/", "yolo-obb": "yolo-obb/", "yolo-pose": "yolo-pose/"}
"""Folders of Ultralytics' tasks, in which labels lie beside their images."""
_YOLO = {name: folder for name, folder in YOLO_FOLDERS.items() if folder}
_ANNOTATIONS = {"coco": "instances", "amodal": "amodal", "panoptic": "panoptic", "poses": "poses"}
_MAPS = ("depth", "depth-sensor", "normals", "instances", "semantic", "panoptic")
_FOLDERS = (
    *("images", "labels", "layers", "annotations", "layouts", *_YOLO, *_MAPS),
    *("flow", "bop", "colmap"),
)
"""Folders that contain only files of a dataset."""
_FOLD = re.compile(r"fold[0-9]+(_train|_val)?\.(txt|yaml)")


def files_of_frame(record: Record, content: Mapping[str, Any]) -> dict[str, str]:
    """Return the files that a frame must have, each with its format."""
    output = content["scene"]["output"]
    formats, number, split = output["formats"], f"{record['index']:06d}", record["split"]
    image, png = f"{number}.{output['image']}", f"{number}.png"
    files = {f"images/{split}/{image}": "image"}
    if "yolo" in formats:
        files[f"labels/{split}/{number}.txt"] = "yolo"
    for name, folder in _YOLO.items():
        if name in formats:
            files |= {f"{folder}images/{split}/{image}": name, f"{folder}labels/{split}/{number}.txt": name}
    for name in _MAPS:
        if name in formats:
            files[f"{name}/{split}/{png}"] = name
    if "flow" in formats and record["view"] + 1 < output["views"]:
        files[f"flow/{split}/{number}.flo"] = "flow"
    if "exr" in formats:
        files[f"layers/{split}/{number}.exr"] = "exr"
    if "bop" in formats:
        scene = f"bop/{split}/{record['layout']:06d}"
        files |= {f"{scene}/rgb/{image}": "bop", f"{scene}/depth/{png}": "bop"}
        for position in range(len(record["labels"]["instances"])):
            name = f"{number}_{position:06d}.png"
            files |= {f"{scene}/mask/{name}": "bop", f"{scene}/mask_visib/{name}": "bop"}
    return files


def check_listed(record: Record, content: Mapping[str, Any]) -> Violations:
    """Check that the manifest lists exactly the files that the frame must have."""
    where, required = f"manifest.jsonl, frame {record['index']}", files_of_frame(record, content)
    for file, name in required.items():
        if file not in record["files"]:
            yield where, f"does not list {file} of the format {name}"
    for file in record["files"]:
        if file not in required:
            yield where, f"lists {file}, which belongs to no format of the dataset"


def labelled_assets(content: Mapping[str, Any]) -> list[int]:
    """Return the positions of the assets that have labels and therefore models."""
    return sorted(set(range(len(content["assets"]))) - set(content.get("distractors", ())))


class OwnedFiles:
    """Hashes of the names of all files that belong to the dataset, 8 bytes each."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self._formats = content["scene"]["output"]["formats"]
        self._splits = splits_of(content["scene"]["output"])
        self._models = labelled_assets(content)
        self._names = array("Q")
        self._last = ("", -1)
        for file in self._collection_files():
            self._add(file)

    def _collection_files(self) -> Iterator[str]:
        """Yield the files that describe all frames."""
        for name, described in _ANNOTATIONS.items():
            if name in self._formats:
                yield from (f"annotations/{described}_{split}.json" for split in self._splits)
        yield from (f"{folder}data.yaml" for name, folder in _YOLO.items() if name in self._formats)
        if "bop" in self._formats:
            yield "bop/models/models_info.json"
            yield from (f"bop/models/obj_{position + 1:06d}.ply" for position in self._models)
        if "colmap" in self._formats:
            yield from (f"colmap/{name}.txt" for name in ("cameras", "images", "points3D"))

    def add(self, record: Record) -> None:
        """Add the files of a frame and of its layout."""
        for file in record["files"]:
            self._add(file)
        scene = record["split"], record["layout"]
        if scene != self._last:
            self._last = scene
            self._add(f"layouts/{record['layout']:04d}.json")
            if "bop" in self._formats:
                folder = f"bop/{record['split']}/{record['layout']:06d}"
                for part in ("camera", "gt", "gt_info"):
                    self._add(f"{folder}/scene_{part}.json")

    def _add(self, file: str) -> None:
        self._names.append(_hash(file))

    def orphans(self, root: Path) -> Violations:
        """Yield the files in the dataset's folders that do not belong to the dataset."""
        known = np.sort(np.array(self._names, dtype=np.uint64))
        for top in sorted(_FOLDERS):
            for folder, folders, names in os.walk(root / top):
                folders.sort()
                # Caches of Ultralytics and lists of folds are accepted.
                files = [
                    (Path(folder) / name).relative_to(root).as_posix()
                    for name in sorted(names)
                    if name != ".lock" and not name.endswith(".cache") and not _FOLD.match(name)
                ]
                hashes = np.array([_hash(file) for file in files], dtype=np.uint64)
                found = np.searchsorted(known, hashes, side="right") > np.searchsorted(known, hashes)
                for file, is_known in zip(files, found, strict=True):
                    if not is_known:
                        yield file, "belongs to no frame of the manifest"


def _hash(file: str) -> int:
    return int.from_bytes(hashlib.blake2b(file.encode("utf-8", "surrogateescape"), digest_size=8).digest(), "little")
