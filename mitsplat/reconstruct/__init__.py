"""Reconstruction of an asset from photographs and fitted splats.

Input: a capture and the splats that were fitted to it.
Output: an :class:`~mitsplat.asset.Asset` of the object alone, with a closed mesh aligned to its splats, and an
evaluation on held-out photos.
:mod:`.asset_pipeline` runs all steps from the photographs to the asset.
"""

from __future__ import annotations

from mitsplat.reconstruct.asset_pipeline import AssetJob, asset_from_photos, make_asset
from mitsplat.reconstruct.reconstruct import Reconstruction, ReconstructSettings, reconstruct_asset

__all__ = [
    "AssetJob",
    "ReconstructSettings",
    "Reconstruction",
    "asset_from_photos",
    "make_asset",
    "reconstruct_asset",
]
