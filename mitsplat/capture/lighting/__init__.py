"""Light that was captured to lights of a scene file.

In: an HDR panorama, or photographs of a mirror ball. Out: lamps as area lights, and an environment light of all else,
which together send the light that the panorama sends onto a level table.
"""

from __future__ import annotations

from mitsplat.capture.lighting.estimate import (
    BallReading,
    BallView,
    LightEstimate,
    LightSettings,
    estimate_light,
    read_ball,
    refuse_to_replace,
    write_light,
)
from mitsplat.capture.lighting.lamps import Lamp
from mitsplat.capture.lighting.mirror_ball import BallPanorama
from mitsplat.capture.lighting.panorama import read_panorama

__all__ = [
    "BallPanorama",
    "BallReading",
    "BallView",
    "Lamp",
    "LightEstimate",
    "LightSettings",
    "estimate_light",
    "read_ball",
    "read_panorama",
    "refuse_to_replace",
    "write_light",
]
