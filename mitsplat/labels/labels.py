"""Labels of a frame: exclusive masks, boxes, outlines and poses of the visible instances, with statistics of omissions.

Every label derives from the integer id map of the frame, so masks are exclusive and respect occlusion. The following
rules, in this order, select the labels. All omissions and marks are counted:

1. a connected part (8-connectivity) of fewer than ``min_fragment`` pixels is removed from its instance;
2. an instance left with fewer than ``min_pixels`` pixels is dropped;
3. an instance with a visible fraction below ``min_visible`` is ``occluded``. An instance whose splats and proxy agree
   by less than ``min_agreement`` is ``disagreeing``. Occluded and disagreeing instances are dropped or only marked,
   depending on ``below_threshold``.

The *silhouette* of an instance is its mask when rendered alone, by the same rule for a pixel and after rule 1. The
visible fraction is exact and uses no depth tolerance: visible pixels over the silhouette's pixels in the image. The
truncation is the share of the complete silhouette beyond the image's border.

Positions are in pixels with the image's corner at (0, 0), so pixel centres are at +0.5 and a box is half-open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from mitsplat.arguments import checks_arguments
from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.rigid import transform_points
from mitsplat.images.masks import (
    BOUNDARY_TOLERANCE,
    Box,
    Silhouette,
    boundary_f1,
    bounds_of_ids,
    decode_rle,
    encode_mask,
    iou,
    without_fragments,
)
from mitsplat.labels.polygons import fill_polygon, outline
from mitsplat.scene.spec.scene_spec import LabelRules as LabelRules
from mitsplat.storage.files import JsonObject

if TYPE_CHECKING:
    from mitsplat.geometry.camera import Camera
    from mitsplat.scene.layout import Instance


KEYPOINT_TOLERANCE = 0.005
"""Maximum distance of a visible keypoint behind surroundings without a mesh, as a share of its depth."""

UNLABELLED, HIDDEN, VISIBLE = 0, 1, 2
"""Visibility of a keypoint, as in COCO: outside the image, occluded, visible."""

_STORED_FIELDS = (
    "id",
    "asset",
    "class_index",
    "silhouette_area",
    "depth_area",
    "agreement",
    "boundary_f1",
    "truncation",
)
"""Fields of a label that have the same name and value in the manifest."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground-truth maps of a rendered frame; 0 = no instance.

    Attributes:
        instance: Ids from which labels derive, (H, W) integers.
        second: Ids from the other source (proxies if labels derive from splats), (H, W) integers.
        silhouettes: Silhouette of every instance by id, from the labels' source; instances without pixels are absent.
        depth: Depth of the visible surface along the optical axis [m], (H, W).
    """

    instance: npt.NDArray[np.integer]
    second: npt.NDArray[np.integer]
    silhouettes: Mapping[int, Silhouette]
    depth: npt.NDArray[np.floating]


@dataclass(frozen=True, eq=False, repr=False)
class InstanceLabel:
    """Label of one visible instance.

    Attributes:
        id: Value of the instance in the id map, from 1.
        asset: Index among the scene's assets.
        class_index: Index of ``class_name`` among the scene's classes.
        class_name: Class name in the labels.
        box: Bounds of the mask [px].
        mask: Visible pixels inside the box, shape (y1 - y0, x1 - x0).
        amodal: The silhouette's part in the image, including hidden pixels.
        silhouette_box: Bounds of the silhouette, also beyond the image's border [px], at most one image size on each
            side.
        silhouette_area: Pixels of the silhouette in that range.
        depth_area: Pixels of ``amodal`` at which the image has a depth.
        agreement: IoU of the instance's masks by splats and by proxies.
        boundary_f1: F1 score of their boundaries, see :func:`mitsplat.images.masks.boundary_f1`.
        truncation: Share of the complete silhouette beyond the image's border.
        world_from_object: Rigid transform from the asset's coordinates to the world's [m], shape (4, 4).
        keypoints: Position [px] and visibility of the asset's named points, shape (K, 3): :data:`VISIBLE`,
            :data:`HIDDEN`, or :data:`UNLABELLED` at (0, 0).
        marks: Any of ``occluded`` and ``disagreeing``.
    """

    id: int
    asset: int
    class_index: int
    class_name: str
    box: Box
    mask: BoolArray
    amodal: Silhouette
    silhouette_box: Box
    silhouette_area: int
    depth_area: int
    agreement: float
    boundary_f1: float
    truncation: float
    world_from_object: Float64Array
    keypoints: Float64Array = field(default_factory=lambda: np.zeros((0, 3)))
    marks: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"InstanceLabel({self.id}: {self.class_name}, box {self.box}, {self.area} px, "
            f"{self.visible_fraction:.0%} visible)"
        )

    @cached_property
    def area(self) -> int:
        """Number of visible pixels."""
        return int(np.count_nonzero(self.mask))

    @property
    def visible_fraction(self) -> float:
        """Visible pixels over the silhouette's pixels in the image."""
        return self.area / self.amodal.area

    @cached_property
    def polygon(self) -> Float64Array:
        """The mask as one closed polygon [px], see :func:`mitsplat.labels.polygons.outline`, shape (M, 2)."""
        return outline(self.mask) + self.box[:2]

    @cached_property
    def polygon_iou(self) -> float:
        """Intersection over union of the mask and the polygon rasterised by :func:`fill_polygon`."""
        height, width = self.mask.shape
        return iou(fill_polygon(self.polygon - self.box[:2], width, height), self.mask)


@checks_arguments
@dataclass(frozen=True, eq=False)
class Labels:
    """Labels of one frame.

    Attributes:
        width, height: Size of the image [px].
        instances: Labelled instances by ascending id.
        dropped: Counts by reason: ``fragments`` removed by rule 1; instances too ``small`` by rule 2, ``occluded`` or
            ``disagreeing`` by rule 3 (the first that applies), ``hidden`` entirely, or ``outside`` the image.
    """

    width: int
    height: int
    instances: tuple[InstanceLabel, ...]
    dropped: dict[str, int]

    def to_json(self) -> JsonObject:
        """Return all labels as JSON values; masks are COCO run-length codes over the whole image."""
        size = self.width, self.height
        return {
            "size": list(size),
            "instances": [
                {
                    "id": label.id,
                    "asset": label.asset,
                    "class_index": label.class_index,
                    "class": label.class_name,
                    "box": list(label.box),
                    "area": label.area,
                    "amodal_box": list(label.amodal.box),
                    "amodal_area": label.amodal.area,
                    "silhouette_box": list(label.silhouette_box),
                    "silhouette_area": label.silhouette_area,
                    "depth_area": label.depth_area,
                    "visible_fraction": round(label.visible_fraction, 6),
                    "truncation": round(label.truncation, 6),
                    "polygon_iou": round(label.polygon_iou, 6),
                    "agreement": round(label.agreement, 6),
                    "boundary_f1": round(label.boundary_f1, 6),
                    "marks": list(label.marks),
                    "keypoints": label.keypoints.round(3).tolist(),
                    "world_from_object": label.world_from_object.tolist(),
                    "rle": encode_mask(label.mask, label.box, size),
                    "amodal_rle": encode_mask(label.amodal.mask, label.amodal.box, size),
                }
                for label in self.instances
            ],
            "dropped": self.dropped,
        }

    @classmethod
    def from_json(cls, record: JsonObject) -> Labels:
        """Restore labels from the output of :meth:`to_json`."""
        width, height = record["size"]

        def decode(code: str, box: list[int]) -> BoolArray:
            x0, y0, x1, y1 = box
            mask = decode_rle({"size": [height, width], "counts": code})
            return np.ascontiguousarray(mask[y0:y1, x0:x1], dtype=bool)

        instances = [
            InstanceLabel(
                **{name: entry[name] for name in _STORED_FIELDS},
                class_name=entry["class"],
                box=tuple(entry["box"]),
                mask=decode(entry["rle"], entry["box"]),
                amodal=Silhouette(tuple(entry["amodal_box"]), decode(entry["amodal_rle"], entry["amodal_box"])),
                silhouette_box=tuple(entry["silhouette_box"]),
                world_from_object=np.array(entry["world_from_object"]),
                keypoints=np.array(entry["keypoints"], dtype=np.float64).reshape(-1, 3),
                marks=tuple(entry["marks"]),
            )
            for entry in record["instances"]
        ]
        return cls(width, height, tuple(instances), dict(record["dropped"]))


def label_instances(
    truth: Truth,
    instances: Sequence[Instance],
    class_names: Sequence[str],
    rules: LabelRules,
    *,
    camera: Camera | None = None,
    keypoints: Mapping[int, Float64Array] | None = None,
    blocked: Mapping[int, BoolArray] | None = None,
) -> Labels:
    """Label the visible ``instances`` of a frame.

    Args:
        truth: The frame's maps, all of the same shape (H, W).
        instances: All placed instances. An instance without a class is in the maps, but gets no label.
        class_names: Names by class index.
        rules: Thresholds for dropping and marking.
        camera: Camera; required for keypoints.
        keypoints: Keypoints by asset index, in the asset's coordinates [m], shape (K, 3) each.
        blocked: True for the keypoints that a mesh hides, by instance id, shape (K,) each; by default, none is hidden
            by a mesh. See :mod:`mitsplat.labels.keypoint_visibility`.

    Raises:
        ValueError: If a map is not a 2-D integer array, the maps differ in shape, or a map contains an unknown id.
    """
    for ids in (truth.instance, truth.second):
        if ids.ndim != 2 or not np.issubdtype(ids.dtype, np.integer) or ids.shape != truth.instance.shape:
            raise ValueError(f"id maps must be 2-D integer arrays of one shape (got {ids.dtype}, {ids.shape})")
    height, width = truth.instance.shape
    ids, second = truth.instance, truth.second
    found, found_second = bounds_of_ids(ids), bounds_of_ids(second)
    if unknown := (found.keys() | found_second.keys()) - {instance.id for instance in instances}:
        raise ValueError(f"ids of the id map must be those of instances, or 0 (got {min(unknown)})")

    labels = []
    dropped = dict.fromkeys(("fragments", "small", "occluded", "disagreeing", "hidden", "outside"), 0)
    for instance in sorted(instances, key=lambda instance: instance.id):
        if instance.class_index is None:
            continue
        silhouette = truth.silhouettes.get(instance.id)
        if instance.id not in found:
            dropped["outside" if silhouette is None or silhouette.clipped(width, height) is None else "hidden"] += 1
            continue
        x0, y0, x1, y1 = found[instance.id]
        mask, fragments = without_fragments(ids[y0:y1, x0:x1] == instance.id, rules.min_fragment)
        dropped["fragments"] += fragments
        if np.count_nonzero(mask) < rules.min_pixels:
            dropped["small"] += 1
            continue
        visible = Silhouette.cropped(mask, x0, y0)
        name = class_names[instance.class_index]
        label = _label_instance(instance, name, visible, truth, rules, found_second.get(instance.id))
        if label.marks and rules.below_threshold == "drop":
            dropped[label.marks[0]] += 1
            continue
        points = (keypoints or {}).get(instance.asset)
        if points is not None and camera is not None:
            hidden = (blocked or {}).get(instance.id)
            label = replace(label, keypoints=_project_keypoints(points, instance, camera, truth, hidden))
        labels.append(label)
    return Labels(width, height, tuple(labels), dropped)


def _label_instance(
    instance: Instance, class_name: str, visible: Silhouette, truth: Truth, rules: LabelRules, second_bounds: Box | None
) -> InstanceLabel:
    """Label an instance of a class by the ``visible`` part of its silhouette, without keypoints.

    ``second_bounds`` are its bounds in the second id map, None if it is not there.
    """
    height, width = truth.instance.shape
    silhouette = truth.silhouettes.get(instance.id)
    amodal, box, area = _amodal(silhouette, visible, rules.min_fragment, (width, height))
    agreement, boundary = _agreement(visible, truth.second, instance.id, second_bounds)
    is_marked = {
        "occluded": visible.area / amodal.area < rules.min_visible,
        "disagreeing": agreement < rules.min_agreement,
    }
    return InstanceLabel(
        id=instance.id,
        asset=instance.asset,
        class_index=cast(int, instance.class_index),
        class_name=class_name,
        box=visible.box,
        mask=visible.mask,
        amodal=amodal,
        silhouette_box=box,
        silhouette_area=area,
        depth_area=_depth_area(amodal, truth),
        agreement=agreement,
        boundary_f1=boundary,
        truncation=1 - amodal.area / (area + (0.0 if silhouette is None else silhouette.beyond)),
        world_from_object=instance.world_from_object,
        marks=tuple(mark for mark, holds in is_marked.items() if holds),
    )


def _amodal(
    silhouette: Silhouette | None, visible: Silhouette, min_fragment: int, size: tuple[int, int]
) -> tuple[Silhouette, Box, int]:
    """Return the silhouette inside the image, and the bounds and area of the complete silhouette.

    Where three instances overlap in a pixel, one may have the largest share there that would not cover the pixel alone.
    Visible pixels therefore always belong to the silhouette.
    """
    parts = [visible] if silhouette is None else [silhouette, visible]
    x0, y0 = min(part.box[0] for part in parts), min(part.box[1] for part in parts)
    x1, y1 = max(part.box[2] for part in parts), max(part.box[3] for part in parts)
    joint = np.logical_or.reduce([part.within((x0, y0, x1, y1)) for part in parts])
    # Fragments are removed inside the image like those of the visible mask, and separately in the full silhouette.
    full = Silhouette.cropped(without_fragments(joint, min_fragment)[0], x0, y0)
    if min(full.box[:2]) >= 0 and full.box[2] <= size[0] and full.box[3] <= size[1]:
        return full, full.box, full.area
    inside = cast(Silhouette, full.clipped(*size))  # not empty, as it contains the visible mask
    return Silhouette.cropped(without_fragments(inside.mask, min_fragment)[0], *inside.box[:2]), full.box, full.area


def _agreement(
    visible: Silhouette, second: npt.NDArray[np.integer], number: int, bounds: Box | None
) -> tuple[float, float]:
    """Compute IoU and boundary F1 between an instance's mask and its mask (within ``bounds``) in the other id map."""
    height, width = second.shape
    x0, y0, x1, y1 = visible.box
    if bounds is not None:
        left, top, right, bottom = bounds
        x0, y0, x1, y1 = min(x0, left), min(y0, top), max(x1, right), max(y1, bottom)
    margin = 1 + BOUNDARY_TOLERANCE
    x0, y0, x1, y1 = max(x0 - margin, 0), max(y0 - margin, 0), min(x1 + margin, width), min(y1 + margin, height)
    other = second[y0:y1, x0:x1] == number
    one = visible.within((x0, y0, x1, y1))
    return iou(one, other), boundary_f1(one, other)


def _project_keypoints(
    points: Float64Array, instance: Instance, camera: Camera, truth: Truth, blocked: BoolArray | None
) -> Float64Array:
    """Compute pixels and visibilities of an asset's keypoints, shape (K, 3).

    A keypoint is hidden if a mesh blocks its ray, or if all four pixels around it show surroundings in front of it,
    which may have no mesh.
    """
    pose = instance.world_from_object
    points = transform_points(pose, points)
    pixels, depth = camera.project(points)
    hidden = np.zeros(len(points), dtype=bool) if blocked is None else blocked
    keypoints = np.zeros((len(points), 3))
    for row, (x, y), z, is_hidden in zip(keypoints, pixels, depth, hidden, strict=True):
        if not (z > camera.near and 0 <= x < camera.width and 0 <= y < camera.height):
            continue
        left, top = max(int(x - 0.5), 0), max(int(y - 0.5), 0)
        around = slice(top, top + 2), slice(left, left + 2)
        front, is_surroundings = truth.depth[around], truth.instance[around] == 0
        is_hidden |= bool((is_surroundings & (front > 0) & (front < z * (1 - KEYPOINT_TOLERANCE))).all())
        row[:] = x, y, HIDDEN if is_hidden else VISIBLE
    return keypoints


def _depth_area(amodal: Silhouette, truth: Truth) -> int:
    """Return the number of pixels of a silhouette at which the image has a depth."""
    x0, y0, x1, y1 = amodal.box
    return int(np.count_nonzero(amodal.mask & (truth.depth[y0:y1, x0:x1] > 0)))
