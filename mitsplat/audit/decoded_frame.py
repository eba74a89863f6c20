"""Frame of the manifest with decoded masks, poses and camera; the audit compares all other files with its values.

The code that wrote the files is not used. Masks are decoded by pycocotools, poses are inverted by NumPy, points are
projected by OpenCV, and all other values are counted.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.images.masks import Box, decode_rle
from mitsplat.storage.files import JsonObject, Record

_RANGE, _DISTORTED_RANGES = (1.0,), (1.0, 0.5, 0.25, 0.125, 0.0)
"""Possible margins around the image, in its width and height, in which the pixels of silhouettes are counted.

A pinhole camera has one margin. A distorted lens has the largest of several margins in which its model can be inverted.
"""


class DecodedInstance:
    """Instance of a frame with its masks, which are not empty.

    Attributes:
        entry: Label of the instance in the manifest.
        id, class_index: Value in id maps, and class index.
        name: Beginning of messages about the instance.
        pose: ``world_from_object``, shape (4, 4) [m].
        box, mask: Bounds of the visible pixels, counted from the mask, and visible pixels in these bounds.
        amodal_box, amodal: Bounds and pixels of the part of the silhouette in the image.
        area, amodal_area: Numbers of pixels of both masks.
        silhouette_area: Number of pixels of the silhouette, also beyond the image's border, as stated in the manifest.
        visible_fraction: Visible pixels over the pixels of the silhouette in the image.
        reaches_range: True if the silhouette reaches the end of the range in which its pixels are counted.
        truncation: Fraction of the silhouette beyond the image's border. For a silhouette that reaches the end of its
            range, this is the fraction in the manifest if that is larger.
    """

    def __init__(self, entry: JsonObject, width: int, height: int, *, is_distorted: bool = False) -> None:
        self.entry = entry
        self.id, self.class_index = int(entry["id"]), int(entry["class_index"])
        self.name = f"instance {self.id}"
        self.pose: Float64Array = np.array(entry["world_from_object"], dtype=np.float64)
        self.box, self.mask = _decode(entry["rle"], width, height)
        self.amodal_box, self.amodal = _decode(entry["amodal_rle"], width, height)
        self.area, self.amodal_area = int(np.count_nonzero(self.mask)), int(np.count_nonzero(self.amodal))
        self.silhouette_area = int(entry["silhouette_area"])
        self.visible_fraction = self.area / self.amodal_area
        self.truncation = 1 - self.amodal_area / self.silhouette_area
        x0, y0, x1, y1 = entry["silhouette_box"]
        outside = (-x0, width), (-y0, height), (x1 - width, width), (y1 - height, height)
        ranges = _DISTORTED_RANGES if is_distorted else _RANGE
        self.reaches_range = any(part == int(share * side) for part, side in outside for share in ranges)
        if self.reaches_range:
            self.truncation = max(self.truncation, float(entry["truncation"]))


class DecodedFrame:
    """Record of a frame, with its dataset and its decoded instances.

    Args:
        root: Dataset folder.
        record: Record of the frame, which :mod:`mitsplat.dataset.records.record_schema` has checked.
        content: Content of ``dataset.json``.

    Attributes:
        index, split: Index of the frame, and name of its split.
        size: Width and height [px].
        formats: Formats of the dataset.
        image_name: File name of the frame's picture.
        bop_folder: Folder of the frame's layout in BOP, relative to the dataset.
        has_splat_labels: True if labels come from the splats, as depths do.
        world_from_camera: Camera pose [m], shape (4, 4).
        intrinsics: Intrinsic matrix [px], pixel centres at +0.5, shape (3, 3).
        distortion: Distortion coefficients of OpenCV.
        instances: Decoded instances.
    """

    def __init__(self, root: Path, record: Record, content: JsonObject) -> None:
        self.root, self.record, self.content = root, record, content
        scene, labels, camera = content["scene"], record["labels"], record["camera"]
        self.index, self.split = int(record["index"]), str(record["split"])
        self.size: tuple[int, int] = (labels["size"][0], labels["size"][1])
        self.formats: list[str] = scene["output"]["formats"]
        self.image_name = f"{self.index:06d}.{scene['output']['image']}"
        self.bop_folder = f"bop/{self.split}/{record['layout']:06d}"
        self.has_splat_labels = bool(scene["labels"]["source"] == "splats")
        self.world_from_camera: Float64Array = np.array(camera["world_from_camera"], dtype=np.float64)
        self.intrinsics: Float64Array = np.array(camera["intrinsics"], dtype=np.float64)
        self.distortion: Float64Array = np.array(camera["distortion"], dtype=np.float64)
        self.instances = tuple(
            DecodedInstance(entry, *self.size, is_distorted=bool(self.distortion.any()))
            for entry in labels["instances"]
        )

    def full_mask(self, instance: DecodedInstance, *, amodal: bool = False) -> BoolArray:
        """Return the visible pixels of an instance, or its silhouette, in the whole image (H, W)."""
        canvas = np.zeros(self.size[::-1], dtype=bool)
        x0, y0, x1, y1 = instance.amodal_box if amodal else instance.box
        canvas[y0:y1, x0:x1] = instance.amodal if amodal else instance.mask
        return canvas

    @cached_property
    def ids(self) -> Int64Array:
        """Id of the labelled instance of every pixel, shape (H, W); 0 is any other pixel."""
        return self._paint([instance.id for instance in self.instances])

    @cached_property
    def classes(self) -> Int64Array:
        """Class index + 1 of every labelled pixel, shape (H, W); 0 is any other pixel."""
        return self._paint([instance.class_index + 1 for instance in self.instances])

    def _paint(self, values: list[int]) -> Int64Array:
        canvas = np.zeros(self.size[::-1], dtype=np.int64)
        for instance, value in zip(self.instances, values, strict=True):
            x0, y0, x1, y1 = instance.box
            canvas[y0:y1, x0:x1][instance.mask] = value
        return canvas

    @cached_property
    def camera_from_world(self) -> Float64Array:
        """Inverse camera pose [m], shape (4, 4)."""
        return np.asarray(np.linalg.inv(self.world_from_camera))

    def project(self, points: Float64Array) -> Float64Array:
        """Project points in the camera's frame (N, 3), all in front of the camera, to pixels (N, 2)."""
        points, zero = np.ascontiguousarray(points).reshape(-1, 1, 3), np.zeros(3)
        if self.record["camera"]["lens"] == "fisheye":
            pixels, _ = cv2.fisheye.projectPoints(points, zero, zero, self.intrinsics, self.distortion)
        else:
            pixels, _ = cv2.projectPoints(points, zero, zero, self.intrinsics, self.distortion)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    def has_no_pixel(self, points: Float64Array) -> BoolArray:
        """Return True for points in the camera's frame (N, 3) that no pixel can show.

        With growing angle to the axis, the pixel of a ray must move away from the principal point. Rays are excluded
        from the angle at which it first moves back. Rays of a fisheye lens are also excluded beyond 85 degrees.
        """
        slopes = points[:, :2] / points[:, 2:]
        beyond = np.zeros(len(points), dtype=bool)
        if self.record["camera"]["lens"] == "fisheye":
            beyond |= np.linalg.norm(slopes, axis=1) > np.tan(np.radians(85.0))
        last = np.zeros(len(points))
        for step in np.linspace(0, 1, 33)[1:] if len(points) and self.distortion.any() else ():
            shown = self.project(np.column_stack([step * slopes, np.ones(len(slopes))]))
            away = np.linalg.norm(shown - self.intrinsics[:2, 2], axis=1)
            beyond |= away < last
            last = away
        return beyond

    def ray_slopes(self, pixels: Float64Array) -> Float64Array:
        """Return the ray slopes (x / z, y / z) of pixels; both have shape (N, 2)."""
        pixels = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        if self.record["camera"]["lens"] == "fisheye":
            slopes = cv2.fisheye.undistortPoints(pixels, self.intrinsics, self.distortion, criteria=criteria)
        else:
            eye = np.eye(3)
            slopes = cv2.undistortPoints(pixels, self.intrinsics, self.distortion, None, eye, eye, criteria)
        return np.asarray(slopes, dtype=np.float64).reshape(-1, 2)


def bounds_of(mask: BoolArray) -> Box:
    """Return the bounds of the pixels of a mask (H, W); all are 0 for an empty mask."""
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (int(xs[0]), int(ys[0]), int(xs[-1]) + 1, int(ys[-1]) + 1) if len(xs) else (0, 0, 0, 0)


def _decode(code: str, width: int, height: int) -> tuple[Box, BoolArray]:
    mask = decode_rle({"size": [height, width], "counts": code}).astype(bool)
    x0, y0, x1, y1 = box = bounds_of(mask)
    return box, np.ascontiguousarray(mask[y0:y1, x0:x1])
