"""Cells of a support with the colours of its bare surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import binary_closing, binary_fill_holes, distance_transform_edt

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from mitsplat.capture.capture import Capture
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.surroundings.coverage import MIN_PHOTOS, SUPPORT_TOLERANCE
from mitsplat.surroundings.depth_views import DepthView, render_sized
from mitsplat.surroundings.supports import Support

CELL = 0.004
"""Edge of the cells that fill a support, as a share of the typical depth."""
_BARE_HEIGHT = 0.25
"""Largest height of the bare support, as a share of the height that separates it from objects."""
_VIEW_SIZE = 400
"""Longest edge of the pictures for the support's colours [px]."""
_OPAQUE = 0.9
_BORDER = cv2.BORDER_REPLICATE
_SIGMA_ALONG, _SIGMA_ACROSS = 0.7, 0.1
"""Standard deviations of the sheet's Gaussians in its plane and along its normal [cells]."""


@dataclass(eq=False)
class Ground:
    """Texture of a support in the photos; it changes when objects are removed.

    Attributes:
        support: The support.
        grid: Cells of the support.
        texture: Display-encoded colours of the cells, (X, Y, 3).
        seen: True for cells that enough photos show bare, or that are filled, (X, Y).
    """

    support: Support
    grid: Grid
    texture: Float64Array
    seen: BoolArray

    @classmethod
    def of(cls, support: Support, splats: Splats, capture: Capture, scale: float) -> Ground:
        """Compute the texture of a support from the training photos; ``scale`` is their typical depth."""
        inverse, grid = np.linalg.inv(support.pose), Grid.of(support, CELL * scale)
        cameras = [photo.camera.transformed(inverse) for photo in capture.training]
        return cls(
            support,
            grid,
            *grid.bare_colours(splats.transformed(inverse), cameras, _BARE_HEIGHT * SUPPORT_TOLERANCE * scale),
        )


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells of a support in its frame, first axis x.

    Attributes:
        cell: Edge of a cell.
        middles: Centres of the cells, (X, Y, 2).
    """

    cell: float
    middles: Float64Array

    @classmethod
    def of(cls, support: Support, cell: float) -> Grid:
        """Return cells of the given edge that fill a support."""
        sides = [(np.arange(max(1, int(edge / cell))) + 0.5) * cell for edge in support.size]
        x, y = (side - side.mean() for side in sides)
        return cls(cell, np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))

    def cells(self, flat: Float64Array) -> Int64Array:
        """Return the cell indices of positions (N, 2), shape (N, 2); -1 outside the support."""
        index = np.floor((flat - self.middles[0, 0]) / self.cell + 0.5).astype(np.int64)
        outside = ((index < 0) | (index >= self.middles.shape[:2])).any(axis=1)
        return np.where(outside[:, None], -1, index)

    def covered(self, points: Float64Array) -> BoolArray:
        """Return True for cells that contain or lie below points (N, 2 or 3), with gaps between samples closed."""
        covered = np.zeros(self.middles.shape[:2], dtype=bool)
        cells = self.cells(points[:, :2])
        covered[tuple(cells[(cells >= 0).all(axis=1)].T)] = True
        closed = np.asarray(binary_closing(np.pad(covered, 4), np.ones((3, 3)), iterations=3))
        return closed[4:-4, 4:-4]

    def _top_heights(self, points: Float64Array) -> Float64Array:
        """Return the largest height of points (N, 3) in each cell (X, Y), 0 without points."""
        top = np.zeros(self.middles.shape[:2])
        cells = self.cells(points[:, :2])
        within = (cells >= 0).all(axis=1)
        np.maximum.at(top, tuple(cells[within].T), points[within, 2])
        return top

    def inside(self, points: Float64Array, footprint: BoolArray, depth: float) -> Float64Array:
        """Return a lattice of positions (M, 3) inside an object, below its surface points.

        The positions are at least ``depth`` from sides, top and ground; ``depth`` is also the step of the lattice.
        """
        top = self._top_heights(points)
        near = distance_transform_edt(top == 0, return_distances=False, return_indices=True)
        deep = distance_transform_edt(np.pad(footprint, 1))[1:-1, 1:-1] * self.cell > depth
        step = max(1, int(depth / self.cell))
        x, y = np.nonzero(deep[::step, ::step])
        columns = [
            np.column_stack([np.tile(self.middles[i, j], (len(z), 1)), z])
            for i, j in zip(step * x, step * y, strict=True)
            if len(z := np.arange(depth, top[near[0, i, j], near[1, i, j]] - depth, depth))
        ]
        return np.concatenate([np.zeros((0, 3)), *columns])

    def outline(self, points: Float64Array) -> BoolArray:
        """Return the cells (X, Y) that the points (N, 3) of one object cover, with holes filled."""
        return np.asarray(binary_fill_holes(self.covered(points)))

    def bare_colours(self, splats: Splats, cameras: Sequence[Camera], height: float) -> tuple[Float64Array, BoolArray]:
        """Return display-encoded colours (X, Y, 3) of the bare support, and True for cells with enough bare views.

        Cameras with near and steep views have larger weights. Cameras below the support show its lower side, and are
        left out.
        """
        shape = self.middles.shape[:2]
        places = np.concatenate([self.middles, np.zeros((*shape, 1))], axis=2).reshape(-1, 3)
        colours, weights, count = np.zeros((*shape, 3)), np.full(shape, 1e-12), np.zeros(shape, dtype=np.int64)
        for camera in (camera for camera in cameras if camera.centre[2] > 0):
            view, shown = _render_view(splats, camera)
            depth, surface = view.depths_at(places)
            bare = np.abs(view.camera.centre[2] * (1 - surface / depth)) < height  # False for NaN
            towards = places - view.camera.centre
            weight = np.where(bare, -towards[:, 2] / np.linalg.norm(towards, axis=1) ** 3, 0.0).reshape(shape)
            x, y = np.nan_to_num(view.camera.project(places)[0] - 0.5).astype(np.float32).T.reshape(2, *shape)
            colours += weight[..., None] * np.asarray(cv2.remap(shown, x, y, cv2.INTER_LINEAR, borderMode=_BORDER))
            weights += weight
            count += bare.reshape(shape)
        return colours / weights[..., None], np.asarray(count >= MIN_PHOTOS)

    def sheet(self, texture: Float64Array, cells: BoolArray) -> Splats:
        """Return flat Gaussians with a texture's display-encoded colours (X, Y, 3) in the given cells."""
        flat = self.middles[cells]
        count = len(flat)
        return Splats(
            means=np.column_stack([flat, np.zeros(count)]).astype(np.float32),
            quats=np.tile(np.array([0, 0, 0, 1], dtype=np.float32), (count, 1)),
            scales=np.tile(
                np.array([_SIGMA_ALONG, _SIGMA_ALONG, _SIGMA_ACROSS], dtype=np.float32) * np.float32(self.cell),
                (count, 1),
            ),
            opacities=np.full(count, 0.95, dtype=np.float32),
            sh=rgb_to_sh(texture[cells])[:, None].astype(np.float32),
        )


def _render_view(splats: Splats, camera: Camera) -> tuple[DepthView, Float32Array]:
    """Render depth and display-encoded colours; the longest edge is at most :data:`_VIEW_SIZE` px."""
    small, layers = render_sized(splats, camera, _VIEW_SIZE)
    shown = encode_srgb(layers.captured / np.maximum(layers.alpha, 1e-6)[..., None])
    return DepthView.of(small, layers, _OPAQUE), np.asarray(shown, dtype=np.float32)
