"""Files that a dataset must have, derived independently from its formats, and files that belong to no frame."""

from __future__ import annotations

import hashlib
import os
import re
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsplat.audit.dataset_check import Violations
from mitsplat.storage.files import JsonObject, Record, splits_of

YOLO_FOLDERS = {"yolo": "", "yolo-detect": "yolo-detect/", "yolo-obb": "yolo-obb/", "yolo-pose": "yolo-pose/"}
"""Folders of Ultralytics' tasks, in which labels lie beside their images."""
_YOLO = {name: folder for name, folder in YOLO_FOLDERS.items() if folder}
_ANNOTATIONS = {
    **{"coco": "instances", "coco-polygons": "polygons", "amodal": "amodal"},
    **{"panoptic": "panoptic", "poses": "poses"},
}
_MAPS = ("depth", "depth-sensor", "normals", "instances", "semantic", "panoptic")
_FOLDERS = (*("images", "labels", "layers", "annotations", "layouts", *_YOLO, *_MAPS), *("flow", "bop", "colmap"))
"""Folders that contain only files of a dataset."""
_FOLD = re.compile(r"fold[0-9]+(_train|_val)?\.(txt|yaml)")


def expected_files(record: Record, content: JsonObject) -> dict[str, str]:
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
    if "flow" in formats and ("next" in record or record["view"] + 1 < output["views"]):
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


def labelled_assets(content: JsonObject) -> list[int]:
    """Return the positions of the assets that have labels and therefore models."""
    return sorted(set(range(len(content["assets"]))) - set(content.get("distractors", ())))


class ExpectedFiles:
    """Hashes of the names of all files that belong to the dataset, 8 bytes each."""

    def __init__(self, content: JsonObject) -> None:
        self._content = content
        self._hashes = array("Q", map(_hash, _annotation_files(content)))
        self._last_scene = ("", -1)

    def check_record(self, record: Record) -> Violations:
        """Check that the manifest lists exactly the files that a frame must have; add the files of its layout."""
        where, required = f"manifest.jsonl, frame {record['index']}", expected_files(record, self._content)
        for file, name in required.items():
            if file not in record["files"]:
                yield where, f"does not list {file} of the format {name}"
        for file in record["files"]:
            if file not in required:
                yield where, f"lists {file}, which belongs to no format of the dataset"
        self._hashes.extend(map(_hash, record["files"]))
        split, layout = scene = record["split"], record["layout"]
        if scene != self._last_scene:
            self._last_scene = scene
            self._hashes.append(_hash(f"layouts/{layout:04d}.json"))
            if "bop" in self._content["scene"]["output"]["formats"]:
                parts = ("camera", "gt", "gt_info")
                self._hashes.extend(_hash(f"bop/{split}/{layout:06d}/scene_{part}.json") for part in parts)

    def check_folders(self, root: Path) -> Violations:
        """Yield the files in the dataset's folders that do not belong to the dataset."""
        known = np.sort(np.array(self._hashes, dtype=np.uint64))
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


def _annotation_files(content: JsonObject) -> Iterator[str]:
    """Yield the files that describe all frames."""
    output = content["scene"]["output"]
    formats = output["formats"]
    for name, prefix in _ANNOTATIONS.items():
        if name in formats:
            yield from (f"annotations/{prefix}_{split}.json" for split in splits_of(output))
    yield from (f"{folder}data.yaml" for name, folder in _YOLO.items() if name in formats)
    if "bop" in formats:
        yield from ("bop/camera.json", "bop/models/models_info.json")
        yield from (f"bop/models/obj_{position + 1:06d}.ply" for position in labelled_assets(content))
    if "colmap" in formats:
        yield from (f"colmap/{name}.txt" for name in ("cameras", "images", "points3D"))


def _hash(file: str) -> int:
    return int.from_bytes(hashlib.blake2b(file.encode("utf-8", "surrogateescape"), digest_size=8).digest(), "little")
