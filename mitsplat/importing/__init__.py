"""Import of splats from other programs as assets, without photographs.

In: a splat file, and its units and axes if known. Out: an upright :class:`~mitsplat.asset.Asset` without invisible or
loose splats, with a closed mesh and convex pieces, and an HTML page for visual inspection.
"""

from __future__ import annotations

from mitsplat.importing.import_result import Imported
from mitsplat.importing.splat_import import ImportSettings, import_splats

__all__ = ["ImportSettings", "Imported", "import_splats"]
