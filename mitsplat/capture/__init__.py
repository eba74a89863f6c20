"""Conversion of photographs to camera poses, metric scale and object masks.

Input: a folder of photographs, optionally with a printed board in them or with poses of another tool. Output: a
:class:`Capture` with photos, their cameras with lenses in a metric frame (z up), the points of structure from motion,
and masks of the object.
"""

from __future__ import annotations

from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_result import CaptureResult
from mitsplat.capture.pipeline.capture_settings import CaptureSettings

__all__ = ["Capture", "CaptureResult", "CaptureSettings", "Photo", "capture_photos"]
