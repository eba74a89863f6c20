"""Conversion of captured light to lights of a scene file.

Input: an HDR panorama, or photographs of a mirror ball. Output: area lights for the lamps, and an environment light for
the remaining light. Together they give a level table the same irradiance as the panorama.
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
