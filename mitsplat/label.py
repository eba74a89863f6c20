"""Labels of a frame: exclusive masks, boxes and outlines of the instances that can be seen.

Every label derives from the integer id map of the frame, so masks are exclusive and respect occlusion. Two rules, in
this order, decide what is too small to be labelled; what they drop is counted and never silent:

1. a connected part (8-connectivity) of fewer than ``min_fragment`` pixels is removed from its instance;
2. an instance left with fewer than ``min_pixels`` pixels is dropped whole.

Positions are in pixels with the image's corner at (0, 0), so pixel centres are at +0.5 and a box is half-open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
from pycocotools import mask as coco_mask
from scipy import ndimage
from scipy.sparse import coo_array, csgraph

if TYPE_CHECKING:
    from mitsplat.settle import Instance

BoolArray = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]

_LEAN = 0.02
"""How far from a pixel's edge the outline's outermost vertices stay [px], so that they truncate to that pixel."""


@dataclass(frozen=True, eq=False)
class InstanceLabel:
    """What can be seen of one instance.

    Attributes:
        id: Value of the instance in the id map, from 1.
        class_index: Position of ``class_name`` among the scene's classes.
        class_name: Class that detectors learn.
        box: Bounds ``(x0, y0, x1, y1)`` of the mask [px], half-open.
        mask: Visible pixels inside the box, shape (y1 - y0, x1 - x0).
        truncated: Whether the mask touches the image's border.
        world_from_object: Rigid transform of the asset's coordinates to the world's [m], shape (4, 4).
    """

    id: int
    class_index: int
    class_name: str
    box: tuple[int, int, int, int]
    mask: BoolArray
    truncated: bool
    world_from_object: FloatArray

    @cached_property
    def area(self) -> int:
        """Visible pixels."""
        return int(np.count_nonzero(self.mask))

    @cached_property
    def polygon(self) -> FloatArray:
        """The mask as one closed polygon [px], see :func:`outline`, shape (M, 2)."""
        return outline(self.mask) + self.box[:2]

    @cached_property
    def polygon_iou(self) -> float:
        """Intersection over union of the mask and the polygon as :func:`fill_polygon` reads it back."""
        height, width = self.mask.shape
        filled = fill_polygon(self.polygon - self.box[:2], width, height)
        return float(np.count_nonzero(filled & self.mask) / np.count_nonzero(filled | self.mask))


@dataclass(frozen=True, eq=False)
class Labels:
    """The labels of one frame.

    Attributes:
        width, height: Size of the image [px].
        instances: Labelled instances by ascending id.
        dropped: Counts by reason: ``fragments`` removed by rule 1, instances too ``small`` by rule 2, and instances
            ``hidden`` entirely or outside the image.
    """

    width: int
    height: int
    instances: tuple[InstanceLabel, ...]
    dropped: dict[str, int]

    def to_json(self) -> dict[str, Any]:
        """Everything, as JSON values; masks are COCO run-length codes over the whole image."""
        return {
            "size": [self.width, self.height],
            "instances": [
                {
                    "id": label.id,
                    "class_index": label.class_index,
                    "class": label.class_name,
                    "box": list(label.box),
                    "area": label.area,
                    "truncated": label.truncated,
                    "polygon_iou": round(label.polygon_iou, 6),
                    "world_from_object": label.world_from_object.tolist(),
                    "rle": self._encode(label),
                }
                for label in self.instances
            ],
            "dropped": self.dropped,
        }

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Labels:
        """Inverse of :meth:`to_json`."""
        width, height = record["size"]
        instances = []
        for entry in record["instances"]:
            x0, y0, x1, y1 = box = tuple(entry["box"])
            mask = coco_mask.decode({"size": [height, width], "counts": entry["rle"]})
            instances.append(
                InstanceLabel(
                    id=entry["id"],
                    class_index=entry["class_index"],
                    class_name=entry["class"],
                    box=box,
                    mask=np.ascontiguousarray(mask[y0:y1, x0:x1], dtype=bool),
                    truncated=entry["truncated"],
                    world_from_object=np.array(entry["world_from_object"]),
                )
            )
        return cls(width, height, tuple(instances), dict(record["dropped"]))

    def _encode(self, label: InstanceLabel) -> str:
        x0, y0, x1, y1 = label.box
        canvas = np.zeros((self.height, self.width), dtype=np.uint8, order="F")
        canvas[y0:y1, x0:x1] = label.mask
        return str(coco_mask.encode(canvas)["counts"].decode("ascii"))


def label_instances(
    instance_map: npt.NDArray[np.integer[Any]],
    instances: Sequence[Instance],
    class_names: Sequence[str],
    *,
    min_pixels: int = 16,
    min_fragment: int = 8,
) -> Labels:
    """Labels of the ``instances`` seen in an id map of shape (H, W), 0 = no instance.

    Raises:
        ValueError: If the map is not a 2-D integer array or holds an id of none of the instances.
    """
    if instance_map.ndim != 2 or not np.issubdtype(instance_map.dtype, np.integer):
        raise ValueError(f"an id map must be a 2-D integer array (got {instance_map.dtype}, {instance_map.shape})")
    height, width = instance_map.shape
    ids = instance_map.astype(np.int32)
    found = {i: bounds for i, bounds in enumerate(ndimage.find_objects(ids), start=1) if bounds is not None}
    if unknown := found.keys() - {instance.id for instance in instances}:
        raise ValueError(f"the id map holds {min(unknown)}, which is the id of no instance")

    labels = []
    dropped = {"fragments": 0, "small": 0, "hidden": 0}
    for instance in sorted(instances, key=lambda instance: instance.id):
        if instance.id not in found:
            dropped["hidden"] += 1
            continue
        rows, columns = found[instance.id]
        mask, fragments = _without_fragments(ids[rows, columns] == instance.id, min_fragment)
        dropped["fragments"] += fragments
        if np.count_nonzero(mask) < min_pixels:
            dropped["small"] += 1
            continue
        ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        x0, x1 = columns.start + int(xs[0]), columns.start + int(xs[-1]) + 1
        y0, y1 = rows.start + int(ys[0]), rows.start + int(ys[-1]) + 1
        labels.append(
            InstanceLabel(
                id=instance.id,
                class_index=instance.class_index,
                class_name=class_names[instance.class_index],
                box=(x0, y0, x1, y1),
                mask=np.ascontiguousarray(mask[ys[0] : ys[-1] + 1, xs[0] : xs[-1] + 1]),
                truncated=x0 == 0 or y0 == 0 or x1 == width or y1 == height,
                world_from_object=instance.world_from_object,
            )
        )
    return Labels(width, height, tuple(labels), dropped)


def outline(mask: BoolArray) -> FloatArray:
    """A mask of at least one pixel as one closed polygon [px], shape (M, 2).

    Made for how Ultralytics reads YOLO segments: one polygon per instance; positions scaled to the training size,
    resampled along the edges and truncated to pixels; ``cv2.fillPoly`` (even-odd, edges painted). Therefore

    * vertices are the *centres* of the mask's border pixels and edges run in the eight directions of the grid: at the
      image's own size vertices and edges truncate to pixels of the mask, so the mask comes back exactly (but for a
      pixel where a resampled point meets the middle of a diagonal step), and when scaled down no side gains more than
      half a pixel; vertices on the border pixels' outer edges gain as much or more at every scale;
    * holes and separate parts hang on bridges walked there and back. A bridge to a hole runs inside the mask; a
      bridge between parts paints the pixels of the gap, so the bridges are a minimum spanning tree;
    * at its four extremes the polygon reaches out to the pixels' outer edges by spikes without area: the box that
      is read off the polygon is the box of the mask.
    """
    height, width = mask.shape
    rings = [
        ring.reshape(-1, 2).astype(np.intp)
        for ring in cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    ]
    polygon: FloatArray = _corners(_joined(rings, (height, width))) + np.float64(0.5)
    ys, xs = np.nonzero(mask)
    for axis, edge in ((0, xs.min()), (0, xs.max() + 1), (1, ys.min()), (1, ys.max() + 1)):
        at = int(np.abs(polygon[:, axis] - edge).argmin())
        spike = polygon[[at, at]]
        spike[0, axis] = edge - np.sign(edge - spike[0, axis]) * _LEAN
        polygon = np.insert(polygon, at + 1, spike, axis=0)
    return polygon


def fill_polygon(polygon: npt.ArrayLike, width: int, height: int) -> BoolArray:
    """Pixels of a polygon (M, 2) [px] as Ultralytics' ``polygon2mask`` fills it, shape (height, width)."""
    canvas = np.zeros((height, width), dtype=np.uint8)
    cv2.fillPoly(canvas, [np.asarray(polygon, dtype=np.float32).astype(np.int32)], 1)
    return canvas.astype(bool)


def _without_fragments(mask: BoolArray, min_fragment: int) -> tuple[BoolArray, int]:
    """The mask without connected parts of fewer than ``min_fragment`` pixels, and how many those were."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= min_fragment
    keep[0] = False
    return keep[parts], int(count - 1 - np.count_nonzero(keep))


def _joined(rings: list[IntArray], shape: tuple[int, int]) -> IntArray:
    """One closed walk of pixels (x, y) through all ``rings``, each bridge walked there and back."""
    walk = rings[0]
    for start, ring, first in _bridges(rings, shape):
        at = int(np.flatnonzero((walk == start).all(axis=1))[0])
        loop = np.roll(ring, -first, axis=0)
        step = loop[0] - start
        ahead = np.arange(1, np.abs(step).max())[:, None]
        bridge = start + np.sign(step) * np.minimum(ahead, np.abs(step))
        walk = np.concatenate([walk[: at + 1], bridge, loop, loop[:1], bridge[::-1], walk[at:]])
    return walk


def _bridges(rings: list[IntArray], shape: tuple[int, int]) -> list[tuple[IntArray, IntArray, int]]:
    """The bridges that join all rings over the fewest pixels, in an order in which a bridge starts on a joined ring.

    A minimum spanning tree over the neighbours in the rings' discrete Voronoi diagram in the chessboard metric, which
    counts the pixels that ``cv2.fillPoly`` paints along an edge.

    Returns:
        For each bridge the pixel (x, y) it starts at, the ring it joins and the position in that ring where it ends.
    """
    if len(rings) == 1:
        return []
    pixels = np.concatenate(rings)
    ring_of = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    away = np.ones(shape, dtype=np.uint8)
    away[pixels[:, 1], pixels[:, 0]] = 0
    _, cell = cv2.distanceTransformWithLabels(away, cv2.DIST_C, 3, labelType=cv2.DIST_LABEL_PIXEL)
    pixel_of_cell = np.zeros(cell.max() + 1, dtype=np.intp)
    pixel_of_cell[cell[pixels[:, 1], pixels[:, 0]]] = np.arange(len(pixels))
    near = pixel_of_cell[cell]
    position = pixels @ (1, shape[1])
    order = np.argsort(position, kind="stable")
    shared = np.flatnonzero(np.diff(position[order]) == 0)  # walls one pixel thick belong to the rings of both sides
    neighbours = [
        (order[shared], order[shared + 1]),
        (near[:, :-1], near[:, 1:]),
        (near[:-1], near[1:]),
        (near[:-1, :-1], near[1:, 1:]),
        (near[:-1, 1:], near[1:, :-1]),
    ]
    a, b = (np.concatenate([pair[side].ravel() for pair in neighbours]) for side in (0, 1))
    a, b = a[ring_of[a] != ring_of[b]], b[ring_of[a] != ring_of[b]]
    length = np.abs(pixels[a] - pixels[b]).max(axis=1)
    low, high = np.minimum(ring_of[a], ring_of[b]), np.maximum(ring_of[a], ring_of[b])
    shortest = np.lexsort((length, low * len(rings) + high))
    _, first = np.unique((low * len(rings) + high)[shortest], return_index=True)
    best = shortest[first]
    # SciPy takes a stored zero for no edge; one more pixel for every edge leaves the tree the same.
    graph = coo_array((length[best] + 1, (low[best], high[best])), shape=(len(rings), len(rings)))
    ends = {(int(low[i]), int(high[i])): (int(a[i]), int(b[i])) for i in best}
    order, parent = csgraph.breadth_first_order(csgraph.minimum_spanning_tree(graph.tocsr()), 0, directed=False)
    bridges = []
    for ring in order[1:]:
        start, end = ends[min(ring, parent[ring]), max(ring, parent[ring])]
        if ring_of[start] == ring:
            start, end = end, start
        bridges.append((pixels[start], rings[ring], end - int(np.searchsorted(ring_of, ring))))
    return bridges


def _corners(walk: IntArray) -> IntArray:
    """The closed ``walk`` without standing still and without pixels between two steps of one direction."""
    walk = walk[np.any(walk != np.roll(walk, 1, axis=0), axis=1)] if len(walk) > 1 else walk
    arriving = walk - np.roll(walk, 1, axis=0)
    leaving = np.roll(walk, -1, axis=0) - walk
    return walk[np.any(arriving != leaving, axis=1)] if len(walk) > 1 else walk
