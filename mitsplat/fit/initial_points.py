"""Initial points of a fit: the points of the capture, and random points if there are too few."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array, Float64Array, Int32Array
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.triangulation import nearest_point_to_lines, optical_axes

Mask = Float32Array

_MIN_POINTS = 500
_RANDOM_POINTS = 3000
_HULL_CANDIDATES = 100_000


def seed_points(
    points: Float64Array,
    colours: npt.NDArray[np.uint8],
    cameras: Sequence[Camera],
    seen: Sequence[Int32Array],
    masks: Sequence[Mask] | None,
    rng: np.random.Generator,
    most: int,
) -> tuple[Float64Array, Float64Array]:
    """Return initial points (N, 3) and their display-encoded colours in [0, 1], (N, 3).

    With masks, a point is dropped unless it lies on the object in more than half of the photos that see it. If fewer
    than 500 points remain, grey random points are added: in a ball around the common focus of the cameras, or in the
    visual hull of the masks.

    Args:
        points: Points of the capture, shape (M, 3).
        colours: 8-bit colours of these points, shape (M, 3).
        cameras: Cameras of the training photos.
        seen: Indices of the points that each photo sees; empty if unknown.
        masks: Share of each pixel that the object covers, one image per photo, or None.
        rng: Random number generator.
        most: Largest number of points.
    """
    point_colours = colours / 255.0
    if masks is not None and len(points):
        votes, voters = np.zeros(len(points)), np.zeros(len(points))
        for camera, indices, mask in zip(cameras, seen, masks, strict=True):
            own = indices if len(indices) else np.arange(len(points))
            shown = camera.sample(mask, points[own], missing=-1.0)
            known = shown >= 0
            np.add.at(votes, own[known], shown[known] > 0.5)
            np.add.at(voters, own[known], 1)
        kept = 2 * votes > voters
        points, point_colours = points[kept], point_colours[kept]
    if len(points) < _MIN_POINTS:
        extra = _random_points(cameras, masks, rng)
        points = np.concatenate([points, extra])
        point_colours = np.concatenate([point_colours, np.full(extra.shape, 0.5)])
    if len(points) > most:
        subset = np.sort(rng.choice(len(points), most, replace=False))
        points, point_colours = points[subset], point_colours[subset]
    return points, point_colours


def _random_points(cameras: Sequence[Camera], masks: Sequence[Mask] | None, rng: np.random.Generator) -> Float64Array:
    """Return random points in a ball around the common focus of the cameras, or in the visual hull of masks."""
    centres, axes = optical_axes(cameras)
    focus = nearest_point_to_lines(centres, axes, pull=1e-3 * len(centres))
    reach = float(np.median(np.linalg.norm(centres - focus, axis=1))) or 1.0
    if masks is not None:
        return _hull_points(cameras, masks, reach, rng)
    ball = rng.normal(size=(_RANDOM_POINTS, 3))
    ball *= rng.random((len(ball), 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    return np.asarray(focus + 0.9 * reach * ball)


def _hull_points(
    cameras: Sequence[Camera], masks: Sequence[Mask], reach: float, rng: np.random.Generator
) -> Float64Array:
    """Return random points in the visual hull, at random depths behind pixels of the masks.

    A point belongs to the hull if it is inside at least 90 % of the largest number of masks that share a point.

    Args:
        cameras: Cameras of the masks.
        masks: Share of each pixel that the object covers, one image per camera.
        reach: Distance of the cameras from their common focus.
        rng: Random number generator.
    """
    candidates = [np.zeros((0, 3))]
    for camera, mask in zip(cameras, masks, strict=True):
        rows = np.argwhere(mask > 0.5)
        chosen = rows[rng.integers(len(rows), size=_HULL_CANDIDATES // len(cameras))] if len(rows) else rows
        depths = reach * rng.uniform(0.1, 1.9, len(chosen))
        candidates.append(camera.unproject(chosen[:, ::-1] + rng.random(chosen.shape), depths))
    points = rng.permutation(np.concatenate(candidates))
    inside = np.zeros(len(points))
    for camera, mask in zip(cameras, masks, strict=True):
        inside += camera.sample(mask, points, missing=-1.0) > 0.5
    hull: Float64Array = points[inside >= max(1.0, 0.9 * inside.max(initial=0))]
    return hull[:_RANDOM_POINTS]
