"""Audit of text files that describe all frames: Ultralytics' ``data.yaml``, COLMAP models and layouts."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from mitsplat.audit.conveyor_check import BeltTruth
from mitsplat.audit.described import Cursor, is_close
from mitsplat.audit.owned import YOLO_FOLDERS
from mitsplat.audit.read_back import Violations
from mitsplat.audit.truth import TrueFrame
from mitsplat.runtime.child_process import python_command, python_environment
from mitsplat.storage.files import SPLITS, read_json

_POINTS = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0], [-0.15, 0.05, 0.8], [0.12, -0.2, 1.5]])
"""Points in front of a camera, in its frame, whose pixels determine its model and parameters, shape (5, 3)."""
_PIXEL_TOLERANCE = 1e-6
"""Tolerance between projections of OpenCV and COLMAP [px]."""


class YoloReader:
    """Reader of the ``data.yaml`` of every task."""

    def __init__(self, root: Path, content: Mapping[str, Any]) -> None:
        self._root, self._content = root, content
        self._splits: set[str] = set()

    def check(self, frame: TrueFrame) -> Violations:
        """Record the split of the frame."""
        self._splits.add(frame.split)
        yield from ()

    def finish(self) -> Violations:
        """Check that classes, folders and keypoints are those of the dataset."""
        for task, folder in YOLO_FOLDERS.items():
            if task in self._content["scene"]["output"]["formats"]:
                file = f"{folder}data.yaml"
                for text in self._check(self._root / file, with_points=task == "yolo-pose"):
                    yield file, text

    def _check(self, path: Path, *, with_points: bool) -> Iterator[str]:
        try:
            data = YAML(typ="safe", pure=True).load(path.read_text())
        except FileNotFoundError:
            yield "is missing"
            return
        except (OSError, ValueError, YAMLError) as error:
            yield f"cannot be read ({' '.join(str(error).split())})"
            return
        if not isinstance(data, dict):
            yield "must be a mapping"
            return
        if data.get("names") != dict(enumerate(self._content["classes"])):
            yield f"names are {str(data.get('names'))[:80]}, not {dict(enumerate(self._content['classes']))}"
        for split in SPLITS[:2]:
            shown = split if split in self._splits else next((one for one in SPLITS if one in self._splits), split)
            if data.get(split) != f"images/{shown}":
                yield f"{split} is {data.get(split)}, not images/{shown}"
        if data.get("test") != ("images/test" if "test" in self._splits else None):
            yield f"test is {data.get('test')}, which does not match the images of that split"
        if "path" in data:
            yield "must not have a path, because the dataset could not be moved"
        if with_points:
            names = self._content["keypoints"]
            count = max(map(len, names), default=0)
            padded = {i: [*own, *(f"unused_{k}" for k in range(len(own), count))] for i, own in enumerate(names)}
            if data.get("kpt_shape") != [count, 3] or data.get("kpt_names") != padded:
                yield f"its keypoints are not {padded}"


class ColmapReader:
    """Reader of ``colmap/``; pycolmap runs in a process of its own, because it may abort the process."""

    def __init__(self, root: Path) -> None:
        self._model = root / "colmap"
        names = ("cameras", "images", "points3D")
        self._missing = [name for name in names if not (self._model / f"{name}.txt").is_file()]
        self._images = Cursor("colmap/images.txt", iter(()) if self._missing else self._read())

    def _read(self) -> Iterator[tuple[int, Any]]:
        points = json.dumps(_POINTS.tolist())
        command = python_command("-m", "mitsplat.audit.colmap_worker", self._model.resolve(), points)
        with tempfile.TemporaryFile("w+") as error_output:
            child = subprocess.Popen(
                command, env=python_environment(), stdout=subprocess.PIPE, stderr=error_output, text=True
            )
            try:
                for line in child.stdout or ():
                    image = json.loads(line)
                    yield image["id"] - 1, image
                if child.wait():
                    error_output.seek(0)
                    lines = error_output.read().strip().splitlines() or [
                        f"its process ended with status {child.returncode}"
                    ]
                    raise ValueError(lines[-1])
            finally:
                if child.poll() is None:
                    child.kill()
                    child.wait()
                if child.stdout is not None:
                    child.stdout.close()

    def check(self, frame: TrueFrame) -> Violations:
        """Compare the image's pose, and the projections of some points by its camera, with those of the manifest."""
        if self._images.broken or self._missing:
            return
        found = list(self._images.take(frame.index))
        yield from self._images.errors()
        if self._images.broken:
            return
        if len(found) != 1:
            yield self._images.file, f"has {len(found)} images of frame {frame.index}"
            return
        for text in self._check(frame, found[0]):
            yield self._images.file, f"frame {frame.index}: {text}"

    def _check(self, frame: TrueFrame, image: Mapping[str, Any]) -> Iterator[str]:
        if image["name"] != f"{frame.split}/{frame.image_name}":
            yield f"its name is {image['name']}, not {frame.split}/{frame.image_name}"
        if not is_close(image["camera_from_world"], frame.camera_from_world[:3], 1e-8):
            yield "its pose differs from the manifest's camera"
        if image["size"] != list(frame.size) or not is_close(image["pixels"], frame.project(_POINTS), _PIXEL_TOLERANCE):
            yield "its camera differs from that of the manifest"

    def finish(self) -> Violations:
        """Report missing files and check the remaining entries."""
        for name in self._missing:
            yield f"colmap/{name}.txt", "is missing"
        if not self._missing and not self._images.broken:
            yield from self._images.finish()


class LayoutReader:
    """Reader of ``layouts/``; resting poses, moved by the belt if there is one, must equal the labels' poses."""

    def __init__(self, root: Path, content: Mapping[str, Any]) -> None:
        self._root, self._belt = root, BeltTruth(content)
        self._index, self._found = -1, dict[int, Any]()

    def check(self, frame: TrueFrame) -> Violations:
        """Check that labelled instances match the layout, and that every object of the layout is accounted for."""
        index = frame.record["layout"]
        file = f"layouts/{index:04d}.json"
        if index != self._index:
            self._index, self._found = index, {}
            try:
                stored = read_json(self._root / file)
                self._found = {entry["id"]: entry for entry in stored["instances"]}
                if stored["index"] != index:
                    yield file, f"is of layout {stored['index']}"
            except FileNotFoundError:
                yield file, "is missing"
            except (OSError, ValueError, KeyError, TypeError) as error:
                yield file, f"cannot be read ({type(error).__name__}: {error})"
        if not self._found:
            return
        where = f"manifest.jsonl, frame {frame.index}"
        for label in frame.instances:
            entry = self._found.get(label.id)
            if entry is None:
                yield where, f"{label.name} is not in {file}"
            elif (entry.get("asset"), entry.get("class_index")) != (label.entry["asset"], label.kind):
                yield where, f"{label.name} is of another asset or class than in {file}"
            elif not is_close(self._pose_at(entry.get("world_from_object"), frame), label.pose, 1e-12):
                yield where, f"{label.name} has another pose than in {file}"
        dropped = Counter(frame.record["labels"]["dropped"])
        del dropped["fragments"]
        labelled = [entry for entry in self._found.values() if entry.get("class_index") is not None]
        if len(frame.instances) + dropped.total() != len(labelled):
            yield (
                where,
                f"{len(frame.instances)} labels and {dropped.total()} unlabelled instances are not all of {file}",
            )
        drawn = frame.record.get("objects")
        if drawn is not None and [(one["id"], one["asset"]) for one in drawn] != [
            (number, entry.get("asset")) for number, entry in self._found.items()
        ]:
            yield where, f"its objects differ from those of {file}"

    def _pose_at(self, stored: Any, frame: TrueFrame) -> Any:
        """Return a stored pose at the time of a frame, displaced by the belt if the belt carries the object."""
        try:
            pose = np.array(stored, dtype=np.float64)
        except (TypeError, ValueError):
            return stored
        if pose.shape != (4, 4):
            return stored
        pose[:3, 3] += self._belt.displacement(pose, frame)
        return pose

    def finish(self) -> Violations:
        """Do nothing; layout files without a frame are reported as files that belong to no frame."""
        yield from ()
