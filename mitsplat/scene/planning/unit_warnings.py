"""Warnings of values of a scene file that are probably in another unit: millimetres, radians or 8-bit colours."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mitsplat.findings import Finding
from mitsplat.scene.spec.light_spec import EnvironmentLight, LocalLight
from mitsplat.scene.spec.scene_spec import SceneSpec

MAX_REGION = 20.0
"""Largest plausible edge of a region [m]."""
MAX_LIGHT = 50.0
"""Largest plausible distance of a light from the origin [m]."""
MAX_COLOUR = 16.0
"""Largest plausible factor of the colour of a light."""
RADIAN_STEP, RADIAN_DIGITS = np.pi / 4, 0.006
"""Angles in degrees that equal a multiple of the first within the second are probably radians."""


def unit_warnings(spec: SceneSpec) -> Iterator[Finding]:
    """Yield a finding for each value that is probably in another unit, with the unit as the remedy."""
    for number, (region, _) in enumerate(spec.all_regions):
        key = f"regions[{number - 1}]" if number else "region"
        edge = float(np.max(np.subtract(region.max, region.min)))
        if edge > MAX_REGION:
            yield Finding("region", False, f"{key}: it is {edge:.4g} m long", "is it in millimetres?")
    for number, light in enumerate(spec.lights):
        if isinstance(light, LocalLight):
            away = float(np.linalg.norm(light.position))
            if light.draw is not None and light.draw.distance is not None:
                away = light.draw.distance[1]
            if away > MAX_LIGHT:
                yield Finding("lights", False, f"lights[{number}]: it is {away:.4g} m away", "is it in millimetres?")
        if isinstance(light, LocalLight | EnvironmentLight) and max(light.colour) > MAX_COLOUR:
            text = f"lights[{number}].colour: its factors are up to {max(light.colour):g}"
            yield Finding("lights", False, text, "is it a colour from 0 to 255? Divide it by 255")
    turns = [(f"shapes[{number}]", one.box.rotate) for number, one in enumerate(spec.shapes) if one.box is not None]
    turns += [(f"objects[{number}]", pose.rotate) for number, one in enumerate(spec.objects) for pose in one.poses]
    for key, angles in turns:
        if any(map(_is_radian, angles)):
            text = f"{key}: it is rotated by {', '.join(f'{angle:g}' for angle in angles)} degrees"
            yield Finding("rotation", False, text, "are these angles radians?")


def _is_radian(angle: float) -> bool:
    """Return True if an angle in degrees is a multiple of pi/4 up to a full turn."""
    steps = round(abs(angle) / RADIAN_STEP)
    return 1 <= steps <= 8 and abs(abs(angle) - steps * RADIAN_STEP) <= RADIAN_DIGITS
