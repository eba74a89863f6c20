"""Splats and photographs to an asset.

In: a capture and the splats fitted to it. Out: an :class:`~mitsplat.asset.Asset` of the object alone, with a closed
mesh aligned with its splats, and a verdict by photos that took no part. :mod:`.pipeline` is the way from photographs
to there; :mod:`.splat_import` is the way from a splat file that was made elsewhere, without photographs.
"""

from __future__ import annotations

from mitsplat.reconstruct.pipeline import make_asset, make_photo_asset
from mitsplat.reconstruct.reconstruct import Reconstruction, ReconstructSettings, reconstruct_asset
from mitsplat.reconstruct.splat_import import Imported, ImportSettings, import_splats

__all__ = [
    "ImportSettings",
    "Imported",
    "ReconstructSettings",
    "Reconstruction",
    "import_splats",
    "make_asset",
    "make_photo_asset",
    "reconstruct_asset",
]
