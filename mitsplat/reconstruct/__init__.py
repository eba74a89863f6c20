"""Reconstruction of an asset from photographs and fitted splats.

Input: a capture and the splats that were fitted to it.
Output: an :class:`~mitsplat.asset.Asset` of the object alone, with a closed mesh aligned to its splats, and an
evaluation on held-out photos.
:mod:`.asset_pipeline` runs all steps from the photographs to the asset.
"""

from __future__ import annotations

from mitsplat.reconstruct.asset_pipeline import make_asset, make_photo_asset
from mitsplat.reconstruct.reconstruct import Reconstruction, ReconstructSettings, reconstruct_asset

__all__ = [
    "ReconstructSettings",
    "Reconstruction",
    "make_asset",
    "make_photo_asset",
    "reconstruct_asset",
]
