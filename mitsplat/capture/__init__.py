"""Photographs to cameras, metres and masks.

In: a folder of photographs, with a printed board, poses of another tool, or neither. Out: a :class:`Capture`:
undistorted photos with their cameras in a metric frame, z up, the points that structure from motion found, and masks
of the object.
"""

from __future__ import annotations

from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.capture_photos import CaptureResult, CaptureSettings, capture_photos

__all__ = ["Capture", "CaptureResult", "CaptureSettings", "Photo", "capture_photos"]
