"""Reconstruction of a photographed workcell or room as a scene environment.

Input: a :class:`~mitsplat.capture.capture.Capture` without masks, and splats that were fitted to the whole scene.
Output: an environment asset without floaters, whose support surface (for example a table) lies level in z = 0.
The package also makes colliders for the flat surfaces, a map of the parts of the support that few photos show, and a
scene file that drops objects onto the free area.
"""

from __future__ import annotations

from mitsplat.surroundings.environment_from_photos import reconstruct_environment

__all__ = ["reconstruct_environment"]
