"""Radiance of surface points in the photographs that show them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from mitsplat.capture.capture import Photo, known_where
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_normals import corner_normals
from mitsplat.images.colour import decode_srgb
from mitsplat.reconstruct.materials.surface_light import LitMesh

_MIN_COSINE = 0.2
"""Least cosine between normal and camera of an observation."""
CLIPPED = 0.97
"""Linear radiance from which a pixel may be clipped, as a share of that of white."""
_MIN_OPENNESS, _MIN_FLATNESS = 0.9, 0.97
"""Limits of clear points: share of the hemisphere without the object, and mean cosine of the normals in two pixels."""


class View(NamedTuple):
    """Linear radiance of a photo, and its pixels that show only the object, or only other objects.

    Attributes:
        camera: Camera of the pixels.
        radiance: Linear radiance, (H, W, 3).
        object: True for pixels that show only the object, (H, W).
        surroundings: True for known pixels that show only other objects, (H, W).
        white: Largest radiance that the photo can show, which depends on its exposure correction, shape (3,).
    """

    camera: Camera
    radiance: Float32Array
    object: BoolArray
    surroundings: BoolArray
    white: Float32Array

    @classmethod
    def of(cls, photo: Photo, size: int) -> View:
        """Read a photo, reduced to a longest edge of ``size`` pixels."""
        camera, rgb, mask, hidden = photo.fitted(size)
        known = known_where(hidden, camera)
        inside = np.zeros(known.shape, dtype=bool) if mask is None else mask > 0.5
        outside = known & ~binary_dilation(inside, iterations=2)
        white = np.minimum(photo.gain or np.ones(3), 1).astype(np.float32)
        return cls(camera, decode_srgb(rgb).astype(np.float32), known & binary_erosion(inside), outside, white)


class Observations(NamedTuple):
    """Observations of points, sorted by point.

    Attributes:
        point: Index of the point, (R,).
        radiance: Linear radiance, (R, 3).
        to_camera: Unit vectors towards the camera, (R, 3).
        clipped: True where the radiance is only a lower bound, (R, 3).
    """

    point: Int64Array
    radiance: Float64Array
    to_camera: Float64Array
    clipped: BoolArray

    def in_order(self) -> Observations:
        """Return the observations sorted by point."""
        order = np.argsort(self.point, kind="stable")
        return Observations(self.point[order], *self._at(order))

    def select(self, points: Int64Array) -> tuple[Observations, BoolArray]:
        """Return the observations of sorted ``points``, renumbered, and the mask (R,) of these observations."""
        rows = np.isin(self.point, points)
        return Observations(np.searchsorted(points, self.point[rows]), *self._at(rows)), rows

    def _at(self, rows: BoolArray | Int64Array) -> tuple[Float64Array, Float64Array, BoolArray]:
        """Return radiance, directions and clipping of some observations."""
        return self.radiance[rows], self.to_camera[rows], self.clipped[rows]


def sample_surface(mesh: trimesh.Trimesh, count: int, seed: int = 0) -> tuple[Float64Array, Float64Array]:
    """Return random points (N, 3) on a mesh and their smooth unit normals (N, 3)."""
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    points = np.asarray(points)
    barycentric = np.nan_to_num(trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points), nan=1 / 3)
    normals = np.einsum("nk,nkd->nd", barycentric, corner_normals(mesh)[faces])
    return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def observe(
    surfaces: LitMesh, points: Float64Array, normals: Float64Array, views: Sequence[View], shown: str
) -> Observations:
    """Return the observations of points (N, 3) in the pixels that show ``object`` or ``surroundings``."""
    found = []
    for view in views:
        to_camera = view.camera.centre - points
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        pixels, _ = view.camera.project(points)
        inside = ((pixels >= 1) & (pixels <= (view.camera.width - 1, view.camera.height - 1))).all(axis=1)
        rows = np.flatnonzero(inside & (np.einsum("nd,nd->n", normals, to_camera) > _MIN_COSINE))
        whole = cv2.erode(getattr(view, shown).astype(np.uint8), np.ones((2, 2), np.uint8), anchor=(0, 0))
        column, line = np.floor(pixels[rows] - 0.5).astype(int).T
        rows = rows[whole[line, column] > 0]
        rows = rows[surfaces.unoccluded(points[rows], normals[rows], view.camera.centre)] if len(rows) else rows
        if not len(rows):
            continue
        x, y = (pixels[rows].T[..., None] - 0.5).astype(np.float32)
        radiance = np.asarray(cv2.remap(view.radiance, x, y, cv2.INTER_LINEAR))[:, 0]
        bright = cv2.dilate((view.radiance >= CLIPPED * view.white).astype(np.float32), np.ones((3, 3)))
        clipped = np.asarray(cv2.remap(np.asarray(bright), x, y, cv2.INTER_NEAREST))[:, 0] > 0
        radiance = np.where(clipped, np.maximum(radiance, view.white), radiance)
        found.append((rows, radiance.astype(np.float64), to_camera[rows], clipped))
    if not found:
        return Observations(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), bool))
    return Observations(*(np.concatenate(parts) for parts in zip(*found, strict=True))).in_order()


def clear_points(
    mesh: trimesh.Trimesh, surfaces: LitMesh, points: Float64Array, normals: Float64Array, views: Sequence[View]
) -> BoolArray:
    """Return True for points (N,) that mirror little of the object itself, and that are flat within two pixels."""
    camera = views[0].camera
    pixel = float(np.linalg.norm(camera.centre - mesh.bounds.mean(axis=0))) / camera.fx
    others, their_normals = sample_surface(mesh, 10 * len(points), seed=1)
    near = KDTree(others).query_ball_point(points, 2 * pixel)
    flatness = np.array([normals[i] @ their_normals[rows].mean(axis=0) if rows else 1 for i, rows in enumerate(near)])
    clear = (flatness > _MIN_FLATNESS) & (surfaces.openness(points, normals) > _MIN_OPENNESS)
    return np.asarray(clear)
