"""Depth of the splats from the cameras of the photos, and points on their surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mitsplat.arrays import BoolArray, Float32Array, Float64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import transform_points
from mitsplat.renderer.layers import Layers, render_splats

SIZE = 240
"""Longest edge of the pictures [px]."""
_OPAQUE = 0.5
_STEP = 2
"""Distance between neighbouring surface points, and half the span of the differences for normals [px]."""
_MAX_DEPTH_STEP = 0.05
"""Largest depth difference across a normal's span, as a share of the depth."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """Depth image of a camera.

    Attributes:
        camera: Camera at the size of the picture.
        depth: Depth along the optical axis, infinite where nothing is opaque, (H, W).
    """

    camera: Camera
    depth: Float32Array

    @classmethod
    def of(cls, camera: Camera, layers: Layers, opaque: float = _OPAQUE) -> DepthView:
        """Return the depth of the pixels whose alpha is above ``opaque``."""
        seen = (layers.alpha > opaque) & (layers.depth > 0)
        return cls(camera, np.where(seen, layers.depth, np.inf).astype(np.float32))

    def transformed(self, motion: Float64Array) -> DepthView:
        """Return the view after a rigid motion (4, 4) of camera and scene."""
        return DepthView(self.camera.transformed(motion), self.depth)

    def depths_at(self, points: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return the depths of points (N, 3) and of the surface at their pixels, (N,) each.

        Points outside the view get NaN.
        """
        z = self.camera.project(points)[1]
        surface = self.camera.sample(self.depth, points, missing=np.nan)
        ahead = ~np.isnan(surface) & (z > self.camera.near)
        return np.where(ahead, z, np.nan), np.where(ahead, surface, np.nan)


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on the visible surfaces; the number per photo is proportional to its opaque pixels.

    Attributes:
        places: Positions, shape (N, 3).
        normals: Unit normals towards the camera, (N, 3).
        central: True if a point is in the middle half of its photo, (N,).
    """

    places: Float64Array
    normals: Float64Array
    central: BoolArray

    def transformed(self, motion: Float64Array) -> SurfacePoints:
        """Return the points after a rigid motion (4, 4)."""
        return SurfacePoints(transform_points(motion, self.places), self.normals @ motion[:3, :3].T, self.central)


def depth_views(splats: Splats, cameras: Sequence[Camera], size: int = SIZE) -> list[DepthView]:
    """Render depths of splats from cameras; the longest edge is at most ``size`` px."""
    return [DepthView.of(*render_sized(splats, camera, size)) for camera in cameras]


def render_sized(splats: Splats, camera: Camera, size: int) -> tuple[Camera, Layers]:
    """Render splats with a longest edge of at most ``size`` px; return the resized camera and the layers."""
    small = camera.fitted(size)
    return small, render_splats(splats, small, quality="balanced")


def surface_points(views: Sequence[DepthView]) -> SurfacePoints:
    """Return points and normals of the surfaces in all views, without depth edges."""
    places, normals, central = [], [], []
    for view in views:
        height, width = view.depth.shape
        y, x = np.mgrid[0:height, 0:width] + 0.5
        rays = view.camera.rays(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(height, width, 3)
        depth = np.where(np.isfinite(view.depth), view.depth, np.nan).astype(np.float64)
        local = rays * depth[..., None]
        step, inner = 2 * _STEP, slice(_STEP, -_STEP)
        across, down = local[inner, step:] - local[inner, :-step], local[step:, inner] - local[:-step, inner]
        normal = np.cross(down, across)
        length = np.linalg.norm(normal, axis=-1)
        middle = depth[inner, inner]
        smooth = (
            (np.abs(across[..., 2]) < _MAX_DEPTH_STEP * middle)
            & (np.abs(down[..., 2]) < _MAX_DEPTH_STEP * middle)
            & (length > 0)
        )
        grid = np.zeros_like(smooth)
        grid[::_STEP, ::_STEP] = True
        kept = smooth & grid  # comparisons with NaN are false
        turn = view.camera.world_from_camera[:3, :3].T
        near = np.abs(np.stack([x[inner, inner] / width, y[inner, inner] / height]) - 0.5).max(axis=0) < 0.25
        places.append(local[inner, inner][kept] @ turn + view.camera.centre)
        normals.append(normal[kept] / length[kept, None] @ turn)
        central.append(near[kept])
    if not places:
        return SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=bool))
    return SurfacePoints(np.concatenate(places), np.concatenate(normals), np.concatenate(central))
