"""Reconstruction of an asset from photographs and fitted splats.

Input: a capture and the splats that were fitted to it.
Output: an :class:`~mitsplat.asset.Asset` of the object alone, with a closed mesh aligned to its splats, and an
evaluation on held-out photos.
:mod:`.pipeline` runs all steps from the photographs to the asset. :mod:`.asset_evaluation` holds the thresholds of the
verdict.
"""

from __future__ import annotations

from mitsplat.reconstruct.reconstruct import AssetJob, Reconstruction, ReconstructSettings, reconstruct_asset

__all__ = ["AssetJob", "ReconstructSettings", "Reconstruction", "reconstruct_asset"]
