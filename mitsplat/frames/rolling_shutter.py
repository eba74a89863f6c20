"""Images whose rows are exposed one after another, while the camera moves and a belt runs.

An image is taken in bands of rows, each at the moment of its middle. There are as many as keep what any row shows
within a quarter of a pixel of its own moment; an image of which nothing moves by half a pixel is taken at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.images.masks import Silhouette

MOST_MOVED = 0.5
"""How far what is seen may move while a band is read [px]."""

MOST_BANDS = 64
"""Beyond it bands are read for longer than that."""

MARGIN = 8
"""Rows above and below a band that are rendered with it, so that light is averaged as it is within an image.

What is rendered begins at multiples of it, where patterns of rays and tiles begin anew."""

_ROUNDS = 8
"""Until a point's row and its moment agree: each leaves the share of the image that all moves during the read-out."""


@dataclass(frozen=True, eq=False)
class Band:
    """Rows of an image that are taken at one moment.

    Attributes:
        camera: At that moment, of an image with these rows and a margin alone.
        first, end: The rows, of the whole image.
        top: The whole image's row that is the first one of the camera's.
        time: Of the moment, since the image's middle row was exposed [s].
    """

    camera: Camera
    first: int
    end: int
    top: int
    time: float

    @property
    def rows(self) -> slice:
        """The band's rows among the camera's."""
        return slice(self.first - self.top, self.end - self.top)


def bands_of(camera: Camera, motion: Mapping[str, Any], swept: Sequence[npt.NDArray[np.floating[Any]]]) -> list[Band]:
    """The bands of an image, none if it may be taken at once.

    Args:
        camera: Where it is when the middle row is exposed.
        motion: As :class:`mitsplat.scene.planning.viewpoints.Viewpoint` has it.
        swept: How far pixels move during an exposure then [px], see :func:`mitsplat.frames.flow.swept_by`.
    """
    readout = motion.get("readout", 0.0)
    farthest = max(float(np.abs(way).max()) for way in swept) * readout / motion["exposure"]
    count = min(ceil(farthest / MOST_MOVED), MOST_BANDS)
    if count < 2:
        return []
    height = camera.height
    edges = np.unique(np.linspace(0, height, count + 1).round().astype(int))
    bands = []
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        time = readout * ((first + end) / (2 * height) - 0.5)
        top, bottom = max(first // MARGIN - 1, 0) * MARGIN, min(end + MARGIN, height)
        part = replace(_moved(camera, motion, time), height=bottom - top, cy=camera.cy - top)
        bands.append(Band(part, first, end, top, time))
    return bands


def _moved(camera: Camera, motion: Mapping[str, Any], time: float) -> Camera:
    pose = camera.world_from_camera.copy()
    pose[:3, 3] += time * (pose[:3, :3] @ np.asarray(motion["velocity"]))
    turn = Rotation.from_rotvec(time * np.asarray(motion["rotation"]), degrees=True)
    pose[:3, :3] = pose[:3, :3] @ turn.as_matrix()
    return replace(camera, world_from_camera=pose)


def stacked_silhouettes(bands: Sequence[Band], parts: Sequence[Mapping[int, Silhouette]]) -> dict[int, Silhouette]:
    """What instances cover in the whole image, from what they cover in each band's camera.

    What is above the image or below it is as the first and the last row's moments show it.
    """
    found: dict[int, list[Silhouette]] = {}
    for number, (band, silhouettes) in enumerate(zip(bands, parts, strict=True)):
        for instance, seen in silhouettes.items():
            x0, y0, _, y1 = seen.box
            above = y0 if number == 0 else max(y0, band.first - band.top)
            below = y1 if number == len(bands) - 1 else min(y1, band.end - band.top)
            mask = seen.mask[max(above - y0, 0) : max(below - y0, 0)]
            if mask.any():
                found.setdefault(instance, []).append(Silhouette.cropped(mask, x0, above + band.top))
    return {instance: _united(those) for instance, those in sorted(found.items())}


def _united(parts: Sequence[Silhouette]) -> Silhouette:
    boxes = np.array([part.box for part in parts])
    (left, top), (right, bottom) = boxes[:, :2].min(axis=0).tolist(), boxes[:, 2:].max(axis=0).tolist()
    mask = np.zeros((bottom - top, right - left), dtype=bool)
    for part in parts:
        x0, y0, x1, y1 = part.box
        mask[y0 - top : y1 - top, x0 - left : x1 - left] |= part.mask
    return Silhouette((left, top, right, bottom), mask)


def project_by_row(
    camera: Camera, motion: Mapping[str, Any], points: Float64Array, velocity: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Pixels (N, 2) and depths [m] (N,) of points in the world (N, 3), each at the moment of the row that shows it.

    Args:
        camera: Where it is when the middle row is exposed.
        motion: As :class:`mitsplat.scene.planning.viewpoints.Viewpoint` has it.
        points: Where they are then [m].
        velocity: At which the points move [m/s], shape (3,).
    """
    rotation, lens = camera.world_from_camera[:3, :3], replace(camera, world_from_camera=np.eye(4))
    own = (points - camera.centre) @ rotation
    relative = rotation.T @ velocity - np.asarray(motion["velocity"])
    time = np.zeros(len(points))
    for _ in range(_ROUNDS):
        turn = Rotation.from_rotvec(time[:, None] * np.asarray(motion["rotation"]), degrees=True)
        pixels, depth = lens.project(turn.inv().apply(own + time[:, None] * relative))
        share = np.clip(np.nan_to_num(pixels[:, 1]) / camera.height, 0, 1) - 0.5
        time = motion.get("readout", 0.0) * share
    return pixels, depth
