"""Motion of a scene's conveyor, recomputed from ``dataset.json``."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.storage.files import JsonObject

_MAX_DEPTH = 1e-3
"""Maximum depth of a carried object's centroid below the top of the belt [m]."""


class BeltMotion:
    """Motion of a belt along the x axis of its box; nothing moves in a scene without a belt.

    Args:
        content: Content of ``dataset.json``.
    """

    def __init__(self, content: JsonObject) -> None:
        scene = content["scene"]
        conveyor = None if content.get("given", False) else scene.get("conveyor")
        self._box: JsonObject | None = None
        self._centroids = content.get("centroids") or [(0.0, 0.0, 0.0)] * len(content["assets"])
        self._step, self._last_view = np.zeros(3), scene["output"]["views"] - 1
        if conveyor is not None:
            self._box = next(shape["box"] for shape in scene["shapes"] if shape["name"] == conveyor["belt"])
            self._turn = Rotation.from_euler("xyz", self._box["rotate"], degrees=True)
            self._step = conveyor["interval"] * conveyor["speed"] * self._turn.apply((1.0, 0.0, 0.0))

    def carries(self, asset: int, pose: Float64Array) -> bool:
        """Return True if the belt carries an object of an asset at a pose (4, 4): its centroid is above the belt."""
        if self._box is None:
            return False
        place = pose[:3, :3] @ self._centroids[asset] + pose[:3, 3]
        position, half = self._turn.inv().apply(place - self._box["position"]), np.array(self._box["size"]) / 2
        return bool((abs(position[:2]) <= half[:2]).all() and position[2] > half[2] - _MAX_DEPTH)

    def displacement(self, asset: int, pose: Float64Array, frame: DecodedFrame) -> Float64Array:
        """Return the displacement at the time of a frame of an object that settled at a pose (4, 4) [m], shape (3,)."""
        return self._travel(frame) if self.carries(asset, pose) else np.zeros(3)

    def between(self, frame: DecodedFrame, following: DecodedFrame) -> Float64Array:
        """Return the displacement of the belt between two frames of the same layout [m], shape (3,)."""
        return self._travel(following) - self._travel(frame)

    def _travel(self, frame: DecodedFrame) -> Float64Array:
        """Return the displacement of the belt since the middle of the layout's views [m], shape (3,)."""
        return np.asarray((frame.record["view"] - self._last_view / 2) * self._step)
