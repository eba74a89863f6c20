"""Lighting properties of the integrator ``splat_proxy`` from a scene file."""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsplat.scene.scene import Scene
from mitsplat.scene.walls import backdrop_distance


def light_properties(scene: Scene, layout: int = 0) -> dict[str, Any]:
    """Return the lighting properties of the integrator for the environment of a layout."""
    composite = scene.spec.composite
    reference = reference_point(scene)
    return {
        "shadow": "none" if composite.shadow == "none" else "traced",
        "shadow_error": composite.shadow_error,
        "metered": composite.exposure == "auto",
        "occluders": composite.occluders,
        "bounce": composite.bounce,
        "highlight": composite.highlight,
        "reference": list(reference),
        # A sky inside a room represents light reflected by the walls. Walls must not occlude it, but near objects must.
        "sky_reach": backdrop_distance(scene.spec, reference) / 2,
        "white": white_irradiance(scene, layout),
        # Pixels without splats show the background of mitsplat.frames.camera_response, not a light source.
        "hide_emitters": True,
    }


def white_irradiance(scene: Scene, layout: int) -> float:
    """Return the irradiance [W/m^2] of display white in a layout, or 0 if it is unknown or not used.

    The image-space shadow does not use it, because it only evaluates light relative to the brightest value.
    """
    environment = scene.environment_of(layout)
    if environment is None or scene.spec.composite.shadow == "image":
        return 0.0
    return environment.white or 0.0


def reference_point(scene: Scene) -> tuple[float, float, float]:
    """Return the point at which uniformly captured colours are unchanged [m]: below the middle of the drop region."""
    low, high = np.array(scene.spec.region.min), np.array(scene.spec.region.max)
    x, y = (low + high)[:2] / 2
    return float(x), float(y), float(low[2])
