"""Labels of a frame from its instance maps.

Input: ids, depth and silhouettes. Output: :class:`Labels` with an exclusive mask, polygons that rasterise back to the
mask, boxes, visible fraction, truncation and keypoints for every instance, and counts of dropped instances per rule.
:mod:`.labels` applies the rules, :mod:`.keypoint_visibility` finds keypoints that meshes hide.
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
