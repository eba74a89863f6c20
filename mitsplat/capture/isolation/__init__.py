"""Which of the points that photographs share are the object: chosen in space, not in each photo.

In: points, the cameras that see them, and hints if there are any. Out: the points of one thing that stands on the
support, from which masks are begun, and how much of it other things hide in a photo. It knows neither files nor
captures.
"""

from __future__ import annotations

from mitsplat.capture.isolation.object_choice import ChosenObject, PhotoView, Pick, choose_object
from mitsplat.capture.isolation.occluding_points import hidden_part

__all__ = ["ChosenObject", "PhotoView", "Pick", "choose_object", "hidden_part"]
