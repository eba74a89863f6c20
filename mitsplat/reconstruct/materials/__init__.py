"""Estimation of the materials of a photographed object whose light is known.

Input: a capture, the mesh of the object, and the lights of the photographs.
Output: base colour, metalness and roughness of the surface, with a confidence.
"""

from __future__ import annotations

from mitsplat.reconstruct.materials.capture_light import CaptureLight
from mitsplat.reconstruct.materials.estimation import MaterialEstimate, estimate_materials

__all__ = ["CaptureLight", "MaterialEstimate", "estimate_materials"]
