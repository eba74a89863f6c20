"""Shading normals of pixels, from the splats that they show.

The normals of normal maps are finer than the triangles of a proxy mesh. They are blended in a pass of their own, for
the tiles that show an object with such normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.quality import Quality
from mitsplat.renderer.composition.parameter_pass import ParameterPass, parameter_cloud
from mitsplat.renderer.projection.clouds import Cloud, CloudSet, Placement, merge_clouds
from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH, CameraView
from mitsplat.renderer.rays.device_arrays import wrapped
from mitsplat.renderer.rays.tile_subset import TileSubset
from mitsplat.renderer.splatting.march import Image

SAME_DEPTH = 0.01
"""Relative difference of depth up to which a pixel shows the splats that have these normals."""


@dataclass(frozen=True, eq=False)
class NormalMappedShapes:
    """Splats with shading normals on the device, with world-space normals in place of colours.

    Attributes:
        clouds: The splats, a cloud per placement.
        placements: Their poses.
        present: True for instances that have shading normals, by instance id.
    """

    clouds: CloudSet
    placements: tuple[Placement, ...]
    present: mi.Bool

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape], placements: Sequence[Placement]) -> NormalMappedShapes | None:
        """Collect the ``splats`` shapes, with their placements, that have shading normals; return None if none."""
        clouds: list[Cloud] = []
        placed: list[Placement] = []
        for shape, placement in zip(shapes, placements, strict=True):
            materials = shape.splats.materials
            if materials is not None and materials.normals is not None:
                placed.append(replace(placement, cloud=len(clouds), appearance=None))
                clouds.append(_normal_cloud(shape.splats, materials.normals, placement.world_from_cloud))
        if not clouds:
            return None
        present = np.zeros(1 + max(shape.instance for shape in shapes), bool)
        present[[placement.instance for placement in placed]] = True
        return cls(merge_clouds(clouds), tuple(placed), wrapped(mi.Bool, present))

    def normals(self, view: CameraView, quality: Quality, seen: Image, z_max: mi.Float | None) -> mi.Vector3f:
        """Return unit shading normals in world space of the pixels of an image, zero where it shows other splats."""
        result = dr.zeros(mi.Vector3f, view.width * view.height)
        subset = self._tiles(view, seen.instance)
        if subset.count == 0:
            return result
        found = ParameterPass.of(self.clouds, self.placements, view, quality, subset, z_max)
        image, pixel, inside = found.image, found.pixel, found.inside
        normal = 2 * mi.Vector3f(*image.rgb) / dr.maximum(image.alpha, 1e-6) - 1
        depth = dr.gather(mi.Float, seen.depth, pixel, inside)
        shown = inside & dr.gather(mi.Bool, self.present, dr.gather(mi.UInt32, seen.instance, pixel, inside), inside)
        shown &= (image.alpha > 0.5) & (dr.abs(image.depth - depth) < SAME_DEPTH * depth)
        normal = dr.select(dr.squared_norm(normal) > 0.01, dr.normalize(normal), 0)
        dr.eval(normal, shown)
        dr.scatter(result, normal, pixel, shown, mode=dr.ReduceMode.Permute)
        dr.eval(result)
        return result

    def _tiles(self, view: CameraView, instance: mi.UInt32) -> TileSubset:
        """Return the tiles with pixels of these shapes."""
        tiles = dr.zeros(mi.Bool, view.tiles_x * view.tiles_y)
        pixel = dr.arange(mi.UInt32, view.width * view.height)
        row = pixel // view.width
        tile = row // TILE_HEIGHT * view.tiles_x + (pixel - row * view.width) // TILE_WIDTH
        dr.scatter(tiles, mi.Bool(True), tile, dr.gather(mi.Bool, self.present, instance))
        dr.eval(tiles)
        return TileSubset.of(tiles, view)


def _normal_cloud(splats: Splats, normals: Float32Array, world_from_cloud: Float64Array) -> Cloud:
    """Upload splats with the normals of a placement, mapped from [-1, 1] to [0, 1]."""
    turn = world_from_cloud[:3, :3] / np.cbrt(np.linalg.det(world_from_cloud[:3, :3]))
    return parameter_cloud(splats, 0.5 + 0.5 * normals.astype(np.float64) @ turn.T)
