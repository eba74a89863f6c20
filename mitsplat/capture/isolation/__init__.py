"""Selection of the points of an object, in space instead of per photo.

Input: points, the cameras that observe them, and optional hints. Output: the points of one object on its support, as
initial data for masks, and the fraction of the object that is occluded in a photo. This package is independent of files
and captures.
"""

from __future__ import annotations

from mitsplat.capture.isolation.object_choice import ChosenObject, PhotoView, Pick, choose_object
from mitsplat.capture.isolation.occluding_points import occluded_part

__all__ = ["ChosenObject", "PhotoView", "Pick", "choose_object", "occluded_part"]
