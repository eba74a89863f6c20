"""Photographs and the splats fitted to them to an asset.

In: a capture and the splats fitted to it. Out: an :class:`~mitsplat.asset.Asset` of the object alone, with a closed
mesh aligned with its splats, and a verdict by photos that took no part. :mod:`.pipeline` is the way from photographs
to there.
"""

from __future__ import annotations

from mitsplat.reconstruct.asset_from_photos import make_asset, make_photo_asset
from mitsplat.reconstruct.reconstruct import Reconstruction, ReconstructSettings, reconstruct_asset

__all__ = [
    "ReconstructSettings",
    "Reconstruction",
    "make_asset",
    "make_photo_asset",
    "reconstruct_asset",
]
