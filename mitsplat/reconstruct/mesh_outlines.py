"""Outlines of a mesh in the view of a camera, and the boundaries of masks that they are compared with."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial import KDTree
from skimage.measure import find_contours

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from mitsplat.geometry.camera import Camera
from mitsplat.reconstruct.segment_splats import MaskedView
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, wrapped

_CANDIDATES, _INTERVAL = 2000, 1.0
"""Largest number of points on edges that may be on the outline of a view, and their least distance [px]."""
_ASIDE = 0.1
"""Distance of the rays beside an edge [px]."""
_FINER = 2
"""Rays per pixel and axis for an IoU."""
_EXACT = 4.0
"""Distance from a boundary up to which distances are exact [px]."""


class MeshOutlines:
    """A mesh whose outlines and coverage in views are traced by rays."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._scene = ray_scene({"mesh": plain_mesh(mesh)})
        self._bounds = trimesh.bounds.corners(mesh.bounds)
        welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        welded.merge_vertices(merge_tex=True, merge_norm=True)
        self._vertices = np.asarray(welded.vertices)
        self._edges: Int64Array = np.asarray(welded.face_adjacency_edges)
        self._opposite: Int64Array = np.asarray(welded.face_adjacency_unshared)
        rows = trimesh.grouping.group_rows(welded.edges_sorted, require_count=2)
        self._other_edges = np.unique(np.delete(welded.edges_sorted, rows.ravel(), axis=0), axis=0)

    def outline(self, camera: Camera) -> Float64Array:
        """Return points (N, 3) on the outline of the mesh, at about equal intervals in the image.

        An edge is on the outline if both of its faces lie on one side of the plane through it and the camera, and rays
        that pass it hit the mesh on one side only. Edges that do not have two faces may be on it.
        """
        start, end = (self._vertices[self._edges[:, i]] - camera.centre for i in (0, 1))
        sides = np.einsum("ekd,ed->ek", self._vertices[self._opposite] - camera.centre, np.cross(start, end))
        edges = np.concatenate([self._edges[sides.prod(axis=1) > 0], self._other_edges])
        start, end = self._vertices[edges].swapaxes(0, 1)
        pixels = np.stack([camera.project(start)[0], camera.project(end)[0]])
        length = np.nan_to_num(np.linalg.norm(pixels[1] - pixels[0], axis=1))
        reach = np.concatenate([[0], np.cumsum(length)])
        at = np.arange(0.5 * _INTERVAL, reach[-1], max(_INTERVAL, reach[-1] / _CANDIDATES))
        row = np.minimum(np.searchsorted(reach, at, side="right") - 1, len(edges) - 1)
        share = ((at - reach[row]) / np.maximum(length[row], 1e-12))[:, None]
        points = start[row] + share * (end - start)[row]
        along = (pixels[1] - pixels[0])[row] / np.maximum(length[row], 1e-12)[:, None]
        across = _ASIDE * along[:, ::-1] * (1, -1)
        middle, _ = camera.project(points)
        hit = self._hits(camera, np.concatenate([middle - across, middle + across])).reshape(2, -1)
        found: Float64Array = points[hit[0] != hit[1]]
        return found

    def coverage(self, camera: Camera) -> Float64Array:
        """Return the share of each pixel that the mesh covers, (H, W)."""
        share = np.zeros((camera.height, camera.width))
        left, top, right, bottom = self._window(camera)
        if left < right and top < bottom:
            part = camera.cropped(left, top, right - left, bottom - top)
            fine = part.resized(_FINER * part.width, _FINER * part.height)
            y, x = np.mgrid[: fine.height, : fine.width] + 0.5
            hit = self._hits(fine, np.column_stack([x.ravel(), y.ravel()]))
            share[top:bottom, left:right] = hit.reshape(part.height, _FINER, part.width, _FINER).mean(axis=(1, 3))
        return share

    def _hits(self, camera: Camera, pixels: Float64Array) -> BoolArray:
        """Return True for pixel positions (N, 2) at which a camera sees the mesh."""
        ahead = np.nan_to_num(camera.rays(pixels), nan=1e3) @ camera.world_from_camera[:3, :3].T
        origin = mi.Point3f(*[dr.opaque(mi.Float, float(value)) for value in camera.centre])
        direction = mi.Vector3f(*[wrapped(mi.Float, axis.astype(np.float32)) for axis in ahead.T])
        return np.array(self._scene.ray_test(mi.Ray3f(origin, direction)))

    def _window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Return a rectangle that contains the silhouette: left, top, right and bottom [px]."""
        pixels, _ = camera.project(self._bounds)
        if not camera.is_pinhole or np.isnan(pixels).any():
            return 0, 0, *camera.size
        low = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, camera.size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, camera.size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])


class MaskBoundary:
    """A mask with the signed distances of its pixels from its boundary."""

    def __init__(self, view: MaskedView) -> None:
        self.camera, self._mask, self._known = view.camera, view.mask, view.known
        self._distance = _signed_distances(view.mask)
        self._slopes = np.gradient(self._distance)
        # The boundary of the image counts as unknown.
        self._to_unknown = distance_transform_edt(np.pad(view.known, 1))[1:-1, 1:-1]

    def distances(self, pixels: Float64Array) -> Float64Array:
        """Return the signed distances (N,) [px] of pixel positions (N, 2) from the boundary, negative in the mask."""
        return _interpolated(self._distance, pixels)

    def gradients(self, pixels: Float64Array) -> Float64Array:
        """Return the gradients (N, 2) of :meth:`distances`."""
        return np.column_stack([_interpolated(slope, pixels) for slope in self._slopes[::-1]])

    def has_boundary(self, pixels: Float64Array) -> BoolArray:
        """Return True for pixel positions (N, 2) whose nearest boundary is known."""
        return np.abs(self.distances(pixels)) + 1 < _interpolated(self._to_unknown, pixels)

    def overlap(self, outlines: MeshOutlines, motion: Float64Array) -> float:
        """Return the IoU of mask and silhouette of the mesh after ``motion`` (4, 4), by coverage of known pixels."""
        share = outlines.coverage(self.camera.transformed(np.linalg.inv(motion)))
        both, either = (float(pick(share, self._mask)[self._known].sum()) for pick in (np.minimum, np.maximum))
        return both / max(either, 1e-9)


def contours_of(values: npt.NDArray[np.floating]) -> list[Float64Array]:
    """Return the contours of an image at one half as pixel positions (N, 2)."""
    return [contour[:, ::-1] + 0.5 for contour in find_contours(values, 0.5)]  # type: ignore[no-untyped-call]


def _interpolated(values: Float64Array, pixels: Float64Array) -> Float64Array:
    """Return an image (H, W) at pixel positions (N, 2)."""
    return np.asarray(map_coordinates(values, pixels.T[::-1] - 0.5, order=1, mode="nearest"))


def _signed_distances(mask: Float32Array) -> Float64Array:
    """Return the signed distances of pixel centres from the contours of a mask [px], negative inside, (H, W).

    They are exact near the contours. Elsewhere they have the error of a distance between pixels.
    """
    inside = mask > 0.5
    distance = np.asarray(distance_transform_edt(inside) + distance_transform_edt(~inside)) - 0.5
    row, column = np.nonzero(distance < _EXACT)
    centres = np.column_stack([column, row]) + 0.5
    contours = contours_of(mask)
    starts = np.concatenate([contour[:-1] for contour in contours])
    steps = np.concatenate([np.diff(contour, axis=0) for contour in contours])
    near = KDTree(starts + 0.5 * steps).query(centres, k=min(4, len(starts)))[1].reshape(len(centres), -1)
    away, step = centres[:, None] - starts[near], steps[near]
    along = np.einsum("nkd,nkd->nk", away, step) / np.maximum(np.einsum("nkd,nkd->nk", step, step), 1e-12)
    distance[row, column] = np.linalg.norm(away - np.clip(along, 0, 1)[..., None] * step, axis=2).min(axis=1)
    return np.where(inside, -distance, distance)
