"""Frames of a dataset compared with the scene that it states: intrinsics, where cameras may be, what is labelled."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from mitsplat.audit.read_back import Violations
from mitsplat.audit.truth import TrueFrame

_SIGMAS = 6.0
"""Multiples of a jitter's standard deviation within which cameras stay."""
_NEAR = 1e-6
"""Rounding of positions [m]."""


class SceneReader:
    """The scene of ``dataset.json``."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self._camera, self._output = content["scene"]["camera"], content["scene"]["output"]
        self._distractors = set(content.get("distractors", ()))
        self._held_out = _held_out(content["scene"])

    def check(self, frame: TrueFrame) -> Violations:
        """Whether the frame's camera can be one of the scene's, and its labels are of what is labelled."""
        for text in (*self._check_lens(frame), *self._check_place(frame), *self._check_objects(frame)):
            yield f"manifest.jsonl, frame {frame.index}", text

    def finish(self) -> Violations:
        """Nothing is left."""
        yield from ()

    def _check_objects(self, frame: TrueFrame) -> Iterator[str]:
        drawn = frame.record.get("objects")
        for label in frame.instances:
            asset = label.entry["asset"]
            if asset in self._held_out and frame.split != "test":
                yield f"{label.name} is of an asset that is held out for the test split"
            if asset in self._distractors:
                yield f"{label.name} is labelled, though the scene says that it is not"
            if drawn is not None and not any(
                (one["id"], one["asset"], one["label"]) == (label.id, asset, True) for one in drawn
            ):
                yield f"{label.name} is none of the objects that were drawn"
        if frame.record.get("empty") and frame.instances:
            yield f"has {len(frame.instances)} labels, though its layout is an empty one"

    def _check_lens(self, frame: TrueFrame) -> Iterator[str]:
        lens, (width, height) = self._camera["intrinsics"], (self._output["width"], self._output["height"])
        if frame.size != (width, height):
            yield f"is {frame.size[0]}x{frame.size[1]} px, not {width}x{height} as the scene says"
        wide, high = lens["size"] or (width, height)
        if lens["fov_x"] is not None:
            fx = fy = wide / (2 * np.tan(np.radians(lens["fov_x"]) / 2))
        else:
            fx, fy = lens["fx"], lens["fx"] if lens["fy"] is None else lens["fy"]
        cx, cy = (wide / 2 if lens["cx"] is None else lens["cx"]), (high / 2 if lens["cy"] is None else lens["cy"])
        scale = np.diag([width / wide, height / high, 1.0])
        expected = scale @ [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        if np.abs(frame.intrinsics - expected).max() > 1e-9 * max(fx, fy, width, height):
            yield f"its intrinsics are not the scene's, {expected[0, 0]:.6g}, {expected[1, 1]:.6g} px"
        if list(frame.distortion) != list(lens["distortion"]) or frame.record["camera"]["lens"] != lens["lens"]:
            yield "its lens distortion is not the scene's"

    def _check_place(self, frame: TrueFrame) -> Iterator[str]:
        """Closed forms: circles and spheres about a target that the axis meets, and the ends of paths."""
        camera, pose = self._camera, frame.world_from_camera
        eye, axis = pose[:3, 3], pose[:3, 2]
        if camera["kind"] == "path":
            ends = {0: camera["keys"][0], self._output["views"] - 1: camera["keys"][-1]}
            if (key := ends.get(frame.record["view"])) is None or self._output["views"] == 1:
                return
            away = float(np.linalg.norm(eye - key["eye"]))
            if away > _SIGMAS * camera["jitter"] + _NEAR:
                yield f"its camera is {away:.3g} m from the key of the scene's path"
            wanted = np.subtract(key["target"], key["eye"])
            if axis @ wanted < (1 - _NEAR) * np.linalg.norm(wanted):
                yield "its camera does not look where the scene's path says"
            return
        target, room = camera["target"], _SIGMAS * camera.get("target_jitter", 0.0) + _NEAR
        if frame.record.get("viewpoint") is not None:  # it looks at what lies there, and says what that is
            target, room = frame.record["viewpoint"]["target"], _NEAR
        offset = eye - target
        if camera["kind"] == "orbit":
            room = _SIGMAS * camera["jitter"] + _NEAR
            off = float(np.hypot(np.hypot(*offset[:2]) - camera["radius"], offset[2] - camera["height"]))
            low = high = float(np.hypot(camera["radius"], camera["height"]))
        else:
            low, high = camera["radius"]
            off = max(low - np.linalg.norm(offset), np.linalg.norm(offset) - high, 0.0)
        if off > room:
            yield f"its camera is {off:.3g} m off the scene's {camera['kind']}"
        beside = float(np.linalg.norm(np.cross(axis, offset)))
        if beside > room or (axis @ offset > 0 and high > room):
            yield f"its camera looks past the scene's target by {beside:.3g} m"


def _held_out(scene: Mapping[str, Any]) -> set[int]:
    """Positions, among the assets of a scene's objects in turn, of those that only the test split may have."""
    names = set(scene.get("hold_out", {}).get("assets", ()))
    found, position = set[int](), 0
    for entry in scene.get("objects", ()) if names else ():
        pool = [f"primitives {n}" for n in range(15)] if entry.get("pool") == "primitives" else entry.get("pool")
        sizes = 5 if isinstance(entry["scale"], list) and entry["scale"][0] < entry["scale"][1] else 1
        for name in pool or [entry["asset"]]:
            found.update(range(position, position + sizes) if name in names else ())
            position += sizes
    return found
