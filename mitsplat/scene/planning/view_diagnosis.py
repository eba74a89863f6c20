"""Likely causes of a camera that sees nothing: the unit, the axes or the direction of its matrix."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL

FAR = 10.0
"""Distance of a camera from all objects above which its position is probably in millimetres [m]."""
STEEP = 0.5
"""Sine of the angle from below at which what supports the objects hides them from a camera."""


def sees(camera: Camera, low: Float64Array, high: Float64Array) -> bool:
    """Return True if a camera sees any part of a box of corners (3,) [m]; occluders are ignored.

    A grid of points in the box detects boxes that are small in the image. A grid of camera rays detects large ones.
    """
    grid = np.stack(np.meshgrid(*([np.linspace(0, 1, 9)] * 3), indexing="ij"), axis=-1).reshape(-1, 3)
    pixels, depth = camera.project(low + grid * (high - low))
    with np.errstate(invalid="ignore"):
        shown = camera.contains(pixels) & (depth > camera.near)
    if shown.any():
        return True
    across = np.stack(np.meshgrid(np.linspace(0, camera.width, 17), np.linspace(0, camera.height, 17)), axis=-1)
    # The directions have depth 1, so the ray parameter is the depth.
    rays = camera.rays(across.reshape(-1, 2)) @ camera.world_from_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - camera.centre) / rays, (high - camera.centre) / rays])
    first, last = np.nanmax(ends.min(axis=0), axis=1), np.nanmin(ends.max(axis=0), axis=1)
    return bool((np.maximum(first, camera.near) < last).any())


def distance_to_box(point: Float64Array, low: Float64Array, high: Float64Array) -> float:
    """Return the distance of a point (3,) from a box of corners (3,) [m]; 0 inside."""
    return float(np.linalg.norm(np.maximum(0, np.maximum(low - point, point - high))))


def pose_cause(camera: Camera, low: Float64Array, high: Float64Array) -> str:
    """Return the likely cause, a question, of a camera that sees no box of corners (3,) [m]; empty if there is none.

    A cause is likely if the camera without it sees the box from outside, and not steeply from below. Of several causes,
    the one is taken with which the camera looks most directly at the middle of the box.
    """
    best, found = np.inf, ""
    far = distance_to_box(camera.centre, low, high) > FAR
    for cause, pose in _candidates(camera.world_from_camera, far=far):
        candidate = replace(camera, world_from_camera=pose)
        if distance_to_box(candidate.centre, low, high) > 0 and sees(candidate, low, high):
            ahead = _direction(candidate, low, high)
            off = float(np.arccos(np.clip(ahead @ pose[:3, 2], -1, 1)))
            if ahead[2] < STEEP and off < best - 1e-6:
                best, found = off, cause
    if not found and not far and _direction(camera, low, high)[2] > STEEP:
        return f"the camera is below the objects, at z = {camera.centre[2]:.3g} m: does z of its world point up?"
    return found or ("is its position in millimetres?" if far else "")


def _direction(camera: Camera, low: Float64Array, high: Float64Array) -> Float64Array:
    """Return the unit vector from a camera to the middle of a box; zeros if the camera is there."""
    ahead = (low + high) / 2 - camera.centre
    return np.asarray(ahead / max(float(np.linalg.norm(ahead)), 1e-12), np.float64)


def _candidates(pose: Float64Array, *, far: bool) -> Iterator[tuple[str, Float64Array]]:
    """Yield possible mistakes in a pose, and the pose without them. Positions in millimetres must be far away."""
    metric = pose.copy()
    metric[:3, 3] *= 1e-3 if far else 1.0
    exchanged = metric.copy()
    exchanged[:3, :3] = metric[:3, :3].T
    unit = " in millimetres, and" if far else ""
    if far:
        yield "is its position in millimetres?", metric
    cause = f"is its matrix{unit} in the axes of OpenGL (y up, z backwards), for Camera.from_opengl?"
    yield cause, metric @ OPENCV_FROM_OPENGL
    yield f"is its matrix{unit} the inverse, camera_from_world?", np.asarray(np.linalg.inv(metric), np.float64)
    both = np.asarray(np.linalg.inv(OPENCV_FROM_OPENGL @ metric), np.float64)
    yield f"is its matrix{unit} the inverse, in the axes of OpenGL (y up, z backwards)?", both
    yield f"is its matrix{unit} one whose rotation has rows and columns exchanged?", exchanged
