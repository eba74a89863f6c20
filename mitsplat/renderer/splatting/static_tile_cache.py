"""Cache of the static splats' tiles, valid while the camera does not move.

In a tile without Gaussians of dynamic objects, the pixels come from the static splats alone. In every other tile, both
lists are merged and blended as one, so that static splats still occlude what lies behind them. The result is
bit-identical to a picture of all placements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mitsplat.quality import Quality
from mitsplat.renderer.projection.clouds import CloudSet, Placement
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.splatting.march import Image, march
from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians, merge_lists


@dataclass(frozen=True, eq=False)
class StaticTileCache:
    """Static splats seen by one camera.

    Attributes:
        lists: Gaussians per tile.
        image: Rendered picture.
    """

    lists: TileLists
    image: Image

    @classmethod
    def of(
        cls,
        clouds: CloudSet,
        placements: Sequence[Placement],
        view: CameraView,
        quality: Quality,
        z_max: mi.Float | None,
    ) -> StaticTileCache:
        """Render and store the static placements; arguments as in :func:`mitsplat.renderer.splatting.march.trace`.

        Raises:
            CrowdedError: If there are too many pairs to store.
        """
        # The instance is stored as None, so that pixels are computed exactly as with several instances.
        lists = replace(bin_gaussians(clouds, placements, view, quality), instance=None)
        image = march(lists, view, quality, z_max=z_max)
        dr.eval(image)
        return cls(lists, image)

    def with_objects(
        self,
        clouds: CloudSet,
        placements: Sequence[Placement],
        view: CameraView,
        quality: Quality,
        z_max: mi.Float | None,
    ) -> Image:
        """Return the picture with additional placements.

        Raises:
            CrowdedError: If there are too many pairs.
        """
        objects = bin_gaussians(clouds, placements, view, quality)
        touched = dr.compress(objects.stop > objects.start)
        if dr.width(touched) == 0:
            return self.image
        lists = merge_lists(self.lists, objects, touched, view)
        return self.image.with_tiles(march(lists, view, quality, z_max=z_max), lists, view)
