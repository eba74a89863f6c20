"""Rays between the camera and keypoints. A keypoint is hidden if a surface blocks all of its rays.

The rays end at the proxy surface of the keypoint's own object, so that this object hides its own far side, but not the
point itself. Rays are straight under every lens distortion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.asset import Asset
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import transform_points

if TYPE_CHECKING:
    from mitsplat.scene.layout import Instance

SURFACE_DISTANCE = 0.01
"""Maximum distance from the proxy surface, as a share of its diagonal, at which a keypoint is a point of the surface.

It allows for the error of proxies. Points that are farther away, such as the centre of a hole, stay where they are.
"""

RAY_TOLERANCE = 1e-4
"""Length by which rays end before the keypoint, as a share of the distance to the camera: 0.1 mm at 1 m."""

_RAY_OFFSET = 1e-5
"""Distance between the ray to a keypoint and four rays beside it, as a share of the distance to the camera.

They pass corners and edges that a ray only touches.
"""


@lru_cache(maxsize=256)
def surface_keypoints(asset: Asset) -> Float64Array:
    """Return the keypoints of an asset [m], those near its proxy surface moved onto it, shape (K, 3)."""
    points = asset.keypoint_array
    if asset.mesh is None or not len(asset.mesh.faces):
        return points
    triangles = asset.mesh.triangles
    for point in points:
        nearest = trimesh.triangles.closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
        distances = np.linalg.norm(nearest - point, axis=1)
        if distances.min() <= SURFACE_DISTANCE * asset.mesh.scale:
            point[:] = nearest[distances.argmin()]
    return points


def find_blocked_keypoints(
    assets: Sequence[Asset],
    instances: Iterable[Instance],
    camera: Camera,
    find_hits: Callable[[Float64Array, Float64Array], BoolArray],
) -> dict[int, BoolArray]:
    """Find the keypoints of labelled instances that a mesh hides.

    Args:
        assets: Assets of the scene.
        instances: Placed instances.
        camera: The camera.
        find_hits: Function that returns True for the segments between points (N, 3) [m] that a mesh intersects.

    Returns:
        True for the hidden keypoints by instance id, shape (K,) each.
    """
    shown = [one for one in instances if assets[one.asset].keypoints and one.class_index is not None]
    if not shown:
        return {}
    poses = [(one.world_from_object, surface_keypoints(assets[one.asset])) for one in shown]
    points = np.concatenate([transform_points(pose, local) for pose, local in poses])
    starts, ends = _keypoint_rays(points, camera)
    blocked = find_hits(starts.reshape(-1, 3), ends.reshape(-1, 3)).reshape(len(points), -1).all(axis=1)
    counts = np.cumsum([len(local) for _, local in poses])
    return dict(zip((one.id for one in shown), np.split(blocked, counts[:-1]), strict=True))


def _keypoint_rays(points: Float64Array, camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Return starts and ends of five rays to each of the points (N, 3), shape (N, 5, 3) each [m].

    The rays begin at the near plane, before which nothing is rendered. Rays to points before it are
    meaningless; such points have no label.
    """
    right, down, forward = camera.world_from_camera[:3, :3].T
    way = points - camera.centre
    distance = np.linalg.norm(way, axis=1)[:, None, None]
    beside = np.array([right * 0, right, -right, down, -down])
    ways = way[:, None] + _RAY_OFFSET * distance * beside
    starts = camera.centre + ways * (camera.near / np.maximum(ways @ forward, camera.near))[..., None]
    return starts, camera.centre + ways * (1 - RAY_TOLERANCE)
