"""Frame of the manifest with decoded masks, poses and camera; the audit compares all other files with its values.

The code that wrote the files is not used. Masks are decoded by pycocotools, poses are inverted by NumPy, points are
projected by OpenCV, and all other values are counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.images.masks import Box, decode_rle
from mitsplat.storage.files import JsonObject, Record


@dataclass(frozen=True, eq=False)
class DecodedInstance:
    """Instance of a frame.

    Attributes:
        entry: Label of the instance in the manifest.
        box: Bounds of the visible pixels, counted from the mask.
        mask: Visible pixels in the box.
        amodal_box, amodal: Bounds and pixels of the whole silhouette in the image.
    """

    entry: JsonObject
    box: Box
    mask: BoolArray
    amodal_box: Box
    amodal: BoolArray

    @classmethod
    def of(cls, entry: JsonObject, width: int, height: int) -> DecodedInstance:
        """Decode both masks, which are not empty."""
        return cls(entry, *_decode(entry["rle"], width, height), *_decode(entry["amodal_rle"], width, height))

    @property
    def id(self) -> int:
        """Value in id maps."""
        return int(self.entry["id"])

    @property
    def class_index(self) -> int:
        """Class index."""
        return int(self.entry["class_index"])

    @property
    def name(self) -> str:
        """Beginning of messages about the instance."""
        return f"instance {self.id}"

    @property
    def pose(self) -> Float64Array:
        """``world_from_object``, shape (4, 4) [m]."""
        return np.array(self.entry["world_from_object"], dtype=np.float64)

    @cached_property
    def area(self) -> int:
        """Number of visible pixels."""
        return int(np.count_nonzero(self.mask))

    @cached_property
    def amodal_area(self) -> int:
        """Number of pixels of the silhouette in the image."""
        return int(np.count_nonzero(self.amodal))

    @property
    def silhouette_area(self) -> int:
        """Number of pixels of the silhouette, also beyond the image's border, as stated in the manifest."""
        return int(self.entry["silhouette_area"])

    @property
    def visible_fraction(self) -> float:
        """Visible pixels over the pixels of the silhouette in the image."""
        return self.area / self.amodal_area

    @property
    def truncation(self) -> float:
        """Fraction of the silhouette beyond the image's border."""
        return 1 - self.amodal_area / self.silhouette_area


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """Record of a frame, with its dataset and its decoded instances."""

    root: Path
    record: Record
    content: JsonObject
    instances: tuple[DecodedInstance, ...]

    @classmethod
    def of(cls, root: Path, record: Record, content: JsonObject) -> DecodedFrame:
        """Create the frame from a record that :mod:`mitsplat.dataset.schema` has checked."""
        labels = record["labels"]
        instances = (DecodedInstance.of(entry, *labels["size"]) for entry in labels["instances"])
        return cls(root, record, content, tuple(instances))

    @property
    def index(self) -> int:
        """Frame index."""
        return int(self.record["index"])

    @property
    def split(self) -> str:
        """Name of the split."""
        return str(self.record["split"])

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        width, height = self.record["labels"]["size"]
        return width, height

    @property
    def formats(self) -> list[str]:
        """Formats of the dataset."""
        return list(self.content["scene"]["output"]["formats"])

    @property
    def has_splat_labels(self) -> bool:
        """True if labels come from the splats, as depths do."""
        return bool(self.content["scene"]["labels"]["source"] == "splats")

    @property
    def image_name(self) -> str:
        """File name of the frame's picture."""
        return f"{self.index:06d}.{self.content['scene']['output']['image']}"

    @property
    def bop_folder(self) -> str:
        """Folder of the frame's layout in BOP, relative to the dataset."""
        return f"bop/{self.split}/{self.record['layout']:06d}"

    def full_mask(self, instance: DecodedInstance, *, amodal: bool = False) -> BoolArray:
        """Return the visible pixels of an instance, or its whole silhouette, in the whole image (H, W)."""
        width, height = self.size
        canvas = np.zeros((height, width), dtype=bool)
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
        width, height = self.size
        canvas = np.zeros((height, width), dtype=np.int64)
        for instance, value in zip(self.instances, values, strict=True):
            x0, y0, x1, y1 = instance.box
            canvas[y0:y1, x0:x1][instance.mask] = value
        return canvas

    @property
    def world_from_camera(self) -> Float64Array:
        """Camera pose in the manifest [m], shape (4, 4)."""
        return np.array(self.record["camera"]["world_from_camera"], dtype=np.float64)

    @cached_property
    def camera_from_world(self) -> Float64Array:
        """Inverse camera pose [m], shape (4, 4)."""
        return np.asarray(np.linalg.inv(self.world_from_camera))

    @property
    def intrinsics(self) -> Float64Array:
        """Intrinsic matrix [px], pixel centres at +0.5, shape (3, 3)."""
        return np.array(self.record["camera"]["intrinsics"], dtype=np.float64)

    @property
    def distortion(self) -> Float64Array:
        """Distortion coefficients of OpenCV."""
        return np.array(self.record["camera"]["distortion"], dtype=np.float64)

    def project(self, points: Float64Array) -> Float64Array:
        """Project points in the camera's frame (N, 3), all in front of the camera, to pixels (N, 2)."""
        points, zero = np.ascontiguousarray(points).reshape(-1, 1, 3), np.zeros(3)
        if self.record["camera"]["lens"] == "fisheye":
            pixels, _ = cv2.fisheye.projectPoints(points, zero, zero, self.intrinsics, self.distortion)
        else:
            pixels, _ = cv2.projectPoints(points, zero, zero, self.intrinsics, self.distortion)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

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


def bounds_of(mask: BoolArray | npt.NDArray[np.uint8]) -> Box:
    """Return the bounds of a mask's pixels; all are 0 for an empty mask."""
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (int(xs[0]), int(ys[0]), int(xs[-1]) + 1, int(ys[-1]) + 1) if len(xs) else (0, 0, 0, 0)


def _decode(code: str, width: int, height: int) -> tuple[Box, BoolArray]:
    mask = decode_rle({"size": [height, width], "counts": code})
    x0, y0, x1, y1 = box = bounds_of(mask)
    return box, np.ascontiguousarray(mask[y0:y1, x0:x1], dtype=bool)
