"""Audit of the layouts: resting poses, moved by the belt if there is one, must equal the poses of the labels."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from mitsplat.audit.conveyor_motion import BeltMotion
from mitsplat.audit.dataset_check import DatasetCheck, Violations, is_close
from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.storage.files import JsonObject, read_json


class LayoutCheck(DatasetCheck):
    """Check of ``layouts/``. Files without a frame are reported as files that belong to no frame."""

    def __init__(self, root: Path, content: JsonObject) -> None:
        self._root, self._belt = root, BeltMotion(content)
        self._index = -1
        self._instances: dict[int, JsonObject] | None = None

    def check(self, frame: DecodedFrame) -> Violations:
        """Check that labelled instances match the layout, and that every object of the layout is accounted for."""
        index = frame.record["layout"]
        file = f"layouts/{index:04d}.json"
        if index != self._index:
            self._index, self._instances = index, None
            try:
                layout = read_json(self._root / file)
                self._instances = {entry["id"]: entry for entry in layout["instances"]}
                if layout["index"] != index:
                    yield file, f"is of layout {layout['index']}"
            except FileNotFoundError:
                yield file, "is missing"
            except (OSError, ValueError, KeyError, TypeError) as error:
                yield file, f"cannot be read ({type(error).__name__}: {error})"
        if self._instances is None:
            return
        line = f"manifest.jsonl, frame {frame.index}"
        for label in frame.instances:
            entry = self._instances.get(label.id)
            if entry is None:
                yield line, f"{label.name} is not in {file}"
            elif (entry.get("asset"), entry.get("class_index")) != (label.entry["asset"], label.class_index):
                yield line, f"{label.name} is of another asset or class than in {file}"
            elif not is_close(self._pose_at(entry, frame), label.pose, 1e-12):
                yield line, f"{label.name} has another pose than in {file}"
        dropped = Counter(frame.record["labels"]["dropped"])
        del dropped["fragments"]
        classed = [entry for entry in self._instances.values() if entry.get("class_index") is not None]
        labels, unlabelled = len(frame.instances), dropped.total()
        if labels + unlabelled != len(classed):
            yield line, f"{labels} labels and {unlabelled} unlabelled instances are not all of {file}"
        drawn = frame.record.get("objects")
        if drawn is not None and [(one["id"], one["asset"]) for one in drawn] != [
            (number, entry.get("asset")) for number, entry in self._instances.items()
        ]:
            yield line, f"its objects differ from those of {file}"

    def _pose_at(self, entry: JsonObject, frame: DecodedFrame) -> object:
        """Return an object's stored pose at the time of a frame, displaced by the belt if it carries the object."""
        stored = entry.get("world_from_object")
        try:
            pose = np.array(stored, dtype=np.float64)
        except (TypeError, ValueError):
            return stored
        if pose.shape == (4, 4):
            pose[:3, 3] += self._belt.displacement(entry["asset"], pose, frame)
        return pose
