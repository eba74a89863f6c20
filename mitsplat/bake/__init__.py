"""CAD meshes and scans to assets.

In: a mesh with its materials. Out: an :class:`~mitsplat.asset.Asset` whose flat Gaussians on its surface show what the
path tracer saw, with a proxy mesh, convex pieces, and a report that shows the mesh beside the splats.
"""

from __future__ import annotations

from mitsplat.bake.bake import BakeResult, BakeSettings, bake_asset
from mitsplat.bake.surface_materials import SurfaceFinish

__all__ = ["BakeResult", "BakeSettings", "SurfaceFinish", "bake_asset"]
