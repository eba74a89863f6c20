"""Splats that were made elsewhere to an asset, without photographs.

In: a file of splats, and what is known of its units and axes. Out: an :class:`~mitsplat.asset.Asset` that stands
upright, without what is invisible or loose, with a closed mesh and pieces, and a page to look at it by.
"""

from __future__ import annotations

from mitsplat.importing.splat_import import Imported, ImportSettings, import_splats

__all__ = ["ImportSettings", "Imported", "import_splats"]
