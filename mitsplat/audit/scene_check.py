"""Audit of frames against the scene in ``dataset.json``: intrinsics, camera positions and labelled objects."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.audit.dataset_check import DatasetCheck, Violations
from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.storage.files import JsonObject

_SIGMAS = 6.0
"""Maximum jitter of cameras, in standard deviations."""
_POSITION_TOLERANCE = 1e-6
"""Tolerance of positions [m]."""


class SceneCheck(DatasetCheck):
    """Comparison of frames with the scene of ``dataset.json``."""

    def __init__(self, content: JsonObject) -> None:
        scene = content["scene"]
        self._camera, self._output = scene["camera"], scene["output"]
        self._distractors = set(content.get("distractors", ()))
        self._held_out = _held_out(content["scene"])
        self._checks_cameras = not content.get("given", False)

    def check(self, frame: DecodedFrame) -> Violations:
        """Check that the scene can have the frame's camera and labels; a camera given by the caller is not checked."""
        for text in chain(self._check_objects(frame), self._check_camera(frame) if self._checks_cameras else ()):
            yield f"manifest.jsonl, frame {frame.index}", text

    def _check_camera(self, frame: DecodedFrame) -> Iterator[str]:
        yield from self._check_lens(frame)
        yield from self._check_camera_pose(frame)

    def _check_objects(self, frame: DecodedFrame) -> Iterator[str]:
        width, height = self._output["width"], self._output["height"]
        if frame.size != (width, height):
            yield f"is {frame.size[0]}x{frame.size[1]} px, not {width}x{height} as in the scene"
        drawn = frame.record.get("objects")
        left_out = {one["id"] for one in frame.record.get("left_out", ())}
        for label in frame.instances:
            asset = label.entry["asset"]
            if asset in self._held_out and frame.split != "test":
                yield f"{label.name} is of an asset that is held out for the test split"
            if asset in self._distractors:
                yield f"{label.name} is labelled, although its asset is a distractor"
            if drawn is not None and not any(
                (one["id"], one["asset"], one["label"]) == (label.id, asset, True) for one in drawn
            ):
                yield f"{label.name} is not among the drawn objects"
            if label.id in left_out:
                yield f"{label.name} is labelled, although its layout lacks it"
        if frame.record.get("empty") and frame.instances:
            yield f"has {len(frame.instances)} labels, although its layout is empty"

    def _check_lens(self, frame: DecodedFrame) -> Iterator[str]:
        lens, (width, height) = self._camera["intrinsics"], (self._output["width"], self._output["height"])
        full_width, full_height = lens["size"] or (width, height)
        if lens["fov_x"] is not None:
            fx = fy = full_width / (2 * np.tan(np.radians(lens["fov_x"]) / 2))
        else:
            fx, fy = lens["fx"], lens["fx"] if lens["fy"] is None else lens["fy"]
        cx = full_width / 2 if lens["cx"] is None else lens["cx"]
        cy = full_height / 2 if lens["cy"] is None else lens["cy"]
        scale = np.diag([width / full_width, height / full_height, 1.0])
        expected = scale @ [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        if np.abs(frame.intrinsics - expected).max() > 1e-9 * max(fx, fy, width, height):
            yield f"its intrinsics are not the scene's, {expected[0, 0]:.6g}, {expected[1, 1]:.6g} px"
        distortion = ([], "opencv") if self._output.get("rectify") else (list(lens["distortion"]), lens["lens"])
        if (list(frame.distortion), frame.record["camera"]["lens"]) != distortion:
            yield "its lens distortion is not the scene's"

    def _check_camera_pose(self, frame: DecodedFrame) -> Iterator[str]:
        """Check the camera's position and direction: distance and direction to the target, or the ends of a path."""
        camera, pose = self._camera, np.array(frame.world_from_camera, dtype=np.float64)
        eye, axis = pose[:3, 3], pose[:3, 2]
        if camera["kind"] == "fixed":
            yield from _check_fixed_pose(camera, pose)
            return
        if camera["kind"] == "path":
            views = self._output["views"]
            ends = {0: camera["keys"][0], views - 1: camera["keys"][-1]}
            if (key := ends.get(frame.record["view"])) is None or views == 1:
                return
            away = float(np.linalg.norm(eye - key["eye"]))
            if away > _SIGMAS * camera["jitter"] + _POSITION_TOLERANCE:
                yield f"its camera is {away:.3g} m from the key of the scene's path"
            direction = np.subtract(key["target"], key["eye"])
            if axis @ direction < (1 - _POSITION_TOLERANCE) * np.linalg.norm(direction):
                yield "its camera does not look at the target of the scene's path"
            return
        target, tolerance = camera["target"], _SIGMAS * camera.get("target_jitter", 0.0) + _POSITION_TOLERANCE
        if (stated := (frame.record.get("viewpoint") or {}).get("target")) is not None:
            target, tolerance = stated, _POSITION_TOLERANCE  # the record states the drawn target
        offset = eye - target
        if camera["kind"] == "orbit":
            tolerance = _SIGMAS * camera["jitter"] + _POSITION_TOLERANCE
            off = float(np.hypot(np.hypot(*offset[:2]) - camera["radius"], offset[2] - camera["height"]))
            low = high = float(np.hypot(camera["radius"], camera["height"]))
        else:
            low, high = camera["radius"]
            off = max(low - np.linalg.norm(offset), np.linalg.norm(offset) - high, 0.0)
        if off > tolerance:
            yield f"its camera is {off:.3g} m off the scene's {camera['kind']}"
        distance = float(np.linalg.norm(np.cross(axis, offset)))
        if distance > tolerance or (axis @ offset > 0 and high > tolerance):
            yield f"its camera looks past the scene's target by {distance:.3g} m"


def _check_fixed_pose(camera: JsonObject, pose: Float64Array) -> Iterator[str]:
    """Compare a pose with that of a fixed camera, or with its eye, target and upper direction."""
    if (stated := camera["world_from_camera"]) is not None:
        expected = np.array(stated, dtype=np.float64)
        eye, axes = expected[:3, 3], expected[:3, :3]
    else:
        eye, ahead = np.array(camera["eye"]), np.subtract(camera["target"], camera["eye"])
        ahead /= np.linalg.norm(ahead)
        ups = np.array([camera["up"], (0, 1, 0), (0, 0, 1)], dtype=np.float64)
        right = next(
            side for side in np.cross(ahead, ups / np.linalg.norm(ups, axis=1)[:, None]) if side @ side > 1e-12
        )
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    away = float(np.linalg.norm(pose[:3, 3] - eye))
    if away > _SIGMAS * camera["jitter"] + _POSITION_TOLERANCE:
        yield f"its camera is {away:.3g} m from the scene's fixed camera"
    # The Frobenius norm of the difference of two rotations is sqrt(8) sin(angle / 2).
    sine = float(np.linalg.norm(pose[:3, :3] - axes)) / np.sqrt(8)
    angle = float(2 * np.degrees(np.arcsin(min(1.0, sine))))
    if angle > _SIGMAS * camera["rotation_jitter"] + np.degrees(_POSITION_TOLERANCE):
        yield f"its camera is turned by {angle:.3g} degrees from the scene's fixed camera"


def _held_out(scene: JsonObject) -> set[int]:
    """Return the positions, in the order of the scene's assets, of assets that only the test split may have."""
    names = set(scene.get("hold_out", {}).get("assets", ()))
    found, position = set[int](), 0
    for entry in scene.get("objects", ()) if names else ():
        pool = [f"primitives {n}" for n in range(15)] if entry.get("pool") == "primitives" else entry.get("pool")
        sizes = 5 if isinstance(entry["scale"], list) and entry["scale"][0] < entry["scale"][1] else 1
        for name in pool or [entry.get("asset")]:
            found.update(range(position, position + sizes) if name in names else ())
            position += sizes
    return found
