"""The static part of a picture, kept while the camera stands still.

Where no Gaussian of a dynamic object meets a tile, its pixels are those of the static splats alone. Where one does, the
tile's two lists are merged and walked as one, so that what is static still hides what is behind it: the picture is the
same, bit for bit, as one made of everything at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from mitsplat.quality import Quality
from mitsplat.renderer.rays.camera_rays import CameraView
from mitsplat.renderer.splatting.march import Image, march
from mitsplat.renderer.splatting.projection import CloudSet, Placement
from mitsplat.renderer.splatting.tiles import TileLists, bin_gaussians, merge_lists


@dataclass(frozen=True, eq=False)
class StaticTileCache:
    """Static splats as one camera sees them.

    Attributes:
        lists: Their Gaussians per tile.
        image: Their picture.
    """

    lists: TileLists
    image: Image

    @classmethod
    def of(
        cls, clouds: CloudSet, placements: Sequence[Placement], view: CameraView, quality: Quality, z_max: Any | None
    ) -> StaticTileCache:
        """The layer of some placements; arguments as of :func:`mitsplat.renderer.splatting.march.trace`.

        Raises:
            CrowdedError: If they are too many to be kept.
        """
        # Weights of instances are kept as they are where there are several, so that no pixel changes.
        lists = replace(bin_gaussians(clouds, placements, view, quality), instance=None)
        image = march(lists, view, quality, z_max=z_max)
        dr.eval(image)
        return cls(lists, image)

    def with_objects(
        self, clouds: CloudSet, placements: Sequence[Placement], view: CameraView, quality: Quality, z_max: Any | None
    ) -> Image:
        """The picture with more placements in it.

        Raises:
            CrowdedError: If they are too many.
        """
        objects = bin_gaussians(clouds, placements, view, quality)
        touched = dr.compress(objects.stop > objects.start)
        if dr.width(touched) == 0:
            return self.image
        lists = merge_lists(self.lists, objects, touched, view)
        return self.image.with_tiles(march(lists, view, quality, z_max=z_max), lists, view)
