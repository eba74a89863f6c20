"""A photographed workcell or room to an environment that things can be dropped into.

In: a :class:`~mitsplat.capture.capture.Capture` without masks, and splats fitted to the whole of it. Out: an asset
whose floaters are gone and whose support, such as a table, lies level in z = 0; the flat surfaces as colliders, what
photos hardly show of the support, and a scene file that drops things where it is free.
"""

from __future__ import annotations

from mitsplat.surroundings.environment_from_photos import make_photo_surroundings, make_surroundings

__all__ = ["make_photo_surroundings", "make_surroundings"]
