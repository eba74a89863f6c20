"""March of a view's tiles in which material parameters take the place of colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsplat.arrays import Float64Array
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.quality import Quality
from mitsplat.renderer.instances.antialiasing import trace_tiles
from mitsplat.renderer.projection.clouds import Cloud, CloudSet, Placement, upload_cloud
from mitsplat.renderer.rays.camera_rays import TILE_PIXELS, CameraView
from mitsplat.renderer.rays.tile_subset import TileSubset
from mitsplat.renderer.splatting.march import Image


@dataclass(frozen=True, eq=False)
class ParameterPass:
    """Blended parameters of the pixels of some tiles.

    Attributes:
        image: Parameters in place of colours, tile after tile.
        pixel: Pixels of the picture.
        inside: True for pixels inside the picture.
    """

    image: Image
    pixel: mi.UInt32
    inside: mi.Bool

    @property
    def covered(self) -> mi.Bool:
        """True for pixels inside the picture of which these splats cover more than half."""
        return self.inside & (self.image.alpha > 0.5)

    @classmethod
    def of(
        cls,
        clouds: CloudSet,
        placements: Sequence[Placement],
        view: CameraView,
        quality: Quality,
        subset: TileSubset,
        z_max: mi.Float | None,
    ) -> ParameterPass:
        """Blend the parameters of clouds by :func:`parameter_cloud` along the central rays of pixels.

        Splats behind the depths ``z_max`` along z [m] are not visible.
        """
        x, y = subset.positions(view)
        inside = (x < view.width) & (y < view.height)
        pixel = y * view.width + x
        far = None if z_max is None else dr.gather(mi.Float, z_max, pixel, inside)
        dr.eval(far, pixel, inside)
        own = dr.zeros(mi.Float, subset.count * TILE_PIXELS)
        image, _ = trace_tiles(clouds, placements, view, subset, quality, own, far)
        return cls(image, pixel, inside)


def parameter_cloud(splats: Splats, values: Float64Array) -> Cloud:
    """Upload splats with three parameters from 0 to 1, shape (N, 3), in place of colours."""
    sh = ((values - 0.5) / SH_C0).astype("float32")[:, None]
    return upload_cloud(splats.means, splats.quats, splats.scales, splats.opacities, sh)
