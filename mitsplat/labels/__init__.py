"""Labels of a frame from its instance maps.

In: ids, depth and silhouettes. Out: :class:`Labels`: for every instance an exclusive mask, polygons that rasterise
back to it, boxes, visible fraction, truncation and keypoints; what a rule drops is counted.
"""

from __future__ import annotations

from mitsplat.labels.labels import InstanceLabel, LabelRules, Labels, Truth, label_instances
from mitsplat.labels.overlay import draw_labels
from mitsplat.labels.polygons import fill_polygon, outline

__all__ = [
    "InstanceLabel",
    "LabelRules",
    "Labels",
    "Truth",
    "draw_labels",
    "fill_polygon",
    "label_instances",
    "outline",
]
