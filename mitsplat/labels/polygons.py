"""Lossless polygons of masks: one closed polygon per instance, including holes and separate parts.

Positions are in pixels with the image's corner at (0, 0), so pixel centres are at +0.5.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csgraph

from mitsplat.arrays import BoolArray, Float64Array, Int64Array

_PIXEL_EDGES = (
    ((-1, 0), (0, 0), (1, 0)),
    ((0, 1), (1, 0), (0, 1)),
    ((1, 0), (1, 1), (-1, 0)),
    ((0, -1), (0, 1), (0, -1)),
)
"""Clockwise edges of a pixel: the pixel beside it (row, column), start and step (x, y)."""

_EDGE_DISTANCE = 0.02
"""Distance of the outermost vertices from a pixel's edge [px], so that they truncate to that pixel."""


def outline(mask: BoolArray) -> Float64Array:
    """Convert a mask of at least one pixel to one closed polygon [px], shape (M, 2).

    The polygon is designed for Ultralytics' reader of YOLO segments. The reader expects one polygon per instance. It
    scales positions to the training size, resamples them along the edges, truncates them to pixels, and fills them with
    ``cv2.fillPoly`` (even-odd, edges painted). Therefore

    * vertices are the *centres* of the mask's border pixels, and edges run in the eight directions of the grid. At the
      image's own size, vertices and edges truncate to pixels of the mask, so that the mask is restored exactly (except
      for a pixel where a resampled point meets the middle of a diagonal step). When scaled down, no side gains more
      than half a pixel. Vertices on the border pixels' outer edges would gain as much or more at every scale;
    * holes and separate parts are connected by bridges that are traversed in both directions. A bridge to a hole runs
      inside the mask. A bridge between parts paints the pixels of the gap, so the bridges are a minimum spanning tree;
    * at its four extremes, the polygon extends to the pixels' outer edges by spikes without area, so that the bounding
      box of the polygon is the box of the mask.
    """
    height, width = mask.shape
    rings = [
        ring.reshape(-1, 2).astype(np.intp)
        for ring in cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    ]
    polygon: Float64Array = _corners(_joined_rings(rings, (height, width))) + np.float64(0.5)
    (left, top), (right, bottom) = polygon.min(axis=0) - 0.5, polygon.max(axis=0) + 0.5
    for axis, edge in ((0, left), (0, right), (1, top), (1, bottom)):
        at = int(np.abs(polygon[:, axis] - edge).argmin())
        spike = polygon[[at, at]]
        spike[0, axis] = edge - np.sign(edge - spike[0, axis]) * _EDGE_DISTANCE
        polygon = np.concatenate([polygon[: at + 1], spike, polygon[at + 1 :]])
    return polygon


def fill_polygon(polygon: npt.ArrayLike, width: int, height: int) -> BoolArray:
    """Rasterise a polygon (M, 2) [px] like Ultralytics' ``polygon2mask``, shape (height, width)."""
    canvas = np.zeros((height, width), dtype=np.uint8)
    cv2.fillPoly(canvas, [np.asarray(polygon, dtype=np.float32).astype(np.int32)], 1)
    return canvas.astype(bool)


def pixel_polygons(mask: BoolArray) -> list[Int64Array]:
    """Return a closed polygon (M, 2) [px] along the pixel edges of every part of a mask, for COCO.

    Parts are connected by edges, so that pixels that touch at a corner are separate parts. COCO has no holes: a
    vertical edge that is traversed in both directions joins each hole to the polygon around it. pycocotools restores
    the mask exactly from the union of the polygons.
    """
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    polygons = []
    for number in range(1, count):
        part = np.pad(parts == number, 1)
        outer, *holes = sorted(_edge_rings(part), key=lambda ring: min(ring, key=lambda corner: corner[::-1])[::-1])
        for hole in holes:  # from the top, so that each hole is joined to one before it or to the outer ring
            first = min(range(len(hole)), key=lambda i: hole[i][::-1])
            x, y = hole[first]
            top = y
            while part[top - 1, x]:
                top -= 1
            at = outer.index((x, top))
            outer = [*outer[: at + 1], *hole[first:], *hole[:first], hole[first], *outer[at:]]
        polygons.append(_corners(np.array(outer, dtype=np.int64)) - 1)
    return polygons


def _edge_rings(part: BoolArray) -> list[list[tuple[int, int]]]:
    """Return the closed walks (x, y) along the pixel edges of a part, which is on their right hand."""
    ahead: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for beside, start, step in _PIXEL_EDGES:
        ys, xs = np.nonzero(part & ~np.roll(part, (-beside[0], -beside[1]), axis=(0, 1)))
        for x, y in zip((xs + start[0]).tolist(), (ys + start[1]).tolist(), strict=True):
            ahead.setdefault((x, y), []).append(step)
    rings = []
    while ahead:
        corner = begin = next(iter(ahead))
        step, ring = ahead[corner][0], []
        while True:
            ring.append(corner)
            steps = ahead[corner]
            # Where two pixels of the part touch at a corner, the walk turns right and stays at its pixel.
            step = steps[0] if len(steps) == 1 else max(steps, key=lambda one: step[0] * one[1] - step[1] * one[0])
            steps.remove(step)
            if not steps:
                del ahead[corner]
            corner = corner[0] + step[0], corner[1] + step[1]
            if corner == begin:
                break
        rings.append(ring)
    return rings


def _joined_rings(rings: list[Int64Array], shape: tuple[int, int]) -> Int64Array:
    """Join all ``rings`` to one closed walk of pixels (x, y); each bridge is traversed in both directions."""
    walk = rings[0]
    for start, ring, first in _bridges(rings, shape):
        at = int(np.flatnonzero((walk == start).all(axis=1))[0])
        loop = np.roll(ring, -first, axis=0)
        step = loop[0] - start
        ahead = np.arange(1, np.abs(step).max())[:, None]
        bridge = start + np.sign(step) * np.minimum(ahead, np.abs(step))
        walk = np.concatenate([walk[: at + 1], bridge, loop, loop[:1], bridge[::-1], walk[at:]])
    return walk


def _bridges(rings: list[Int64Array], shape: tuple[int, int]) -> list[tuple[Int64Array, Int64Array, int]]:
    """Find the bridges that join all rings over the fewest pixels; each bridge starts on a joined ring.

    The bridges are a minimum spanning tree over the neighbours in the rings' discrete Voronoi diagram. The chessboard
    metric counts the pixels that ``cv2.fillPoly`` paints along an edge.

    Returns:
        For each bridge: its start pixel (x, y), the ring that it joins, and its end position in that ring.
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
    shared = np.flatnonzero(np.diff(position[order]) == 0)  # walls one pixel thick belong to both rings
    a, b = order[shared], order[shared + 1]
    apart = ring_of[a] != ring_of[b]
    pairs = [(a[apart], b[apart])]
    ring_near = ring_of[near]
    everything, ahead, behind = slice(None), slice(1, None), slice(-1)
    for here, beside in (
        ((everything, behind), (everything, ahead)),
        ((behind, everything), (ahead, everything)),
        ((behind, behind), (ahead, ahead)),
        ((behind, ahead), (ahead, behind)),
    ):
        border = ring_near[here] != ring_near[beside]
        pairs.append((near[here][border], near[beside][border]))
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    length = np.abs(pixels[a] - pixels[b]).max(axis=1)
    if len(rings) == 2:  # the most frequent case: one part with one hole
        nearest = int(length.argmin())
        one, other = (a, b) if ring_of[a[nearest]] == 0 else (b, a)
        return [(pixels[one[nearest]], rings[1], int(other[nearest]) - len(rings[0]))]
    low, high = np.minimum(ring_of[a], ring_of[b]), np.maximum(ring_of[a], ring_of[b])
    shortest = np.lexsort((length, low * len(rings) + high))
    _, first = np.unique((low * len(rings) + high)[shortest], return_index=True)
    best = shortest[first]
    # SciPy treats a stored zero as no edge. One more pixel for every edge does not change the tree.
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


def _corners(walk: Int64Array) -> Int64Array:
    """Remove repeated pixels, and pixels between two steps of the same direction, from the closed ``walk``."""
    if len(walk) == 1:
        return walk
    x, y = (walk - np.concatenate([walk[-1:], walk[:-1]])).T
    walk = walk[np.logical_or(x, y)]
    if len(walk) == 1:
        return walk
    arriving = walk - np.concatenate([walk[-1:], walk[:-1]])
    x, y = (arriving - np.concatenate([arriving[1:], arriving[:1]])).T
    corners: Int64Array = walk[np.logical_or(x, y)]
    return corners
