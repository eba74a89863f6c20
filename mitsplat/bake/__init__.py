"""Baking of CAD meshes and scans into assets.

In: a mesh with its materials. Out: an :class:`~mitsplat.asset.Asset` of flat Gaussians on the surface of the mesh with
these materials, a proxy mesh and convex pieces, and a report that compares mesh and splats.
"""

from __future__ import annotations

from mitsplat.bake.bake import BakeResult, BakeSettings, bake_asset
from mitsplat.bake.surface_materials import SurfaceFinish

__all__ = ["BakeResult", "BakeSettings", "SurfaceFinish", "bake_asset"]
