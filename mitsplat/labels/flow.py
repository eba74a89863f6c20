"""Optical flow to the next image, for moving cameras and moving objects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, FloatingArray, IntegerArray
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import transform_points
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import Belt

UNKNOWN_FLOW, MAX_FLOW = 1e10, 1e9
"""Value of both components where no flow exists, and limit of flow [px]; values above it mean unknown in Middlebury's
files.
"""


def optical_flow(
    depth: FloatingArray,
    camera: Camera,
    next_camera: Camera,
    ids: IntegerArray | None = None,
    motions: Mapping[int, Float64Array | None] | None = None,
    belt: Belt | None = None,
) -> Float32Array:
    """Compute the motion of every pixel to the next image [px], (H, W, 2).

    The flow is :data:`UNKNOWN_FLOW` where the pixel shows nothing, or where its point lies behind the next camera, at
    more than :data:`MAX_FLOW` from the pixel, or belongs to an object that is removed. Points that become occluded in
    the next image have ordinary flow.

    Args:
        depth: Depth along the optical axis [m], 0 for no surface, (H, W).
        camera: Camera of the depth image.
        next_camera: Camera of the next image.
        ids: Instance of every pixel, (H, W); required for moving objects.
        motions: For each moving instance, the world transform (4, 4) from its present to its next pose, or None if the
            instance is removed. Instances that are not listed do not move.
        belt: Conveyor belt whose surface moves where no instance is visible; requires ``ids``.
    """
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    known = depth.ravel() > 0
    points = camera.unproject(pixels, depth)
    for instance, motion in (motions or {}).items():
        mask = np.ravel(ids == instance)
        if motion is None:
            known &= ~mask
        else:
            points[mask] = transform_points(motion, points[mask])
    if belt is not None:
        points[np.ravel(ids == 0) & belt.on_surface(points)] += belt.interval * belt.velocity
    next_pixels, next_depth = next_camera.project(points)
    flow = next_pixels - pixels
    with np.errstate(invalid="ignore"):
        known &= (next_depth > next_camera.near) & (np.abs(flow) < MAX_FLOW).all(axis=1)
    flow = np.where(known[:, None], flow, UNKNOWN_FLOW)
    return flow.reshape(height, width, 2).astype(np.float32)


def exposure_flow(
    depth: FloatingArray, camera: Camera, exposure: float, belt: Belt, carried: BoolArray
) -> tuple[Float32Array, Float32Array]:
    """Compute the motion of every pixel to the right and down [px] during the exposure, each (H, W).

    The camera stands still; a belt and the objects that it carries move. The motion field is evaluated in the middle of
    the exposure (Longuet-Higgins and Prazdny 1980, "The interpretation of a moving retinal image").

    Args:
        depth: Depth along the optical axis [m], 0 for no surface, (H, W).
        camera: The camera.
        exposure: Exposure time [s].
        belt: Conveyor belt. Pixels of its surface are found from their depth.
        carried: Mask of the pixels that show carried objects, (H, W).
    """
    height, width = depth.shape
    columns, rows = np.arange(width) + 0.5, np.arange(height) + 0.5
    distorted = not camera.is_pinhole
    if distorted:
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        x, y = camera.ray_slopes(pixels).astype(np.float32).T.reshape(2, height, width)
    else:
        x = ((columns - camera.cx) / camera.fx).astype(np.float32)[None, :]
        y = ((rows - camera.cy) / camera.fy).astype(np.float32)[:, None]
    inverse_depth = np.divide(1, depth, where=depth > 0, out=np.zeros(depth.shape, dtype=np.float32))
    rotation, centre = camera.world_from_camera[:3, :3], camera.centre
    points = np.stack(np.broadcast_arrays(x * depth, y * depth, depth), axis=-1) @ rotation.T + centre
    moving = carried | belt.on_surface(points.reshape(-1, 3)).reshape(height, width)
    # The motion field depends on the camera's motion relative to the pixel's surface.
    vx, vy, vz = (-np.float32(v) * moving for v in exposure * (rotation.T @ belt.velocity))
    u, v = inverse_depth * (x * vz - vx), inverse_depth * (y * vz - vy)
    if not distorted:
        return u * np.float32(camera.fx), v * np.float32(camera.fy)
    (x_down, x_right), (y_down, y_right) = np.gradient(x), np.gradient(y)
    determinant = x_right * y_down - x_down * y_right
    return (u * y_down - v * x_down) / determinant, (v * x_right - u * y_right) / determinant


def instance_motions(layout: Layout, next_layout: Layout) -> dict[int, Float64Array | None]:
    """Compute the motions (4, 4) of instances between two layouts, for :func:`optical_flow`."""
    motions: dict[int, Float64Array | None] = {}
    next_poses = {instance.id: instance.world_from_object for instance in next_layout.instances}
    for instance in layout.instances:
        pose, next_pose = instance.world_from_object, next_poses.get(instance.id)
        if next_pose is None:
            motions[instance.id] = None
        elif not np.array_equal(pose, next_pose):
            motions[instance.id] = next_pose @ np.linalg.inv(pose)
    return motions
