"""Audit of BOP scenes and models, which are read as by the BOP toolkit; projected models must match the masks.

After the toolkit's ``inout.load_scene_camera``, ``load_scene_gt`` and ``scripts/calc_gt_info.py``: matrices by rows,
lengths in millimetres, boxes (x, y, x_max - x_min, y_max - y_min), pixel centres at integers.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from mitsplat.arrays import Float64Array
from mitsplat.audit.dataset_check import (
    DatasetCheck,
    EntryCursor,
    Violation,
    Violations,
    are_objects,
    compare_keys,
    is_close,
    prefixed,
    read_json_file,
)
from mitsplat.audit.decoded_frame import DecodedFrame, DecodedInstance, bounds_of
from mitsplat.audit.expected_files import labelled_assets
from mitsplat.errors import InputError
from mitsplat.images.masks import Box
from mitsplat.images.picture_files import read_picture
from mitsplat.mesh_files.mesh_reading import read_mesh
from mitsplat.storage.files import JsonObject
from mitsplat.storage.json_stream import read_entries

_PARTS = ("camera", "gt", "gt_info")
_MODEL_TOLERANCE = 0.01
"""Tolerance for the limited decimals of a model file [mm]."""
_MIN_FIT = 0.5
"""Minimum of the median IoU, over all instances of a model, between its projected box and that of the silhouette."""
_BINS = 20
_MIN_INSTANCES = 3
"""Minimum number of instances for the check of a model."""
_MIN_AREA = 64
"""Minimum area of silhouettes for the check of a model [px]."""


class BopCheck(DatasetCheck):
    """Check of ``scene_camera.json``, ``scene_gt.json``, ``scene_gt_info.json`` and the models of all scenes."""

    def __init__(self, root: Path, content: JsonObject) -> None:
        self._root, self._content = root, content
        self._folder, self._is_first = "", True
        self._cursors: dict[str, EntryCursor[object]] = {}
        self._corners: dict[int, Float64Array] = {}
        self._fits: dict[int, list[int]] = {}
        self._models = list(self._check_models())

    def check(self, frame: DecodedFrame) -> Violations:
        """Compare the entries of a frame with its masks, depth picture, camera and poses."""
        if self._is_first:
            self._is_first = False
            yield from self._check_camera_file(frame)
        if frame.bop_folder != self._folder:
            yield from self._finish_scene()
            self._folder = frame.bop_folder
            for part in _PARTS:
                file = f"{self._folder}/scene_{part}.json"
                entries = ((int(key), value) for key, value in read_entries(self._root / file))
                self._cursors[part] = EntryCursor(file, entries)
        cameras = yield from self._cursors["camera"].entry_of(frame)
        for camera in cameras:
            yield from prefixed(self._cursors["camera"].file, f"frame {frame.index}", _check_camera(frame, camera))
        for label, pose in (yield from self._instances_of(frame, "gt")):
            place = f"frame {frame.index}, {label.name}"
            yield from prefixed(self._cursors["gt"].file, place, _check_pose(frame, label, pose))
            self._count_fit(frame, label, cameras[0] if cameras else None, pose)
        picture = self._root / f"{frame.bop_folder}/depth/{frame.index:06d}.png"
        depth = read_picture(picture, cv2.IMREAD_UNCHANGED) if picture.is_file() else None
        for label, info in (yield from self._instances_of(frame, "gt_info")):
            place = f"frame {frame.index}, {label.name}"
            yield from prefixed(self._cursors["gt_info"].file, place, _check_info(frame, label, info, depth))

    def _instances_of(
        self, frame: DecodedFrame, part: str
    ) -> Generator[Violation, None, list[tuple[DecodedInstance, JsonObject]]]:
        """Return the instances of a frame with their entries in a file; the list is empty after a violation."""
        cursor = self._cursors[part]
        for entry in (yield from cursor.entry_of(frame)):
            if are_objects(entry) and len(entry) == len(frame.instances):
                return list(zip(frame.instances, entry, strict=True))
            yield cursor.file, f"frame {frame.index} must have {len(frame.instances)} instances"
        return []

    def _count_fit(self, frame: DecodedFrame, label: DecodedInstance, camera: object, pose: JsonObject) -> None:
        """Project the model by the camera and pose in the files, and count the IoU with the silhouette's box.

        Boxes that reach the end of the range in which silhouettes are counted are left out, because they are cut there.
        """
        number = label.entry["asset"] + 1
        corners = self._corners.get(number)
        matrix = _read_numbers(camera, "cam_K", 9)
        rotation, shift = _read_numbers(pose, "cam_R_m2c", 9), _read_numbers(pose, "cam_t_m2c", 3)
        if corners is None or matrix is None or rotation is None or shift is None or label.silhouette_area < _MIN_AREA:
            return
        if label.reaches_range:
            return
        projected = (corners @ rotation.reshape(3, 3).T + shift) @ matrix.reshape(3, 3).T
        if projected[:, 2].max() > 0 >= projected[:, 2].min():
            return  # the model reaches behind the camera, so its box is unbounded
        with np.errstate(all="ignore"):
            pixels = projected[:, :2] / projected[:, 2:]
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0) + 1])
        iou = _box_iou(box, np.array(label.entry["silhouette_box"])) if projected[:, 2].min() > 0 else 0.0
        self._fits.setdefault(number, [0] * _BINS)[min(_BINS - 1, int(np.nan_to_num(iou) * _BINS))] += 1

    def _finish_scene(self) -> Violations:
        for cursor in self._cursors.values():
            yield from cursor.finish()

    def finish(self) -> Violations:
        """Check the remaining entries and the models, and that the models match the masks."""
        yield from self._finish_scene()
        yield from self._models
        for number, counts in sorted(self._fits.items()):
            middle = int(np.searchsorted(np.cumsum(counts), sum(counts) / 2)) / _BINS
            if sum(counts) >= _MIN_INSTANCES and middle < _MIN_FIT:
                yield (
                    f"bop/models/obj_{number:06d}.ply",
                    f"does not fit its silhouettes in the poses of scene_gt.json: half of {sum(counts)} boxes have an "
                    f"IoU below {middle + 1 / _BINS:.2f}",
                )

    def _check_camera_file(self, frame: DecodedFrame) -> Violations:
        """Check that ``camera.json`` has the intrinsics of the first frame."""
        file = "bop/camera.json"
        (fx, _, cx), (_, fy, cy), _ = frame.intrinsics
        expected = {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5, "depth_scale": frame.record["depth_scale"]}
        expected |= dict(zip(("width", "height"), frame.size, strict=True))
        for found in (yield from read_json_file(self._root, file)):
            for key, value in expected.items():
                if not isinstance(found, dict) or not is_close(found.get(key), value):
                    yield file, f"{key} is not that of the first frame, {value:g}"
                    return

    def _check_models(self) -> Violations:
        """Check that the model files exist and have the stated measures."""
        file = "bop/models/models_info.json"
        found = yield from read_json_file(self._root, file)
        info = found[0] if found and isinstance(found[0], dict) else {}
        labelled = labelled_assets(self._content)
        numbers = {str(position + 1) for position in labelled}
        if info.keys() - numbers:
            yield file, f"has an entry {min(info.keys() - numbers)}, which is no labelled object"
        for number in (position + 1 for position in labelled):
            model = f"bop/models/obj_{number:06d}.ply"
            if not (self._root / model).is_file():
                yield model, "is missing"
                continue
            try:
                points = np.asarray(read_mesh(self._root / model).vertices, dtype=np.float64)
                self._corners[number] = points[ConvexHull(points).vertices]
            except (InputError, QhullError) as error:
                yield model, f"cannot be read ({error})"
                continue
            low, high = points.min(axis=0), points.max(axis=0)
            measured = {"diameter": float(pdist(self._corners[number]).max())}
            measured |= {f"min_{axis}": value for axis, value in zip("xyz", low, strict=True)}
            measured |= {f"size_{axis}": value for axis, value in zip("xyz", high - low, strict=True)}
            stated = info.get(str(number), {})
            if found and not all(
                isinstance(stated, dict) and is_close(stated.get(key), value, _MODEL_TOLERANCE / max(1.0, abs(value)))
                for key, value in measured.items()
            ):
                yield file, f"does not state the measures of {model}"


def _check_camera(frame: DecodedFrame, entry: object) -> Iterator[str]:
    centres = frame.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    pose = frame.camera_from_world
    yield from _check_numbers(
        entry, {"cam_K": centres.ravel(), "cam_R_w2c": pose[:3, :3].ravel(), "cam_t_w2c": 1000 * pose[:3, 3]}
    )
    yield from compare_keys(entry, {"depth_scale": frame.record["depth_scale"]})


def _check_pose(frame: DecodedFrame, label: DecodedInstance, entry: JsonObject) -> Iterator[str]:
    pose = frame.camera_from_world @ label.pose
    numbers = {"cam_R_m2c": pose[:3, :3].ravel(), "cam_t_m2c": 1000 * pose[:3, 3]}
    yield from _check_numbers(entry, numbers)
    yield from compare_keys(entry, {"obj_id": label.entry["asset"] + 1})


def _check_info(
    frame: DecodedFrame, label: DecodedInstance, info: JsonObject, depth: npt.NDArray[np.generic] | None
) -> Iterator[str]:
    x0, y0, x1, y1 = label.amodal_box
    expected = {
        "bbox_obj": _bop_box(label.entry["silhouette_box"]),
        "bbox_visib": _bop_box(bounds_of(frame.full_mask(label))),
        "px_count_all": label.silhouette_area,
        "px_count_visib": label.area,
    }
    if depth is not None and depth.shape == frame.size[::-1]:
        expected["px_count_valid"] = int(np.count_nonzero(depth[y0:y1, x0:x1][label.amodal]))
    yield from compare_keys(info, expected)
    fraction = label.area / label.silhouette_area
    if not is_close(info.get("visib_fract"), fraction):
        yield f"visib_fract is {info.get('visib_fract')}, not {fraction:.6f}"


def _check_numbers(entry: object, expected: Mapping[str, Float64Array]) -> Iterator[str]:
    for key, values in expected.items():
        found = entry.get(key) if isinstance(entry, dict) else None
        if not is_close(found, values):
            yield f"{key} is {str(found)[:60]}, which differs from the manifest's camera and poses"


def _read_numbers(entry: object, key: str, size: int) -> Float64Array | None:
    try:
        values = np.array(entry.get(key) if isinstance(entry, dict) else None, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return values if values.shape == (size,) and np.isfinite(values).all() else None


def _bop_box(box: Box | list[int]) -> list[int]:
    x0, y0, x1, y1 = box
    return [x0, y0, x1 - 1 - x0, y1 - 1 - y0]


def _box_iou(one: Float64Array, other: Float64Array) -> float:
    shared = np.clip(np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2]), 0, None).prod()
    return float(shared / (np.prod(one[2:] - one[:2]) + np.prod(other[2:] - other[:2]) - shared))
