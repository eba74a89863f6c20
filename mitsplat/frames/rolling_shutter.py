"""Images with row-wise exposure (rolling shutter) while the camera moves and a belt runs.

An image is rendered in bands of rows. Each band shows the moment at which its middle row is exposed. The number of
bands limits the displacement within a band to a quarter of a pixel from each row's own moment. An image in which
nothing moves by half a pixel is rendered in one piece.
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
"""Maximum image motion during the read-out of a band [px]."""

MOST_BANDS = 64
"""Maximum number of bands. With faster motion, the motion within a band exceeds `MOST_MOVED`."""

MARGIN = 8
"""Extra rows rendered above and below a band, so that light is averaged as inside an image.

Rendered bands begin at multiples of the margin, where the patterns of rays and tiles repeat.
"""

_ITERATIONS = 8
"""Fixed-point iterations for a point's row and its moment.

Each iteration reduces the error by the factor (image motion during read-out) / (image height).
"""


@dataclass(frozen=True, eq=False)
class Band:
    """Rows of an image that are rendered for one moment.

    Attributes:
        camera: Camera at that moment, for an image of only these rows and a margin.
        first, end: Row range in the full image.
        top: Row of the full image that is row 0 of the band's camera.
        time: The moment, relative to the exposure of the image's middle row [s].
    """

    camera: Camera
    first: int
    end: int
    top: int
    time: float

    @property
    def rows(self) -> slice:
        """Rows of the band in the image of the band's camera."""
        return slice(self.first - self.top, self.end - self.top)


def bands_of(camera: Camera, motion: Mapping[str, Any], swept: Sequence[npt.NDArray[np.floating[Any]]]) -> list[Band]:
    """Split an image into bands; return an empty list if one exposure suffices.

    Args:
        camera: Camera at the exposure of the middle row.
        motion: Camera motion as in :class:`mitsplat.scene.planning.viewpoints.Viewpoint`.
        swept: Image motion of the pixels during that exposure [px], see :func:`mitsplat.frames.flow.swept_by`.
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
    """Assemble the silhouettes of instances in the full image from those in the bands.

    Parts above and below the image are taken from the first and the last band.
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
    return {instance: _union(those) for instance, those in sorted(found.items())}


def _union(parts: Sequence[Silhouette]) -> Silhouette:
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
    """Project world points to pixels (N, 2) and depths [m] (N,), at the moments of the rows that show the points.

    Args:
        camera: Camera at the exposure of the middle row.
        motion: Camera motion as in :class:`mitsplat.scene.planning.viewpoints.Viewpoint`.
        points: Positions of the points at that moment [m], shape (N, 3).
        velocity: Velocity of the points [m/s], shape (3,).
    """
    rotation, lens = camera.world_from_camera[:3, :3], replace(camera, world_from_camera=np.eye(4))
    camera_points = (points - camera.centre) @ rotation
    relative = rotation.T @ velocity - np.asarray(motion["velocity"])
    time = np.zeros(len(points))
    for _ in range(_ITERATIONS):
        turn = Rotation.from_rotvec(time[:, None] * np.asarray(motion["rotation"]), degrees=True)
        pixels, depth = lens.project(turn.inv().apply(camera_points + time[:, None] * relative))
        share = np.clip(np.nan_to_num(pixels[:, 1]) / camera.height, 0, 1) - 0.5
        time = motion.get("readout", 0.0) * share
    return pixels, depth
