"""The complete pipeline from photographs to an asset folder: capture, fit, reconstruction and report.

Input: a folder of photographs of an object or a place, or a capture and a fit. Output: an asset folder with its quality
figures and a report, and for an environment an example scene beside it.
"""

from __future__ import annotations

from mitsplat.reconstruct.pipeline.asset_pipeline import AssetResult, asset_from_photos, make_asset

__all__ = ["AssetResult", "asset_from_photos", "make_asset"]
