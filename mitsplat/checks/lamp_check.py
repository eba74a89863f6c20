"""Check for lamps that surroundings hide from the objects."""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi
import numpy as np

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.findings import Finding
from mitsplat.frames.light_properties import reference_point
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, segments
from mitsplat.runtime.dropped_rays import check_dropped_rays
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.planning.frame_lights import lights_at
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import EnvironmentLight, RoomLight

DRAWS = 64
"""Number of layouts whose lamps are checked."""
MAX_HIDDEN = 0.15
"""Largest share of hidden lamps that is accepted: a robot arm may hide some positions."""


def check_lamps(scene: Scene) -> Iterator[Finding]:
    """Yield a finding for each entry of ``lights`` whose lamps the first environment often hides from the objects."""
    environment = scene.environment_of(0)
    if environment is None or environment.mesh is None:
        return
    ensure_variant()
    surfaces = ray_scene({"environment": plain_mesh(environment.mesh)})
    for number, entry in enumerate(scene.spec.lights):
        alone = scene.spec.model_copy(update={"lights": (entry,)})
        draws = [lights_at(alone, layout, layout, (layout + 0.5) / DRAWS) for layout in range(DRAWS)]
        lamps = [light for lights in draws for light in lights if not isinstance(light, EnvironmentLight)]
        if not lamps:
            continue
        hidden = float(_blocked(surfaces, reference_point(scene), np.array([lamp.position for lamp in lamps])).mean())
        if hidden > MAX_HIDDEN:
            text = f"lights[{number}]: the environment hides {hidden:.0%} of these lamps from the objects"
            remedy = "limit draw.azimuth or draw.position to the sides without walls"
            if isinstance(entry, RoomLight):
                remedy = "choose a smaller size, or area lights with draw.azimuth on the sides without walls"
            yield Finding("light", False, text, remedy)


def _blocked(surfaces: mi.Scene, start: tuple[float, float, float], ends: Float64Array) -> BoolArray:
    """Return True for ends (N, 3) [m] that a surface hides from the start [m]."""
    blocked = np.array(surfaces.ray_test(segments(np.broadcast_to(start, ends.shape), ends)), dtype=bool)
    check_dropped_rays()
    return np.broadcast_to(blocked, len(ends))
